"""Evaluation: success on the unmodified robosuite robot, and the interval that is claimed for it."""

import math
import os
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from robots import ROBOTS
from tasks.pick import ACTION, ACTION_SIZE, OBSERVATION
from toolkit.demonstrations.scripts import PickScript
from toolkit.evaluation.success import Evaluation, evaluate_merged, evaluate_native
from toolkit.learning.policy import GaussianPolicy
from toolkit.simulation.rollout import RolloutEngine
from toolkit.simulation.watching import States


def wilson(successes, episodes):
    """Wilson (1927): the rates p with |p - k/n| <= z sqrt(p (1 - p) / n), by hand."""
    z, rate = 1.959963984540054, successes / episodes
    centre = (rate + z * z / (2 * episodes)) / (1 + z * z / episodes)
    half = z / (1 + z * z / episodes) * math.sqrt(rate * (1 - rate) / episodes + z * z / (4 * episodes**2))
    return centre - half, centre + half


@given(episodes=st.integers(1, 500), share=st.floats(0, 1))
def test_the_interval_is_wilsons(episodes, share):
    successes = round(share * episodes)
    result = Evaluation("jaco", "native", episodes, successes, 0, 0)
    np.testing.assert_allclose(result.ci95, wilson(successes, episodes), atol=1e-9)
    assert result.ci95[0] <= result.success_rate <= result.ci95[1]


def test_the_interval_by_hand():
    """8 of 10: (0.490, 0.943)."""
    np.testing.assert_allclose(Evaluation("jaco", "native", 10, 8, 0, 0).ci95, (0.4901625, 0.9433178), atol=1e-6)


def test_json_keeps_its_contract():
    record = Evaluation("jaco", "merged", 4, 1, 2, 7).to_json()
    assert {k: record[k] for k in ("target", "env", "episodes", "successes", "success_rate", "diverged", "seed")} == {
        "target": "jaco", "env": "merged", "episodes": 4, "successes": 1, "success_rate": 0.25, "diverged": 2,
        "seed": 7,
    }
    assert len(record["ci95"]) == 2


def test_the_scripted_pick_succeeds_on_robosuites_own_kinova3(native):
    robot, script = native("kinova3"), PickScript()
    outcomes = [robot.play(script, seed) for seed in range(3)]
    assert all(outcomes), f"{sum(outcomes)} of 3 scripted picks succeed on the unmodified robot"


def test_an_idle_robot_fails(native):
    states = States()
    idle = np.zeros(ACTION_SIZE)
    assert native("kinova3").play(lambda observation: idle, 0, states) is False
    assert len(states.qpos) == native("kinova3").task.horizon + 1


@pytest.mark.parametrize("what", ["speed", "position", "action"])
def test_a_simulation_that_blows_up_is_no_success_and_is_said(native, what):
    """MuJoCo resets a state that is no number to the start and goes on, so the observation alone tells nothing."""
    robot, script = native("kinova3"), PickScript()
    joint = int(robot.model.jnt_dofadr[robot.model.joint("robot0_Actuator7").id])

    def act(observation):
        if robot.env.timestep == 3:
            if what == "action":
                return np.full(ACTION_SIZE, np.nan)
            np.put(robot.data.qvel if what == "speed" else robot.data.qpos, joint, 1e12 if what == "speed" else np.nan)
        return script(observation)

    assert robot.play(act, 0) is False and robot.diverged and robot.env.timestep == (3 if what == "action" else 4)
    assert robot.play(script, 0) is True and not robot.diverged


@pytest.fixture(scope="module")
def idle():
    """A policy whose mean action is zero everywhere."""
    policy = GaussianPolicy(OBSERVATION.names, ACTION.names, np.random.default_rng(0))
    policy.set_parameters(np.zeros_like(policy.parameters))
    return policy


@pytest.mark.slow
@pytest.mark.parametrize("processes", [1, 2])
def test_divergence_on_the_native_robot_is_counted(task, idle, processes):
    far = replace(task, horizon=3, noise_xy=1e14)  # an object beyond what MuJoCo takes for a number
    result = evaluate_native(idle, ROBOTS["kinova3"], far, 4, processes=processes)
    assert (result.successes, result.diverged) == (0, 4)
    assert evaluate_native(idle, ROBOTS["kinova3"], replace(task, horizon=3), 1).diverged == 0


def test_what_is_evaluated_is_what_was_given_not_what_had_its_name(task, idle):
    """Tasks and robots are told apart by all that they hold."""
    near = replace(task, goal_offset=(0.0, 0.0, 0.0), hold_steps=1)  # the object lies at its goal
    assert near.name == task.name
    found = [evaluate_native(idle, ROBOTS["kinova3"], what, 1).successes for what in (replace(task, horizon=2), near)]
    assert found == [0, 1]


@pytest.mark.parametrize("name", sorted(ROBOTS))
def test_actions_given_to_robosuite_stay_within_its_bounds(native, name):
    robot = native(name)
    low, high = robot.env.action_spec
    rng = np.random.default_rng(0)
    for scale in (1.0, 100.0):
        action = robot.robosuite_action(scale * rng.uniform(-1, 1, ACTION_SIZE))
        assert action.shape == low.shape, f"{name}: {action.shape} entries, robosuite takes {low.shape}"
        assert (action >= low - 1e-9).all() and (action <= high + 1e-9).all(), (
            f"{name}: action leaves robosuite's bounds"
        )


@pytest.mark.parametrize("name", sorted(ROBOTS))
def test_the_robot_and_its_engine_observe_alike(native, native_fast, name):
    """The whole observation record, fingers and command included, while the gripper half closes in the air.

    When jaws meet jaws, mesh on mesh, a difference of 1e-8 grows to 1e-2 within two steps; so they do not meet here.
    """
    slow, fast = native(name), native_fast(name)
    apart = [np.abs(slow.begin(3) - fast.begin(3)).max()]
    action = np.ones(ACTION_SIZE)
    action[:6] = [0, 0, 0.5, 0, 0, 0]
    for _ in range(7):
        apart.append(np.abs(slow.step(action) - fast.step(action)).max())
    assert max(apart) < 1e-5, f"{name}: observations {max(apart):.1e} apart (first {apart[0]:.1e})"


def test_workers_leave_when_their_parent_is_killed(tmp_path):
    """kill -9 must not leave processes behind that hold a gigabyte each."""
    program = tmp_path / "parent.py"
    program.write_text(
        "import os, time\n"
        "from concurrent.futures import ProcessPoolExecutor\n"
        "from multiprocessing import get_context\n"
        "from toolkit.quiet import start_worker\n"
        "if __name__ == '__main__':\n"
        "    pool = ProcessPoolExecutor(1, mp_context=get_context('spawn'), initializer=start_worker)\n"
        "    print(pool.submit(os.getpid).result(), flush=True)\n"
        "    time.sleep(600)\n"
    )
    environment = os.environ | {"PYTHONPATH": str(Path(__file__).parents[2])}
    parent = subprocess.Popen([sys.executable, str(program)], stdout=subprocess.PIPE, text=True, env=environment)
    worker = int(parent.stdout.readline())
    parent.kill()
    parent.wait()
    deadline = time.monotonic() + 60
    while Path(f"/proc/{worker}").exists() and "Z" not in Path(f"/proc/{worker}/stat").read_text().split(")")[1][:3]:
        assert time.monotonic() < deadline, f"worker {worker} outlived its parent"
        time.sleep(0.2)


@pytest.mark.slow
@pytest.mark.parametrize(("run", "target"), [("found-asking-0", "kinova3"), ("found-independent-0", "kinova3"), ("found-tree-1", "iiwa")])
def test_what_picks_on_robosuites_gripper_picks_on_its_merged_robot(run, target, merged, task):
    """Policies in docs/results, 200 of 200 on the unmodified robot: F(beta) is that robot, so they pick there as well."""
    path = Path(__file__).parents[2] / "docs" / "results" / run / f"{target}.policy.safetensors"
    policy = GaussianPolicy.load(path, task.observation.names, task.action.names)
    engine = RolloutEngine(merged)
    found = evaluate_merged(policy, engine, target, 8)
    engine.close()
    assert found.successes >= 6, f"{found.successes} of 8"

"""The unmodified robosuite robot behind the named records: what it plays, what it refuses to call success, what it is given."""

import numpy as np
import pytest

from robots import ROBOTS
from tasks.pick import ACTION_SIZE
from toolkit.demonstrations.scripts import PickScript
from toolkit.simulation.watching import States


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

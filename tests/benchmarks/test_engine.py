"""The engine beside robosuite's own step and bare mj_step: the same observations, endings and physics, in flat memory."""

import dataclasses
import json
import resource

import mujoco
import numpy as np
import pytest

from robots import ROBOTS
from toolkit.benchmarks.engine import (
    STRETCH,
    bare_steps,
    measure_engine,
    observation_difference,
    outcomes,
    performance_page,
    qpos_difference,
    record,
    time_shares,
    with_hand,
)
from toolkit.demonstrations.scripts import PickScript
from toolkit.expert.shelf import load_expert
from toolkit.morphology.build import MergedRobot
from toolkit.simulation.divergence import STATE
from toolkit.simulation.laws import merged_plant, native_plant
from toolkit.simulation.native import NativeRobot
from toolkit.simulation.rollout import RolloutEngine

SOURCE = next(robot for robot in ROBOTS.values() if robot.source_of_policy)
OTHER_ARMS = list({robot.arm: robot for robot in ROBOTS.values() if robot.arm != SOURCE.arm}.values())


@pytest.fixture(scope="module")
def expert(task):
    return load_expert(SOURCE.name, task)[0]


@pytest.mark.parametrize("name", list(ROBOTS))
def test_observations_are_robosuites_on_the_same_states(native, native_fast, name):
    slow, fast = native(name), native_fast(name)
    off = observation_difference(slow, fast, PickScript(), seed=1, steps=30)
    assert off < 1e-9, f"{name}: an entry of the observation is off by {off:.1e}"
    near = np.linalg.norm(slow.env.object_position - slow.env.goal)
    for tolerance in (0.99 * near, 1.01 * near):
        fast.task = dataclasses.replace(slow.task, goal_tolerance=tolerance)
        assert fast.at_goal == (near < tolerance)
    fast.task = slow.task


@pytest.mark.parametrize("arm", OTHER_ARMS, ids=lambda robot: robot.name)
def test_the_hand_on_any_arm_moves_as_under_robosuite(task, arm):
    robot = with_hand(arm, SOURCE)
    off, _ = qpos_difference(NativeRobot(robot, task), native_plant(robot, task), seed=0)
    assert off < 1e-6, f"{robot.name}: arm qpos {off:.1e} rad from robosuite's env.step within 2 s"


def test_episodes_end_as_under_robosuite(native, native_fast, expert):
    """Through contact, with the policy's own noise; the share over 100 seeds is measured by meta-evolve bench engine."""
    found = outcomes(native("kinova3"), native_fast("kinova3"), expert.act, range(3))
    assert found.same == found.episodes == 3, found


@pytest.mark.slow
def test_the_recorded_controls_play_the_engines_physics(pair, expert):
    """So that bare mj_step is timed on the very motion that the engine is timed on."""
    plant, bare = (merged_plant(pair.merged, pair.space.beta("kinova3"), *pair.merged.new()) for _ in range(2))
    stretches = record(plant, expert.act)
    assert stretches.contacts > 2, f"{stretches.contacts} contacts: nothing is grasped in the recorded episode"
    for index in (0, len(stretches.states) - 1):
        for each in (plant, bare):
            mujoco.mj_setState(each.model, each.data, stretches.states[index], STATE)
        plant.command, plant.goal = stretches.commands[index].copy(), stretches.goal
        for action in stretches.actions[index]:
            plant.step(action)
        bare_steps(bare.model._address, bare.data._address, stretches.controls[index], bare.data.ctrl)
        np.testing.assert_array_equal(plant.data.qpos, bare.data.qpos)
        assert len(stretches.controls[index]) == STRETCH * plant.substeps


def test_the_parts_of_a_step_add_up(pair, expert):
    shares = time_shares(merged_plant(pair.merged, pair.space.beta("kinova3"), *pair.merged.new()), expert.act)
    step = shares.pop("microseconds")
    assert step > 1 and sum(shares.values()) == pytest.approx(1.0)
    assert min(shares.values()) > 0 and shares["constraint solver"] > 0.05, shares


@pytest.mark.slow
def test_memory_does_not_grow_with_episodes(pair):
    """Short episodes, so that there are many; a leak of a model, a plant or a state each would show."""
    brief = MergedRobot(pair.space, dataclasses.replace(pair.merged.task, horizon=1))
    engine = RolloutEngine(brief, threads=2)
    alphas = [0.5 * (pair.space.betas[0] + beta) for beta in pair.space.betas]

    def peak():
        for seed in range(0, 400, 40):
            engine.play(PickScript(), [alphas[i % len(alphas)] for i in range(40)], list(range(seed, seed + 40)))
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss

    before = peak()
    grown = peak() - before
    engine.close()
    assert grown < 4096, f"{grown} KiB more after 400 episodes"


@pytest.mark.slow
def test_the_report_keeps_its_contract(pair, expert):
    measured = measure_engine([ROBOTS["kinova3"]], pair.merged, expert.act, episodes=0, rounds=1, scale=False)
    found = json.loads(json.dumps(measured, allow_nan=False))
    (row,) = found["robots"]
    keys = {"name", "parity_qpos", "control_steps_per_s", "robosuite_control_steps_per_s", "ratio_to_robosuite", "ratio_to_bare_mj_step"}
    assert keys <= row.keys() and row["name"] == "kinova3"
    assert row["parity_qpos"] < 1e-6 and row["observation_error"] < 1e-9
    assert row["ratio_to_robosuite"] > 2, f"only {row['ratio_to_robosuite']:.1f} times robosuite's env.step"
    assert 0.4 < row["ratio_to_bare_mj_step"] < 1.5, f"{row['ratio_to_bare_mj_step']:.2f} of bare mj_step"
    assert [entry["name"] for entry in found["merged"]] == [SOURCE.name, "kinova3"]
    page = performance_page(found, "meta-evolve bench engine")
    assert f"| kinova3 | {row['control_steps_per_s']:.0f} | {row['ratio_to_bare_mj_step']:.2f} |" in page
    assert "## Episodes" not in page
    machine = found["machine"]
    assert f"on {machine['date']}, {machine['cores']} cores of {machine['processor']};" in page and machine["processor"]

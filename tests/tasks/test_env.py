"""The pick in robosuite's environment: success needs patience, what fell is lost, and starts are the engine's."""

import numpy as np
import pytest

from tasks.table import TABLE_TOP
from toolkit.simulation.laws import merged_plant


def place(robot, position):
    """Put the object somewhere, at rest."""
    robot.data.qpos[-7:] = [*position, 1, 0, 0, 0]
    robot.data.qvel[-6:] = 0
    robot.env.sim.forward()


def test_success_in_robosuite_needs_consecutive_steps(native, task):
    robot = native("kinova3")
    goal, steps = robot.env.goal, task.hold_steps
    place(robot, goal)
    rewards = [robot.env.reward() for _ in range(steps - 1)]
    place(robot, goal + [0, 0, 1.1 * task.goal_tolerance])
    rewards.append(robot.env.reward())
    assert not any(rewards), f"rewarded after {np.flatnonzero(rewards) + 1} of {steps} steps at the goal"
    place(robot, goal + [0, 0, 0.9 * task.goal_tolerance])
    rewards = [robot.env.reward() for _ in range(steps)]
    assert rewards == [0.0] * (steps - 1) + [1.0], f"rewards {rewards}, expected one on step {steps}"
    assert robot.env.succeeded and not robot.env.lost


def test_an_object_below_the_table_is_lost_for_good(native):
    robot = native("kinova3")
    place(robot, [1.0, 0.0, TABLE_TOP - 0.1])
    assert robot.env.reward() == 0.0 and robot.env.lost
    place(robot, robot.env.goal)
    robot.env.reward()
    assert robot.env.lost, "an object that fell off the table was forgiven"


@pytest.mark.parametrize("seed", [0, 3, 10**9])
def test_engine_and_robosuite_start_from_the_same_seed_alike(native, native_fast, pair, seed):
    robot, fast = native("kinova3"), native_fast("kinova3")
    plant = merged_plant(pair.merged, pair.space.beta("kinova3"), *pair.merged.new())
    observations = [robot.begin(seed), fast.begin(seed), plant.begin(seed)]
    for label, other in zip(("native engine", "merged engine"), observations[1:], strict=True):
        apart = np.abs(other - observations[0]).max()
        assert apart < 1e-7, f"seed {seed}: the {label}'s first observation is {apart:.1e} from robosuite's"

"""Robots: every registered one starts at the same grasp frame, within its limits, and reaches where the task goes."""

from dataclasses import replace
from itertools import product

import mujoco
import numpy as np
import pytest

from robots import ROBOTS
from tasks.pick import GOAL_OFFSET, OBJECT_XY, START_POSITION, START_ROTATION
from tasks.table import TABLE_TOP
from toolkit.expert.shelf import load_expert
from toolkit.learning.policy import MeanActor
from toolkit.morphology.native_scene import GRIP_SITE, NativeScene
from toolkit.morphology.posture import solve_arm, start_of
from toolkit.simulation.rollout import play

REACH = 0.05
"""Half width [m] of the widest start noise of any task."""

every_robot = pytest.mark.parametrize("name", sorted(ROBOTS))


def grasp_frame(model, qpos):
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    mujoco.mj_kinematics(model, data)
    site = data.site(GRIP_SITE)
    return np.array(site.xpos), np.array(site.xmat).reshape(3, 3)


def limit_slack(model, qpos):
    """Smallest distance [rad] of a limited arm joint from its limits."""
    arm = [j for j in NativeScene(model).arm if model.jnt_limited[j]]
    angle = qpos[model.jnt_qposadr[arm]]
    return float(np.minimum(angle - model.jnt_range[arm, 0], model.jnt_range[arm, 1] - angle).min())


@every_robot
def test_the_grasp_frame_starts_at_the_tasks_pose(native, name):
    robot = native(name)
    position, rotation = grasp_frame(robot.model, robot.data.qpos)
    error = np.abs(position - START_POSITION).max()
    assert error < 1e-8, f"{name}: grasp frame {error:.1e} m from START_POSITION"
    turned = np.abs(rotation - START_ROTATION).max()
    assert turned < 1e-8, f"{name}: grasp frame's axes {turned:.1e} from START_ROTATION"


@every_robot
def test_the_start_posture_is_within_limits_and_at_rest(native, name):
    robot = native(name)
    slack = limit_slack(robot.model, robot.data.qpos)
    assert slack > 0, f"{name}: an arm joint starts {-slack:.3f} rad beyond its limit"
    arm = NativeScene(robot.model).arm_qpos
    np.testing.assert_allclose(robot.data.qpos[arm], start_of(robot.robot).arm, atol=1e-12)
    assert np.abs(robot.data.qvel).max() == 0.0, f"{name}: starts with speed {np.abs(robot.data.qvel).max()}"


@every_robot
def test_the_robot_starts_clear_of_table_and_object(native, name):
    robot = native(name)
    data = mujoco.MjData(robot.model)
    data.qpos[:] = robot.data.qpos
    mujoco.mj_forward(robot.model, data)
    pairs = {tuple(sorted(robot.model.geom(g).name for g in (c.geom1, c.geom2))) for c in data.contact}
    touching = [pair for pair in pairs if sum(n.startswith(("object", "table")) for n in pair) == 1]
    assert not touching, f"{name}: {touching} touch before the first step"


@every_robot
def test_every_corner_of_the_workspace_is_reachable(native, name):
    robot = native(name)
    start = np.array(robot.data.qpos)
    low = np.array([*OBJECT_XY, TABLE_TOP + robot.task.object.half_height])
    corners = [
        low + [dx, dy, 0] + offset for dx, dy in product((-REACH, REACH), repeat=2) for offset in (0 * low, GOAL_OFFSET)
    ]
    for corner in corners:
        qpos = solve_arm(robot.model, start, corner, name)
        position, rotation = grasp_frame(robot.model, qpos)
        error = max(np.abs(position - corner).max(), np.abs(rotation - START_ROTATION).max())
        assert error < 1e-8, f"{name}: {error:.1e} m or rad left at {np.round(corner, 3)}"
        slack = limit_slack(robot.model, qpos)
        assert slack > -1e-9, f"{name}: {-slack:.3f} rad beyond a joint limit at {np.round(corner, 3)}"


@every_robot
def test_the_sources_expert_grasps_with_it_untrained(native_fast, task, name):
    """The start pose, the roles and the closing sense of a card make the hand's policy meaningful on every gripper."""
    policy, _ = load_expert("adroit", task)
    plant = native_fast(name)
    outcomes = [play(plant, MeanActor(policy), seed, np.zeros(1)).success for seed in range(3)]
    assert sum(outcomes) >= 2, f"{name}: the expert of the hand succeeds in {sum(outcomes)} of 3 episodes on robosuite's robot"


def test_a_name_must_be_an_identifier():
    with pytest.raises(ValueError, match="robot name 'my robot' is not an identifier"):
        replace(ROBOTS["kinova3"], name="my robot")


def test_cards_are_registered_under_their_names_with_one_source():
    assert all(name == robot.name for name, robot in ROBOTS.items())
    assert [r.name for r in ROBOTS.values() if r.source_of_policy] == ["adroit"]

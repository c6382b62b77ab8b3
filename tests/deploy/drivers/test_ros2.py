"""What belongs around an arm in ROS 2, against fakes of its messages: node, names, controller, tf, gripper."""

import sys
import time
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
import yaml
from toy_commands import ANGLES, JOINTS, joint_command, scene

from toolkit.bundle.reading import load_bundle
from toolkit.deploy.arm import Command
from toolkit.deploy.drivers import ros2
from toolkit.deploy.kinematics import load_mjcf
from toolkit.errors import ToolkitError


@pytest.fixture
def ros(ros):
    ros.angles = ANGLES
    return ros


def test_ros2_looks_joints_up_by_name_and_gives_seconds():
    published, names = [], [f"lbr_A{i}" for i in range(1, 8)]
    message = lambda: SimpleNamespace(velocities=[])  # noqa: E731
    driver = ros2.Ros2(SimpleNamespace(publish=published.append), message, message, lambda sec, nanosec: sec + 1e-9 * nanosec, "iiwa",
                       JOINTS, names, scene, lambda *to: None, lambda: 1.0)
    with pytest.raises(ToolkitError, match="nothing came on /joint_states"):
        driver.read()
    shuffled = names[::-1]
    stamp = SimpleNamespace(stamp=SimpleNamespace(sec=7, nanosec=5))
    driver.heard(SimpleNamespace(header=stamp, name=shuffled, position=ANGLES[::-1].tolist(), velocity=[], effort=list(range(7))))
    state = driver.read()
    assert state.joints.tolist() == ANGLES.tolist() and state.speeds is None and state.efforts.tolist() == list(range(6, -1, -1))
    command = joint_command(count=5)
    driver.send(command)
    trajectory = published[0]
    assert trajectory.joint_names == names
    assert [p.time_from_start for p in trajectory.points] == pytest.approx([0.01, 0.02, 0.03, 0.04, 0.05])
    assert trajectory.points[-1].positions == ANGLES.tolist() and trajectory.points[-1].velocities == command.rate.tolist()
    driver.stop("done")
    assert published[-1].points == [] and driver.read().fault == "done"
    driver.heard(SimpleNamespace(header=stamp, name=names[1:], position=[0.0] * 6, velocity=[], effort=[]))
    with pytest.raises(ToolkitError, match="no joint 'lbr_A1'"):
        driver.read()


def test_the_node_reads_by_name_and_sends_to_the_controllers_topic(ros, wait_for):
    moved = []
    arm, close = ros2.open_arm("kinova3", JOINTS, scene, lambda *to: moved.append(to), lambda: 0.5)
    assert arm.connect().joints == JOINTS
    wait_for(lambda: arm._heard is not None)
    state = arm.read()
    assert state.joints.tolist() == ANGLES.tolist() and state.opening == 0.5 and state.efforts.tolist() == [1.0] * 7
    rows = np.linspace(ANGLES, ANGLES + 0.01, 6)[1:]
    arm.send(Command("joint", False, rows[-1], np.full(7, 0.2), 1.0, 0.25, 0.02, rows))
    assert ros.topics == ["/joint_trajectory_controller/joint_trajectory"] and len(ros.published) == 1
    assert ros.published[0].joint_names == [f"joint_{i}" for i in range(1, 8)] and moved == [(0.25, 0.02)]
    close()
    assert ros.destroyed


def test_a_node_that_only_listens_has_no_publisher(ros, wait_for):
    arm, close = ros2.open_arm("kinova3", JOINTS, scene, listens=True)
    arm.listen()
    wait_for(lambda: arm._heard is not None)
    assert arm.read().joints.tolist() == ANGLES.tolist() and ros.topics == []
    with pytest.raises(ToolkitError, match="only listens"):
        arm.send(Command("joint", False, ANGLES, np.zeros(7), 0.0, 1.0, 0.08, ANGLES[None]))
    arm.stop("over")
    close()
    assert ros.published == []


def test_joints_without_names_in_ros_are_asked_for(ros):
    with pytest.raises(ToolkitError, match="'sawyer' has 7 joints, and 0 names .* give ros_names"):
        ros2.open_arm("sawyer", JOINTS, scene)
    for name, names in ros2.JOINT_NAMES.items():
        assert len(set(names)) == len(names) == (6 if name == "ur5e" else 7)


@pytest.mark.parametrize("name", ["jaco", "kinova3", "iiwa"])
def test_names_fit_the_shipped_bundles(name):
    assert len(ros2.JOINT_NAMES[name]) == len(load_bundle(name).manifest.joints)


def test_the_controllers_yaml_takes_what_the_driver_sends():
    """A trajectory that ends in motion must be allowed, or the controller refuses every one; a stale one must be given up."""
    manifest, names = load_bundle("kinova3").manifest, ros2.JOINT_NAMES["kinova3"]
    read = yaml.safe_load(ros2.controllers_yaml(manifest, names, 500))
    manager, controller = read["controller_manager"]["ros__parameters"], read["joint_trajectory_controller"]["ros__parameters"]
    assert manager["update_rate"] == 500
    assert manager["joint_trajectory_controller"] == {"type": "joint_trajectory_controller/JointTrajectoryController"}
    assert controller["joints"] == list(names) and controller["command_interfaces"] == ["position"]
    assert controller["allow_nonzero_velocity_at_trajectory_end"] is True
    assert controller["cmd_timeout"] == ros2.WATCHDOG > controller["constraints"]["goal_time"], "or it is not looked at"
    assert {controller["constraints"][joint]["trajectory"] for joint in names} == {manifest.watch.tracking_rad}
    with pytest.raises(ToolkitError, match="7 joints, not 6"):
        ros2.controllers_yaml(manifest, names[1:])


@pytest.mark.parametrize("name", ["jaco", "kinova3", "iiwa"])
def test_the_static_transform_puts_the_task_where_mujoco_has_it(name):
    """The flange in the bundle's robot.xml, told in the base frame and brought back by tf's numbers, is where the task frame has it."""
    bundle = load_bundle(name)
    robot = bundle.manifest.robot
    model = load_mjcf(bundle.mjcf)
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    base, flange = data.body(robot.base_body), data.body(robot.flange_body)
    in_base = base.xmat.reshape(3, 3).T @ (flange.xpos - base.xpos)
    for turn in (None, np.diag([-1.0, -1.0, 1.0])):
        shift, (x, y, z, w) = ros2.static_transform(bundle.manifest, turn)
        R = np.empty(9)
        mujoco.mju_quat2Mat(R, np.array([w, x, y, z]))
        in_link = in_base if turn is None else turn.T @ in_base
        np.testing.assert_allclose(R.reshape(3, 3) @ flange.xpos + shift, in_link, atol=1e-9)


def test_the_scene_comes_from_tf_with_its_own_stamp():
    manifest = load_bundle("kinova3").manifest
    found = SimpleNamespace(
        transform=SimpleNamespace(translation=SimpleNamespace(x=-0.1, y=0.02, z=0.83),
                                  rotation=SimpleNamespace(x=0.0, y=0.0, z=0.6, w=0.8)),
        header=SimpleNamespace(stamp=SimpleNamespace(sec=100, nanosec=500)),
    )
    asked = []

    def lookup(*what):
        asked.append(what)
        if found is None:
            raise LookupError("unknown frame")
        return found

    latest = object()
    seen = ros2.TfScene(lookup, latest, manifest, "brick", (LookupError,))
    position, quaternion, goal, stamp = seen()
    assert asked[0] == ("task", "brick", latest), "the object in the task frame: tf gives the second's pose in the first"
    assert position.tolist() == [-0.1, 0.02, 0.83] and quaternion.tolist() == [0.8, 0.0, 0.0, 0.6]
    np.testing.assert_allclose(goal, position + manifest.task.goal_offset_m)
    time.sleep(0.05)
    found.transform.translation.z = 0.9
    assert seen()[3] == pytest.approx(stamp, abs=1e-3), "the same stamp grows old"
    assert seen()[2].tolist() == goal.tolist(), "the goal stays where the episode put it"
    seen.begin()
    assert seen()[2][2] == pytest.approx(0.9 + manifest.task.goal_offset_m[2])
    found = None
    with pytest.raises(ToolkitError, match="tf has no 'brick' in 'task' .unknown frame"):
        seen()


def test_the_gripper_action_speaks_the_drivers_joint():
    sent = []
    old = lambda: SimpleNamespace(command=SimpleNamespace())  # noqa: E731
    grip = ros2.GripperAction(SimpleNamespace(send_goal_async=sent.append), old, opened=0.0, closed=0.8, effort=40.0)
    grip(1.0, 0.085)
    grip(0.999, 0.085)
    grip(0.25, 0.02)
    assert [(goal.command.position, goal.command.max_effort) for goal in sent] == [(0.0, 40.0), (pytest.approx(0.6), 40.0)]
    grip = ros2.GripperAction(SimpleNamespace(send_goal_async=sent.append), old, 0.0, 0.8, 40.0, "robotiq_85_left_knuckle_joint")
    grip(0.5, 0.04)
    command = sent[-1].command
    assert (command.name, command.position, command.effort) == (["robotiq_85_left_knuckle_joint"], [pytest.approx(0.4)], [40.0])


def test_an_opening_is_read_from_the_grippers_joint_and_grows_old():
    now = SimpleNamespace(at=10.0)
    opening = ros2.JointOpening("knuckle", opened=0.0, closed=0.8, now=lambda: now.at)
    assert np.isnan(opening())
    opening.heard(SimpleNamespace(name=["joint_1"], position=[0.4]))
    assert np.isnan(opening()), "the arm's own messages say nothing of it"
    opening.heard(SimpleNamespace(name=["joint_1", "knuckle"], position=[0.4, 0.2]))
    assert opening() == pytest.approx(0.75)
    now.at = 11.5
    assert np.isnan(opening())


def test_without_ros_it_is_said_what_to_do(monkeypatch):
    monkeypatch.setitem(sys.modules, "rclpy", None)
    with pytest.raises(ToolkitError, match="needs rclpy .*source your ROS 2 installation"):
        ros2.open_arm("kinova3", JOINTS, scene)

"""A robosuite scene read by us is the one that robosuite reads."""

import numpy as np
import pytest

from robots import ROBOTS
from toolkit.morphology.native_scene import NativeScene


@pytest.mark.parametrize("name", ROBOTS)
def test_parts_are_where_robosuite_finds_them(native, name):
    robot = native(name)
    scene, own = NativeScene(robot.model), robot.env.robots[0]
    hand = own.gripper["right"]
    assert scene.arm == list(own._ref_arm_joint_indexes)
    np.testing.assert_array_equal(scene.arm_qpos, own._ref_arm_joint_pos_indexes)
    np.testing.assert_array_equal(scene.arm_dofs, own._ref_arm_joint_vel_indexes)
    assert scene.arm_actuators == list(own._ref_arm_joint_actuator_indexes)
    np.testing.assert_array_equal(scene.finger_qpos, own._ref_gripper_joint_pos_indexes["right"])
    assert [robot.model.joint(j).name for j in scene.fingers] == hand.joints
    assert scene.arm_names == tuple(joint.removeprefix("robot0_") for joint in own.robot_model.arm_joints)
    assert scene.grip_site == own.eef_site_id["right"]
    assert robot.model.body(scene.flange).name == own.robot_model.eef_name["right"]
    assert robot.model.body(scene.hand).name == hand.root_body
    assert robot.model.joint(scene.object_joint).name == robot.env.item.joints[0]
    assert robot.env.item.root_body == robot.model.body(robot.model.jnt_bodyid[scene.object_joint]).name

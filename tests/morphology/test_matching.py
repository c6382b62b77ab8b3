"""The matching: slots, screws, senses and the posture of every robot."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest

from grippers.gripper import COMMANDED_ROLES, ROLE_PARENT
from robots import ROBOTS
from toolkit.errors import ToolkitError
from toolkit.morphology.matching import match, merged_slots

every_robot = pytest.mark.parametrize("name", list(ROBOTS))


def test_slots_are_the_arm_then_the_roles_parents_first(matching):
    names = [slot.name for slot in matching.slots]
    assert names == [f"arm{i + 1}" for i in range(matching.arm_size)] + list(ROLE_PARENT)
    for index, slot in enumerate(matching.slots):
        assert slot.parent < index, f"{slot.name} comes before its parent"
        assert slot.sliding == slot.name.endswith("S"), f"{slot.name} is of the wrong kind"
        if slot.name in ROLE_PARENT:
            parent = ROLE_PARENT[slot.name] or f"arm{matching.arm_size}"
            assert names[slot.parent] == parent, f"{slot.name} hangs on {names[slot.parent]}, not on {parent}"


@every_robot
def test_screws_stand_where_mujoco_puts_the_joints(matching, native, name):
    system, robot = matching.systems[matching.names.index(name)], native(name)
    data = mujoco.MjData(robot.model)
    data.qpos[:] = robot.data.qpos
    mujoco.mj_kinematics(robot.model, data)
    for slot, joint in zip(matching.slots, system.joints, strict=True):
        if joint is None or joint.mujoco_joint < 0:
            continue
        anchor = np.array(data.xanchor[joint.mujoco_joint])
        if slot.sliding:  # MuJoCo leaves a slide's anchor where it was before sliding
            anchor += (joint.screw.anchor - anchor) @ joint.screw.axis * joint.screw.axis
        np.testing.assert_allclose(joint.screw.anchor, anchor, atol=1e-9, err_msg=slot.name)
        np.testing.assert_allclose(
            joint.sign * joint.screw.axis, data.xaxis[joint.mujoco_joint], atol=1e-9, err_msg=slot.name
        )


@pytest.mark.parametrize("name", list(ROBOTS))
def test_the_start_lies_within_every_merged_limit(matching, name):
    """Zero is the start posture; a joint may rest against its soft stop, a degree beyond, and no further."""
    system = matching.systems[matching.names.index(name)]
    beyond = {slot.name: float(max(joint.limits[0], -joint.limits[1]))
              for slot, joint in zip(matching.slots, system.joints, strict=True) if joint is not None}
    worst = max(beyond, key=beyond.get)
    assert beyond[worst] < np.deg2rad(1), f"{name} {worst}: starts {beyond[worst]:.3f} rad beyond its limit"


@every_robot
def test_fingers_close_in_the_positive_sense(matching, name):
    system = matching.systems[matching.names.index(name)]
    for slot, joint in zip(matching.slots, system.joints, strict=True):
        if joint is not None and joint.stiffness > 0:
            assert joint.target_closed >= joint.target_open, f"{name} {slot.name} opens where the merged robot closes"


@every_robot
def test_observed_fingers_turn_alike_in_the_native_scene(matching, native, name):
    system = matching.systems[matching.names.index(name)]
    signs = {slot.name: j.sign for slot, j in zip(matching.slots, system.joints, strict=True) if j}
    alone = {role: sign for role, (q, sign, _) in zip(COMMANDED_ROLES, native(name)._fingers, strict=True) if q >= 0}
    hinges = set(ROBOTS[name].gripper.joints) & set(COMMANDED_ROLES)
    assert set(alone) == hinges and alone == {role: signs[role] for role in alone}


def test_one_robot_is_no_merged_tree():
    with pytest.raises(ToolkitError, match="at least two different robots; got kinova3"):
        match([ROBOTS["kinova3"]])
    with pytest.raises(ToolkitError, match="at least two different robots; got kinova3, kinova3"):
        match([ROBOTS["kinova3"], ROBOTS["kinova3"]])


def test_roles_that_nobody_has_and_nobody_commands_are_left_out():
    slots = merged_slots(["arm1"], {"THS"})
    parent = {slot.name: slots[slot.parent].name for slot in slots[1:]}
    assert set(parent) == {*COMMANDED_ROLES, "THS"}
    assert parent["THJ4"] == "THS" and parent["FFJ3"] == "arm1"


def test_six_joints_leave_out_the_roll_of_the_upper_arm(matching):
    """UR5e has no joint that turns the elbow about the line from shoulder to wrist; the other six pair in order."""
    system = matching.systems[matching.names.index("ur5e")]
    absent = [slot.name for i, slot in enumerate(matching.slots[: matching.arm_size]) if not system.present(i)]
    assert absent == ["arm3"]
    assert (system.torque_limits[2], system.torque_limits.min()) == (0.0, 0.0)
    others = [s for s in matching.systems if s is not system]
    assert all(s.present(i) for s in others for i in range(7)), "an arm of seven joints leaves one out"


def test_a_joint_that_the_gripper_lacks_is_named_with_those_it_has():
    gripper = replace(ROBOTS["jaco"].gripper, joints={**ROBOTS["jaco"].gripper.joints, "THJ1": "joint_big_toe"})
    with pytest.raises(
        ToolkitError, match="role THJ1 names joint 'joint_big_toe', which its model lacks; it has .*joint_thumb"
    ):
        match([ROBOTS["kinova3"], replace(ROBOTS["jaco"], gripper=gripper)])


def test_a_target_on_a_joint_without_an_actuator_is_named():
    card = ROBOTS["jaco"].gripper
    gripper = replace(card, targets={**card.targets, "THJ1": (0.0, 1.0)})
    with pytest.raises(ToolkitError, match="role THJ1 has a target, but joint 'joint_thumb_distal' has no actuator"):
        match([ROBOTS["kinova3"], replace(ROBOTS["jaco"], gripper=gripper)])

"""From a recorded hand to a robot hand: distances and inverse kinematics."""

import mink
import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from grippers.gripper import COMMANDED_ROLES
from robots import ROBOTS
from tasks.dexycb.recording import FINGERS, JOINT_NAMES
from tasks.objects import OBJECTS
from tasks.pick import START_ROTATION
from toolkit.demonstrations.retargeting import DIGIT, REACHABLE, HandModel, touching
from toolkit.errors import ToolkitError
from toolkit.simulation.plant import CLOSING

BOX, CAN = OBJECTS["061_foam_brick"], OBJECTS["005_tomato_soup_can"]


# -- distances -----------------------------------------------------------------------------------------------


def test_a_finger_touches_with_its_last_bone():
    joints = np.full((21, 3), 1.0)
    for part, height in (("dip", 0.06), ("tip", BOX.half_size[2] + 0.01)):
        joints[JOINT_NAMES.index(f"index_{part}")] = [0, 0, height]
    np.testing.assert_array_equal(touching(BOX, np.eye(4), joints), [0, 1, 0, 0, 0])
    joints[JOINT_NAMES.index("index_tip"), 2] += 0.005
    assert 0 < touching(BOX, np.eye(4), joints)[1] < 1


# -- inverse kinematics --------------------------------------------------------------------------------------


def test_the_palm_is_found_from_its_own_knuckles():
    hand = HandModel(ROBOTS["adroit"], BOX)
    R, p = Rotation.from_rotvec([0.4, -1.0, 2.0]).as_matrix(), np.array([0.3, -0.2, 1.0])
    joints = np.zeros((21, 3))
    joints[[0, *(JOINT_NAMES.index(f"{finger}_mcp") for finger in FINGERS[1:])]] = hand._palm_points @ R.T + p
    found = hand.palm_pose(joints)
    np.testing.assert_allclose(found[0], R, atol=1e-9)
    np.testing.assert_allclose(found[1], p, atol=1e-9)
    data = mujoco.MjData(hand.model)
    data.qpos[:] = hand.start(joints)
    mujoco.mj_kinematics(hand.model, data)
    body = data.body(hand._palm)
    np.testing.assert_allclose(body.xpos, p, atol=1e-9)
    np.testing.assert_allclose(body.xmat.reshape(3, 3), R, atol=1e-9)


def test_a_hand_without_five_fingers_is_refused():
    with pytest.raises(ToolkitError, match="gripper robotiq85 has no joint .*; recordings of hands need a hand with five fingers"):
        HandModel(ROBOTS["kinova3"], BOX)


def test_the_robot_hand_follows_within_its_limits(demonstration):
    """Errors again from the configurations alone, by MuJoCo's own kinematics."""
    motion, recording = demonstration.motion, demonstration.recording
    model, wanted = demonstration.hand, demonstration.scene.joints(recording)
    hinges = np.flatnonzero(model.jnt_type == mujoco.mjtJoint.mjJNT_HINGE)
    angles, ranges = motion.qpos[:, model.jnt_qposadr[hinges]], model.jnt_range[hinges]
    assert (angles >= ranges[:, 0] - 1e-6).all() and (angles <= ranges[:, 1] + 1e-6).all()
    data, errors = mujoco.MjData(model), []
    for frame, qpos in zip(motion.frames, motion.qpos, strict=True):
        data.qpos[:] = qpos
        mujoco.mj_kinematics(model, data)
        tips = [wanted[frame, JOINT_NAMES.index(f"{finger}_tip")] for finger in FINGERS]
        errors.append([np.linalg.norm(data.site(f"tip/{f}").xpos - tip) for f, tip in zip(FINGERS, tips, strict=True)])
    np.testing.assert_allclose(motion.tip_error, errors, atol=1e-9)
    mean = motion.tip_error.mean()
    assert mean < 0.010, f"fingertips are {1e3 * mean:.1f} mm off on average"
    assert set(motion.infeasible) == {int(f) for f, e in zip(motion.frames, errors, strict=True) if max(e) > REACHABLE}


def test_touching_fingers_are_told_to_close(demonstration):
    motion, scene = demonstration.motion, demonstration.scene
    assert np.abs(motion.commands).max() <= 1.0
    at = int(np.searchsorted(motion.frames, scene.grasped))
    for finger in ("thumb", "index", "middle"):
        mine = motion.commands[at][[role in DIGIT[finger].joints for role in COMMANDED_ROLES]]
        np.testing.assert_allclose(mine, 1.0, atol=1e-9, err_msg=finger)
    early = motion.commands[0][CLOSING].mean()
    assert early < -0.3, f"the hand comes with its closing at {early:.2f}"


def test_the_grasp_frame_is_the_plants(demonstration):
    """The same palm as on the robot: from the palm's pose to the grasp frame's as the whole robot has it."""
    from toolkit.simulation.laws import native_plant

    plant = native_plant(ROBOTS["adroit"], demonstration.scene.task)
    plant.begin(0)
    prefix = "gripper0_right_"
    palm, site = plant.data.body(f"{prefix}palm"), plant.data.site(f"{prefix}grip_site")
    there = palm.xmat.reshape(3, 3).T @ (site.xpos - palm.xpos)
    motion, data = demonstration.motion, mujoco.MjData(demonstration.hand)
    data.qpos[:] = motion.qpos[5]
    mujoco.mj_kinematics(demonstration.hand, data)
    palm = data.body("gripper0_palm")
    here = palm.xmat.reshape(3, 3).T @ (motion.grasp_position[5] - [0, 0, motion.raised] - palm.xpos)
    np.testing.assert_allclose(here, there, atol=1e-6)
    turned = np.linalg.norm(mink.SO3.from_matrix(motion.grasp_rotation[0] @ START_ROTATION.T).log())
    assert turned < 0.6, f"a palm that comes down flat starts {turned:.2f} rad from the robot's start"

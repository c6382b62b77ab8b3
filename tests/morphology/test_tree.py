"""Kinematic trees: Pinocchio against MuJoCo, two implementations of the same mechanics."""

import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from robots import ROBOTS
from toolkit.errors import ToolkitError
from toolkit.morphology.tree import KinematicTree

CONFIGURATIONS = 1000

every_robot = pytest.mark.parametrize("name", sorted(ROBOTS))


def random_configurations(model, tree, start, rng):
    """qpos (CONFIGURATIONS, nq): the tree's joints anywhere within their limits (a turn without), the rest at rest."""
    out = np.tile(start, (CONFIGURATIONS, 1))
    for joint in tree.joints:
        low, high = model.jnt_range[joint] if model.jnt_limited[joint] else (-np.pi, np.pi)
        out[:, model.jnt_qposadr[joint]] = rng.uniform(low, high, CONFIGURATIONS)
    return out


@pytest.fixture
def scene(native, name):
    robot = native(name)
    tree = KinematicTree(robot.model, "robot0_base")
    start = np.array(robot.data.qpos)
    return robot.model, tree, random_configurations(robot.model, tree, start, np.random.default_rng(1))


@every_robot
def test_frames_agree_with_mujoco(scene, name):
    model, tree, configurations = scene
    data = mujoco.MjData(model)
    shift = turn = 0.0
    for qpos in configurations:
        data.qpos[:] = qpos
        mujoco.mj_kinematics(model, data)
        for body in tree.bodies:
            placement = tree.body_placement(body, qpos)
            shift = max(shift, float(np.abs(placement.translation - data.xpos[body]).max()))
            turn = max(turn, float(np.abs(placement.rotation - data.xmat[body].reshape(3, 3)).max()))
    assert shift < 1e-9, f"{name}: a frame is off by {shift:.1e} m"
    assert turn < 1e-9, f"{name}: a frame is turned by {turn:.1e} rad"


@every_robot
def test_mass_matrix_less_armature_agrees_with_mujoco(scene, name):
    model, tree, configurations = scene
    data, full = mujoco.MjData(model), np.empty((model.nv, model.nv))
    dofs = model.jnt_dofadr[tree.joints]
    worst = 0.0
    for qpos in configurations:
        data.qpos[:] = qpos
        mujoco.mj_forward(model, data)
        mujoco.mj_fullM(model, full, data.qM)
        wanted = full[np.ix_(dofs, dofs)] - np.diag(model.dof_armature[dofs])
        worst = max(worst, float(np.abs(tree.mass_matrix(qpos) - wanted).max()))
    assert worst < 1e-8, f"{name}: mass matrices differ by {worst:.1e} kg m^2"


@every_robot
def test_the_tree_holds_every_joint_of_arm_and_gripper(scene, name):
    model, tree, _ = scene
    wanted = [
        model.joint(j).name for j in range(model.njnt) if model.joint(j).name.startswith(("robot0_", "gripper0_"))
    ]
    assert sorted(tree.names) == sorted(wanted)
    assert all(tree.parent(i) < i for i in range(len(tree.joints))), "a joint comes before its parent"


@every_robot
def test_a_screw_moves_its_link_as_mujoco_does(scene, name):
    """Moving one joint moves its body as the rotation about, or the slide along, the screw's axis does."""
    model, tree, configurations = scene
    data = mujoco.MjData(model)
    worst = 0.0
    for index, joint in enumerate(tree.joints):
        qpos = np.array(configurations[index])
        screw = tree.screws(qpos)[index]
        body, address = int(model.jnt_bodyid[joint]), int(model.jnt_qposadr[joint])
        data.qpos[:] = qpos
        mujoco.mj_kinematics(model, data)
        before = np.array(data.xpos[body])
        data.qpos[address] += 0.3
        mujoco.mj_kinematics(model, data)
        turned = screw.anchor + Rotation.from_rotvec(0.3 * screw.axis).apply(before - screw.anchor)
        wanted = before + 0.3 * screw.axis if screw.sliding else turned
        worst = max(worst, float(np.abs(wanted - data.xpos[body]).max()))
    assert worst < 1e-9, f"{name}: a link moves {worst:.1e} m off its screw"


@every_robot
def test_the_screws_carry_all_the_weight(scene, name):
    model, tree, configurations = scene
    carried = sum(screw.mass for screw in tree.screws(configurations[0]))
    root = model.body("robot0_base").id
    fixed = tree.pin_model.inertias[0].mass
    total = model.body_subtreemass[root]
    assert abs(carried + fixed - total) < 1e-9, f"{name}: {carried + fixed} kg in the tree, {total} kg in the scene"


def test_an_unknown_root_is_named(native):
    with pytest.raises(ToolkitError, match="no body 'robot7_base' to root the kinematic tree at"):
        KinematicTree(native("kinova3").model, "robot7_base")


def test_a_joint_of_another_kind_is_named():
    xml = """<mujoco><worldbody><body name="root"><geom size="0.1"/>
      <body name="link"><joint name="shoulder" type="ball"/><geom size="0.1"/></body></body></worldbody></mujoco>"""
    with pytest.raises(ToolkitError, match="joint 'shoulder' is neither hinge nor slide"):
        KinematicTree(mujoco.MjModel.from_xml_string(xml), "root")


def test_a_sliding_joint_slides():
    xml = """<mujoco><worldbody><body name="root" pos="1 0 0"><geom size="0.1"/>
      <body name="link" euler="0 90 0"><joint name="rail" type="slide" axis="0 0 1" ref="0.2"/><geom size="0.1"/></body>
      </body></worldbody></mujoco>"""
    model = mujoco.MjModel.from_xml_string(xml)
    data, tree = mujoco.MjData(model), KinematicTree(model, "root")
    data.qpos[:] = 0.7
    mujoco.mj_kinematics(model, data)
    link = model.body("link").id
    np.testing.assert_allclose(tree.body_placement(link, data.qpos).translation, data.xpos[link], atol=1e-12)

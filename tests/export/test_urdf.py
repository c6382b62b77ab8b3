"""The robot as URDF, against Pinocchio, the manifest and MuJoCo's couplings."""

import xml.etree.ElementTree as ET

import mujoco
import numpy as np
import pinocchio as pin
import pytest
from exported_targets import SHIPPED, plain

from toolkit.bundle.reading import load_bundle
from toolkit.export.packing import RECORDED_SEED
from toolkit.export.urdf import couplings, robot_urdf
from toolkit.morphology.native_scene import GRIP_SITE


@pytest.fixture(scope="module")
def urdf(native):
    """name -> (the URDF in Pinocchio, its text, robosuite's robot at its start)."""

    def make(name):
        robot, bundle = native(name), load_bundle(name)
        robot.begin(RECORDED_SEED)
        model = robot.model
        driven = {robot.robot.gripper.joints[role] for role in robot.robot.gripper.targets}
        text = robot_urdf(bundle.mjcf, bundle.manifest, couplings(model, driven, {model.joint(j).name: plain(model.joint(j).name)
                                                                                  for j in range(model.njnt)}))
        return pin.buildModelFromXML(text), text, robot

    return make


def postures(model, robot, rng):
    """The same random posture for Pinocchio and for robosuite's MuJoCo, and the dofs of both, joint by joint."""
    q, rows, columns = pin.neutral(model), [], []
    names = {plain(robot.model.joint(j).name): j for j in range(robot.model.njnt)}
    for joint in range(1, model.njoints):
        other = names[model.names[joint]]
        low, high = robot.model.jnt_range[other] if robot.model.jnt_limited[other] else (-np.pi, np.pi)
        angle, at = rng.uniform(low, high), model.joints[joint].idx_q
        robot.data.qpos[robot.model.jnt_qposadr[other]] = angle
        q[at : at + model.joints[joint].nq] = [angle] if model.joints[joint].nq == 1 else [np.cos(angle), np.sin(angle)]
        rows.append(model.joints[joint].idx_v)
        columns.append(int(robot.model.jnt_dofadr[other]))
    return q, rows, columns


@pytest.mark.parametrize("name", SHIPPED)
def test_pinocchio_finds_every_link_where_mujoco_does(urdf, name):
    """Links begin at their joints: what is compared is each joint's anchor and axis, each link's rotation and the grasp frame."""
    model, _, robot = urdf(name)
    data, rng, theirs = model.createData(), np.random.default_rng(1), robot.data
    for _ in range(20):
        q, rows, columns = postures(model, robot, rng)
        pin.framesForwardKinematics(model, data, q)
        mujoco.mj_forward(robot.model, theirs)
        grasp = data.oMf[model.getFrameId("grasp")]
        site = robot.model.site(GRIP_SITE).id
        np.testing.assert_allclose(grasp.translation, theirs.site_xpos[site], atol=1e-7)
        np.testing.assert_allclose(grasp.rotation.ravel(), theirs.site_xmat[site], atol=1e-7)
        for joint in range(1, model.njoints):
            other = next(j for j in range(robot.model.njnt) if plain(robot.model.joint(j).name) == model.names[joint])
            np.testing.assert_allclose(data.oMi[joint].translation, theirs.xanchor[other], atol=1e-7)
            link = data.oMf[model.getFrameId(plain(robot.model.body(robot.model.jnt_bodyid[other]).name), pin.BODY)]
            np.testing.assert_allclose(link.rotation.ravel(), theirs.xmat[robot.model.jnt_bodyid[other]], atol=1e-7)
        # Masses and inertias: what gravity does, and the mass matrix less the motors' rotors, which a URDF has no word for.
        gravity = pin.computeGeneralizedGravity(model, data, q)
        theirs.qvel[:] = 0.0
        mujoco.mj_forward(robot.model, theirs)
        np.testing.assert_allclose(gravity[rows], theirs.qfrc_bias[columns], atol=1e-5)
        mass = np.zeros((robot.model.nv, robot.model.nv))
        mujoco.mj_fullM(robot.model, mass, theirs.qM)
        found = pin.crba(model, data, q)
        found = np.triu(found) + np.triu(found, 1).T
        wanted = (mass - np.diag(robot.model.dof_armature))[np.ix_(columns, columns)]
        np.testing.assert_allclose(found[np.ix_(rows, rows)], wanted, atol=1e-6)


def test_limits_and_speeds_are_the_manifests(urdf):
    model, _, _ = urdf("jaco")
    for joint in load_bundle("jaco").manifest.joints:
        at = model.joints[model.getJointId(joint.name)]
        assert model.velocityLimit[at.idx_v] == joint.speed and model.effortLimit[at.idx_v] == joint.effort
        if joint.low is not None:
            assert (model.lowerPositionLimit[at.idx_q], model.upperPositionLimit[at.idx_q]) == (joint.low, joint.high)


@pytest.mark.parametrize("name, count", [("jaco", 3), ("iiwa", 4), ("kinova3", 0)])  # Kinova3's fingers are held by springs
def test_followers_stand_where_mujocos_couplings_want_them(urdf, name, count):
    _, text, robot = urdf(name)
    model, data = robot.model, robot.data
    at = {plain(model.joint(j).name): int(model.jnt_qposadr[j]) for j in range(model.njnt)}
    followers = {joint.get("name"): joint.find("mimic").attrib for joint in ET.fromstring(text.split("\n", 1)[1]).iter("joint")
                 if joint.find("mimic") is not None}
    assert len(followers) == model.neq == count
    said = {name: (row["joint"], float(row["multiplier"]), float(row["offset"])) for name, row in followers.items()}
    for joint in {leader for leader, _, _ in said.values()} - set(said):
        data.qpos[at[joint]] = 0.3
    for _ in said:  # as often as there are links in the longest chain
        for follower, (leader, multiplier, offset) in said.items():
            data.qpos[at[follower]] = multiplier * data.qpos[at[leader]] + offset
    mujoco.mj_forward(model, data)
    held = [int(model.eq_obj1id[e]) for e in range(model.neq)]
    np.testing.assert_allclose(data.ten_length[held], model.tendon_length0[held] + model.eq_data[:, 0], atol=1e-9)

"""The bundle's robot for other people's software: the scene that can be driven, and the URDF, each by another route than it was made."""

import shutil
import subprocess
import sys
import xml.etree.ElementTree as ET
from pathlib import Path

import mujoco
import numpy as np
import pinocchio as pin
import pytest

from toolkit.bundle.reading import find_bundle, load_bundle
from toolkit.errors import ToolkitError
from toolkit.export.packing import RECORDED_SEED
from toolkit.export.scene import scene_mjcf
from toolkit.export.urdf import couplings, robot_urdf
from toolkit.morphology.native_scene import BASE_SITE, GRIP_SITE

ROOT = Path(__file__).parents[2]
SHIPPED = ("jaco", "kinova3", "iiwa")
PREFIXES = ("robot0_", "gripper0_right_")


def plain(name):
    for prefix in PREFIXES:
        name = name.removeprefix(prefix)
    return "object" if name == "object_main" else name


def written(robot):
    return scene_mjcf(robot.model, robot.data, robot.robot.name, plain, {GRIP_SITE: "grasp", BASE_SITE: "base"})


# -- the scene ---------------------------------------------------------------------------------------------------------

SAME = {
    "body": ("pos", "quat", "mass", "inertia", "ipos", "iquat", "gravcomp"),
    "jnt": ("type", "pos", "axis", "range", "limited", "stiffness", "solref", "solimp", "margin"),
    "dof": ("damping", "armature", "frictionloss", "invweight0", "solref", "solimp"),
    "tendon": ("num", "stiffness", "damping", "length0", "lengthspring", "range", "limited", "invweight0"),
    "eq": ("type", "data", "solref", "solimp", "active0"),
    "actuator": ("gear", "gainprm", "biasprm", "ctrlrange", "ctrllimited", "forcerange", "forcelimited", "trnid"),
}


@pytest.mark.parametrize("name", (*SHIPPED, "panda"))
def test_the_scene_is_robosuites_number_by_number(native, name):
    robot = native(name)
    robot.begin(RECORDED_SEED)
    model, found = robot.model, mujoco.MjModel.from_xml_string(written(robot))
    for kind, keys in SAME.items():
        for key in keys:
            heavy = model.body_mass > 0 if key in ("ipos", "iquat") else slice(None)  # a body without mass has no centre of it
            wanted, got = (getattr(one, f"{kind}_{key}")[heavy] for one in (model, found))
            np.testing.assert_allclose(got, wanted, rtol=1e-6, atol=1e-9, err_msg=f"{kind}_{key}")
    np.testing.assert_array_equal(found.key_qpos[0], robot.data.qpos)
    for key in ("timestep", "gravity", "impratio", "cone", "integrator", "solver", "iterations", "tolerance", "density", "viscosity"):
        np.testing.assert_array_equal(getattr(found.opt, key), getattr(model.opt, key), err_msg=key)
    touching = [g for g in range(model.ngeom) if model.geom_contype[g] or model.geom_conaffinity[g]]
    for key in ("friction", "solref", "solimp", "margin", "gap", "condim", "priority", "contype", "conaffinity", "solmix"):
        np.testing.assert_array_equal(getattr(found, f"geom_{key}"), getattr(model, f"geom_{key}")[touching], err_msg=key)


def test_what_the_file_has_no_words_for_is_named():
    spec = mujoco.MjSpec.from_string(
        "<mujoco><worldbody><body name='a'><freejoint/><geom size='0.1'/></body></worldbody>"
        "<equality><weld name='glue' body1='a'/></equality></mujoco>"
    )
    model = spec.compile()
    with pytest.raises(ToolkitError, match="equality 'glue' of kind mjEQ_WELD"):
        scene_mjcf(model, mujoco.MjData(model), "x", plain, {})


@pytest.fixture
def folder(native, tmp_path):
    """A shipped bundle's files with the scene that this release writes."""

    def make(name):
        shutil.unpack_archive(find_bundle(name), tmp_path)
        robot = native(name)
        robot.begin(RECORDED_SEED)
        (tmp_path / name / "scene.xml").write_text(written(robot))
        return tmp_path / name

    return make


def drive(folder):
    return subprocess.run([sys.executable, ROOT / "docs" / "drive_scene.py", folder], capture_output=True, text=True)


@pytest.mark.slow
@pytest.mark.parametrize("name", SHIPPED)
def test_recorded_actions_drive_the_scene_along_the_recorded_episode(folder, name):
    """MuJoCo and NumPy alone, the law of torques written from the manifest: to 1e-4 rad and m."""
    done = drive(folder(name))
    assert done.returncode == 0, done.stdout + done.stderr


def test_a_scene_without_its_motors_force_is_found_out(folder):
    scene = folder("kinova3") / "scene.xml"
    tree = ET.parse(scene)
    for motor in tree.getroot().find("actuator"):
        if motor.get("biastype") == "affine":
            motor.set("gainprm", "1 0 0")
    tree.write(scene)
    done = drive(scene.parent)
    assert done.returncode == 1 and "object_m" in done.stdout, "the object is left behind"


# -- the URDF ----------------------------------------------------------------------------------------------------------


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

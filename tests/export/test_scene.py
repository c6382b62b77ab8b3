"""The scene that can be driven: robosuite's number by number, and driven by another route than it was made."""

import shutil
import subprocess
import sys
import xml.etree.ElementTree as ET
from pathlib import Path

import mujoco
import numpy as np
import pytest
from exported_targets import SHIPPED, plain

from toolkit.bundle.reading import find_bundle
from toolkit.errors import ToolkitError
from toolkit.export.packing import RECORDED_SEED
from toolkit.export.scene import scene_mjcf
from toolkit.morphology.native_scene import BASE_SITE, GRIP_SITE

ROOT = Path(__file__).parents[2]


def written(robot):
    return scene_mjcf(robot.model, robot.data, robot.robot.name, plain, {GRIP_SITE: "grasp", BASE_SITE: "base"})


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

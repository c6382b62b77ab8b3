"""docs/add-a-robot.md, done as a new user would: its code in a file of its own, nothing else touched."""

import importlib.util
import json
import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from grippers import GRIPPERS
from grippers.gripper import Gripper
from robots import ROBOTS
from toolkit.benchmarks.parity import parity
from toolkit.morphology.build import MergedRobot
from toolkit.morphology.matching import match
from toolkit.morphology.space import EvolutionSpace

PAGE = (Path(__file__).parents[2] / "docs" / "add-a-robot.md").read_text(encoding="utf-8")
CODE = re.findall(r"```python\n(.*?)```", PAGE, re.S)


@pytest.fixture(scope="module")
def folder(tmp_path_factory, checkout):
    """A checkout with the page's file in its robots/."""
    folder = checkout(tmp_path_factory.mktemp("user"))
    (folder / "robots" / "panda140.py").write_text(CODE[0])
    return folder


@pytest.mark.slow
def test_the_check_passes_and_the_robot_is_known(folder):
    done = subprocess.run(
        [sys.executable, "-m", "toolkit.cli", "robots", "--check", "panda140", "--json"],
        cwd=folder, env=os.environ | {"PYTHONPATH": str(folder)}, capture_output=True, text=True, check=False,
    )
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    assert found["findings"] == [] and len(found["start_arm_rad"]) == 7


@pytest.mark.slow
def test_the_merge_keeps_the_eighth_system(folder, task):
    spec = importlib.util.spec_from_file_location("panda140", folder / "robots" / "panda140.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    matching = match([ROBOTS["adroit"], module.PANDA140])
    pairs = [pair for pair in matching.pairs if pair.slot.startswith("arm")]
    assert [pair.proposed for pair in pairs] == [f"arm{i + 1}" for i in range(7)]
    figures = parity(MergedRobot(EvolutionSpace(matching), task), module.PANDA140)
    assert figures["arm_fk_error_m"] < 1e-6 and figures["arm_mass_matrix_rel_error"] < 1e-6
    assert figures["grasp_frame_drift_m"] < 1e-3
    assert figures["pad_position_error_m"] < 2e-3 and figures["pad_angle_error_deg"] < 2.0


def test_the_pages_gripper_is_pandas():
    names = {}
    exec(CODE[1], names)
    mine, theirs = names["PANDA_HAND"], GRIPPERS["panda_gripper"]
    assert isinstance(mine, Gripper)
    for field in ("robosuite_type", "joints", "targets", "rate", "preshape", "welded", "four_bar"):
        assert getattr(mine, field) == getattr(theirs, field), field


def test_the_messages_are_those_of_the_validator():
    """Each message of the page's table appears, up to its dots, in the tests that provoke it."""
    tests = (Path(__file__).parents[1] / "morphology" / "test_validation.py").read_text(encoding="utf-8").replace("\\", "")
    messages = re.findall(r"^\| [^|]+ \| `([^`]+)` \|$", PAGE, re.M)
    assert len(messages) >= 10
    for message in messages:
        core = max(re.split(r"\.\.\.|; | of a real", message), key=len)[:60].strip()
        assert core in tests, f"the page promises {core!r}, which no test provokes"


def test_what_the_page_says_of_sawyer_is_on_its_card():
    assert ROBOTS["sawyer"].arm_friction == {"right_j0": 80.0}
    assert 'arm_friction={"right_j0": 80.0}' in PAGE
    assert np.allclose(ROBOTS["panda"].base_position[0], -0.56)

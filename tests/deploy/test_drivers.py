"""What holds of every vendor's driver."""

import sys

import numpy as np
import pytest
from toy_commands import JOINTS, scene

from toolkit.deploy.arm import Command
from toolkit.deploy.drivers import franka, kortex, ros2, ur
from toolkit.errors import ToolkitError


@pytest.mark.parametrize("make", [
    lambda: ur.UniversalRobots("x", "ur5e", JOINTS[:6], scene, lambda *to: None, lambda: 1.0),
    lambda: franka.Franka("x", "panda", JOINTS, scene, 0.08),
])
def test_a_missing_vendor_package_is_named_with_its_cure(make, monkeypatch):
    for name in ("rtde_control", "rtde_receive", "franky"):
        monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(ToolkitError, match=r"install it: pip install 'meta-evolve\[(ur|franka)\]'"):
        make().connect()


@pytest.mark.parametrize("make", [
    lambda: ur.UniversalRobots("x", "ur5e", JOINTS[:6], scene, lambda *to: None, lambda: 1.0),
    lambda: franka.Franka("x", "panda", JOINTS, scene, 0.08),
    lambda: kortex.Kortex("x", "kinova3", JOINTS, scene, ("user", "secret")),
    lambda: ros2.Ros2(None, None, None, None, "iiwa", JOINTS, JOINTS, scene, lambda *to: None, lambda: 1.0),
])
def test_robosuites_deltas_are_refused_by_arms_that_do_not_know_them(make):
    with pytest.raises(ToolkitError, match="osc|robosuite deltas"):
        make().send(Command("osc", False, np.zeros(6), np.zeros(0), 0.0, 1.0, 0.08))

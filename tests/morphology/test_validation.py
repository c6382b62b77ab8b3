"""The likeliest mistakes of somebody who describes a new robot: each gets one sentence with culprit, value and mend."""

import os
import re
import subprocess
import sys
from dataclasses import replace

import pytest
from robosuite.models.grippers import PandaGripper, register_gripper
from robosuite.models.robots import UR5e
from robosuite.robots import register_robot_class

from grippers.cards import discover
from robots import ROBOTS
from robots.robot import Robot
from toolkit.errors import ToolkitError
from toolkit.morphology.posture import start_of
from toolkit.morphology.validation import findings, require_valid

CARD = ROBOTS["panda"]


def with_gripper(**change):
    return replace(CARD, gripper=replace(CARD.gripper, **change))


@register_robot_class("FixedBaseRobot")
class AlteredUR5e(UR5e):
    """robosuite's UR5e with something done to its XML in memory."""

    alter = staticmethod(lambda model: None)

    def __init__(self, idn=0):
        super().__init__(idn=idn)
        type(self).alter(self)


@register_gripper
class AlteredPandaGripper(PandaGripper):
    """robosuite's Panda hand with something done to its XML in memory."""

    alter = staticmethod(lambda model: None)

    def __init__(self, idn=0):
        super().__init__(idn=idn)
        type(self).alter(self)


@pytest.fixture
def altered_arm(monkeypatch):
    """Card of a UR5e whose XML a function alters."""

    def make(alter):
        monkeypatch.setattr(AlteredUR5e, "alter", staticmethod(alter))
        return replace(ROBOTS["ur5e"], name="mine", arm="AlteredUR5e")

    return make


@pytest.fixture
def altered_gripper(monkeypatch):
    """Card of a Panda whose gripper's XML a function alters."""

    def make(alter):
        monkeypatch.setattr(AlteredPandaGripper, "alter", staticmethod(alter))
        return replace(with_gripper(robosuite_type="AlteredPandaGripper"), name="mine")

    return make


def element(model, tag, name):
    return next(e for e in model.root.iter(tag) if (e.get("name") or "").endswith(name))


def only_finding(robot, sentence):
    """The one thing that is found, which loading the robot refuses with as well."""
    found = findings(robot)
    assert len(found) == 1, found
    assert re.search(sentence, found[0]), found[0]
    assert "\n" not in found[0]
    with pytest.raises(ToolkitError, match=sentence):
        start_of(robot)


@pytest.mark.parametrize("name", list(ROBOTS))
def test_nothing_is_wrong_with_the_registered_robots(name):
    assert findings(ROBOTS[name]) == []


# -- the ten likeliest ---------------------------------------------------------------------------------------


def test_a_missing_joint_is_named_with_those_that_there_are():
    robot = with_gripper(joints={"FFS": "finger_joint_1", "THS": "finger_joint2"})
    found = findings(robot)
    wanted = "gripper panda_gripper: role FFS names joint 'finger_joint_1', which its model lacks; it has finger_joint1, finger_joint2"
    assert found[0] == wanted
    with pytest.raises(ToolkitError, match=re.escape(wanted) + r".* \(and 1 more: meta-evolve robots --check panda\)"):
        require_valid(robot)


def test_degrees_are_told_from_radians():
    seed = (0.0, 11.25, 0.0, -150.0, 0.0, 168.5, 45.0)
    found = findings(replace(CARD, posture_seed=seed))
    assert len(found) == 5 - 1
    assert found[0] == "robot panda: posture_seed[1] = 11.25 is no angle in radians; 11.25 degrees are 0.1963 rad"


def test_millimetres_are_told_from_metres():
    found = findings(with_gripper(targets={"FFS": (40.0, 0.0), "THS": (-0.04, 0.0)}))
    assert found[0] == "gripper panda_gripper: target (40.0, 0.0) of role FFS is no value in m; it looks like millimetres"
    only_finding(replace(CARD, base_position=(-560.0, 0.0, 0.0)), "robot panda: base_position x = -560.0 lies metres away .* write metres")


def test_a_nan_is_no_angle():
    only_finding(replace(CARD, posture_seed=(float("nan"), *CARD.posture_seed[1:])), r"posture_seed\[0\] = nan is no angle")


def test_a_link_without_inertia_is_named(altered_gripper):
    def alter(model):
        body = element(model, "body", "leftfinger")
        for child in body.findall("inertial") + body.findall("geom") + body.findall("body"):
            body.remove(child)

    robot = replace(altered_gripper(alter), gripper=replace(CARD.gripper, robosuite_type="AlteredPandaGripper", welded={}))
    assert findings(robot) == []  # it takes a compiler to see that no geom and no child weighs anything
    with pytest.raises(ToolkitError, match="robot mine: link 'leftfinger' moves but has no mass or no inertia; give it an <inertial>"):
        start_of(robot)


def test_an_unknown_finger_role_is_refused_with_the_known_ones():
    with pytest.raises(ValueError, match="gripper panda_gripper: unknown role 'INDEX'; the roles are FFS, FFJ3, FFJ2"):
        with_gripper(joints={"INDEX": "finger_joint1", "THS": "finger_joint2"})


def test_swapped_limits_are_named(altered_arm):
    robot = altered_arm(lambda model: element(model, "joint", "elbow_joint").set("range", "3.1 -3.1"))
    only_finding(robot, "arm AlteredUR5e: joint 'elbow_joint' has the limits 3.1 to -3.1; swap them, the lower one comes first")


def test_a_missing_grasp_site_is_named(altered_gripper):
    def alter(model):
        eef = element(model, "body", "eef")
        eef.remove(element(model, "site", "grip_site"))

    only_finding(altered_gripper(alter), "gripper panda_gripper: its model has no site 'grip_site', the grasp frame; add one")


def test_a_missing_mesh_is_named_with_its_path(altered_arm):
    robot = altered_arm(lambda model: element(model, "mesh", "forearm").set("file", "/nowhere/forearm.stl"))
    only_finding(robot, "arm AlteredUR5e: mesh 'forearm' is missing: there is no file /nowhere/forearm.stl")


def test_an_axis_that_is_no_unit_vector_is_named_with_the_unit_vector(altered_arm):
    robot = altered_arm(lambda model: element(model, "joint", "elbow_joint").set("axis", "0 2 0"))
    only_finding(robot, r"arm AlteredUR5e: joint 'elbow_joint' has the axis \[0.0, 2.0, 0.0\] of length 2, not 1; write 0 1 0")


def test_a_zero_axis_is_named(altered_arm):
    robot = altered_arm(lambda model: element(model, "joint", "elbow_joint").set("axis", "0 0 0"))
    only_finding(robot, "of length 0, not 1; say about which direction it moves")


def test_an_actuator_on_a_passive_joint_is_named():
    card = ROBOTS["kinova3"]
    joints = {**card.gripper.joints, "FFJ2": "right_inner_knuckle_joint", "FFK": "right_outer_knuckle_joint"}
    found = findings(replace(card, gripper=replace(card.gripper, joints=joints)))
    assert any("drives joint 'right_outer_knuckle_joint', which plays FFK, a passive role; drive the outer knuckle" in f for f in found)
    with pytest.raises(ValueError, match="role 'FFK' is passive and cannot have a target"):
        replace(card.gripper, targets={"FFK": (0.0, 1.0)})


def test_two_robots_with_one_name_are_refused(tmp_path, monkeypatch):
    package = tmp_path / "twins"
    package.mkdir()
    (package / "__init__.py").write_text("")
    code = "from dataclasses import replace\nfrom robots import ROBOTS\nCARD = replace(ROBOTS['panda'])\n"
    for module in ("one", "other"):
        (package / f"{module}.py").write_text(code)
    monkeypatch.syspath_prepend(tmp_path)
    __import__("twins")
    monkeypatch.setattr("grippers.cards.BROKEN", {})
    assert list(discover("twins", Robot)) == ["panda"]
    from grippers.cards import BROKEN

    assert BROKEN == {"twins/other.py": "one.py and other.py in twins/ both describe 'panda'; rename one of the two"}


# -- and others ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "robot, sentence",
    [
        (replace(CARD, arm="Pandas"), "robot panda: robosuite knows no arm 'Pandas'; it has .*Panda.*UR5e"),
        (with_gripper(robosuite_type="Grabber"), "robot panda: robosuite knows no gripper 'Grabber'; it has .*PandaGripper"),
        (replace(CARD, posture_seed=CARD.posture_seed[:6]), "posture_seed has 6 angles, its arm 7 joints: joint1, "),
        (replace(CARD, arm_friction={"joint8": 1.0}), "arm_friction names joint 'joint8', which its arm lacks; it has joint1, "),
        (with_gripper(targets={"FFS": (0.05, 0.0), "THS": (-0.04, 0.0)}), "target 0.05 of role FFS lies outside .* 0 to 0.04"),
        (with_gripper(targets={"FFS": (0.04, 0.0)}), "actuator 'gripper_finger_joint2' drives role THS, which has no target; add"),
        (with_gripper(welded={"FFJ1": "left_tip"}), "role FFJ1 is welded to body 'left_tip', which its model has not .* finger_joint1_tip"),
    ],
)
def test_other_mistakes_are_named(robot, sentence):
    only_finding(robot, sentence)


def test_a_gripper_without_a_finger_is_refused():
    robot = with_gripper(robosuite_type="WipingGripper", joints={}, targets={}, welded={})
    only_finding(robot, "gripper panda_gripper: its model drives no joint, so no finger closes on an object; take one whose fingers have")


def test_a_slide_cannot_play_a_hinge():
    joints, targets = {"FFJ2": "finger_joint1", "THS": "finger_joint2"}, {"FFJ2": (0.04, 0.0), "THS": (-0.04, 0.0)}
    found = findings(with_gripper(joints=joints, targets=targets))
    assert found == ["gripper panda_gripper: joint 'finger_joint1' is a slide and cannot play FFJ2; give it FFS or THS"]


def test_a_card_that_does_not_load_is_one_sentence_on_the_command_line(tmp_path, checkout):
    """As a user sees it: one more card, broken."""
    checkout(tmp_path)
    card = (tmp_path / "robots" / "panda.py").read_text().replace('name="panda"', 'name="my panda"').replace("PANDA =", "MINE =")
    (tmp_path / "robots" / "mine.py").write_text(card)
    done = subprocess.run([sys.executable, "-m", "toolkit.cli", "robots"], capture_output=True, text=True, cwd=tmp_path,
                          env=os.environ | {"PYTHONPATH": str(tmp_path)})
    assert done.returncode == 2, done.stderr
    assert "a card in robots/ or grippers/ does not load: robot name 'my panda' is not an identifier" in done.stderr
    assert "Traceback" not in done.stderr

"""Physical inputs mean what they are taken for: unit, range, frame, order, norm, and what redundant data say of them.

Places: cards and the models that they name, the state of an arm (object, goal, gripper), recordings of hands.
"""

import re
import shutil
from dataclasses import replace

import numpy as np
import pytest
import yaml
from robosuite.models.grippers import GRIPPER_MAPPING
from robosuite.models.robots.robot_model import REGISTERED_ROBOTS

from robots import ROBOTS
from tasks.dexycb.recording import RecordingError, read_recording, sequences
from tasks.dexycb.standin import SERIALS, write_standin
from toolkit.bundle.reading import load_bundle
from toolkit.deploy.arm import ArmInfo, State
from toolkit.deploy.runtime import Runtime
from toolkit.errors import ToolkitError
from toolkit.morphology.validation import findings, require_valid

# -- cards ---------------------------------------------------------------------------------------------------


@pytest.fixture
def arm(monkeypatch):
    """Findings on the Panda with another law in its actuators, or other joints."""

    def found(change, every=True):
        class Odd(REGISTERED_ROBOTS["Panda"]):
            def __init__(self, idn=0):
                super().__init__(idn=idn)
                for actuator in list(self.actuator)[: None if every else 1]:
                    change(actuator, self)

        monkeypatch.setitem(REGISTERED_ROBOTS, "OddPanda", Odd)
        return findings(replace(ROBOTS["panda"], arm="OddPanda"))

    return found


def as_position(actuator, model):
    actuator.tag = "position"
    actuator.set("kp", "1500")
    actuator.set("ctrlrange", "-2.8 2.8")


def as_general(actuator, model):
    actuator.tag = "general"
    for key, value in {"biastype": "affine", "gainprm": "1500", "biasprm": "0 -1500 -150", "ctrlrange": "-2.8 2.8"}.items():
        actuator.set(key, value)


def tagged(tag, **entries):
    def change(actuator, model):
        actuator.tag = tag
        for key, value in entries.items():
            actuator.set(key, value)

    return change


LAWS = {
    "position": (as_position, "is a position servo, but operational-space control writes torques in N m to it; make it a <motor>"),
    "general position": (as_general, "is a position servo, but"),
    "velocity": (tagged("velocity", kv="10"), "is a <velocity> actuator, but"),
    "intvelocity": (tagged("intvelocity", kp="10"), "is a <intvelocity> actuator, but"),
    "damper": (tagged("general", biastype="affine", biasprm="0 0 -10", gainprm="10"), "is a velocity servo or an actuator with"),
    "gain": (tagged("general", gainprm="87"), "is a motor with a gain of 87, but"),
    "muscle": (tagged("general", gaintype="muscle"), "is an actuator with dynamics or a gain of its own, but"),
    "filter": (tagged("general", dyntype="filter"), "is an actuator with dynamics or a gain of its own, but"),
    "gear": (tagged("motor", gear="100"), "has a gear of 100, so its control is no torque of the joint"),
    "no limit": (lambda actuator, model: actuator.attrib.pop("ctrlrange"), "has the ctrlrange of none, which is no torque limit"),
    "normalised": (tagged("motor", ctrlrange="0 1"), "has the ctrlrange 0 1, which is no torque limit"),
    "one way": (tagged("motor", ctrlrange="0 87"), "has the ctrlrange 0 87"),
    "millinewtonmetres": (tagged("motor", ctrlrange="-87000 87000"), "no torque limit from 0.1 to 2000 N m"),
}


@pytest.mark.parametrize("name", LAWS)
def test_an_arms_actuators_are_motors_in_newton_metres(arm, name):
    change, said = LAWS[name]
    for every in (True, False):
        found = arm(change, every)
        assert len(found) == 1 and said in found[0] and "joint1" in found[0], found
        assert ("and so are 6 more" in found[0]) == every


def test_a_general_actuator_that_is_a_motor_is_one(arm):
    assert arm(tagged("general")) == arm(tagged("general", gainprm="1 0 0", biastype="none", gear="1")) == []


def test_every_shipped_card_is_sound():
    for name, robot in ROBOTS.items():
        assert findings(robot) == [], name


def test_an_arm_of_servos_is_matched_with_nothing(arm, monkeypatch):
    arm(as_position)
    with pytest.raises(ToolkitError, match="is a position servo"):
        require_valid(replace(ROBOTS["panda"], arm="OddPanda"))


def test_limits_in_degrees_are_not_taken_for_radians(arm):
    def degrees(actuator, model):
        joint = next(j for j in model.worldbody.iter("joint") if j.get("name") == actuator.get("joint"))
        joint.set("range", "-166 166")

    found = arm(degrees, every=False)
    assert len(found) == 1 and "write radians, not degrees: -2.8972 to 2.8972" in found[0]


@pytest.mark.parametrize("speeds, said", [
    ((150.0, *ROBOTS["panda"].joint_speeds[1:]), r"joint_speeds\[0\] = 150.0 .*2.6180 rad/s"),
    ((1.0,) * 6, "joint_speeds has 6 numbers, its arm 7"),
    ((-1.0, *ROBOTS["panda"].joint_speeds[1:]), r"joint_speeds\[0\] = -1.0"), ((float("nan"), *ROBOTS["panda"].joint_speeds[1:]), "= nan"),
])
def test_joint_speeds_are_radians_per_second(speeds, said):
    with pytest.raises(ToolkitError, match=said):
        require_valid(replace(ROBOTS["panda"], joint_speeds=speeds))


def test_a_grippers_actuators_take_positions(monkeypatch):
    class Odd(GRIPPER_MAPPING["PandaGripper"]):
        def __init__(self, idn=0):
            super().__init__(idn=idn)
            for actuator in self.actuator:
                actuator.tag = "motor"

    monkeypatch.setitem(GRIPPER_MAPPING, "OddGripper", Odd)
    found = findings(replace(ROBOTS["panda"], gripper=replace(ROBOTS["panda"].gripper, robosuite_type="OddGripper")))
    assert len(found) == 2 and all("is a motor, but targets are positions; make it a <position> servo" in f for f in found), found


# -- the state of an arm -------------------------------------------------------------------------------------


@pytest.fixture(scope="module", params=["kinova3", "jaco", "iiwa"])
def bundle(request):
    return load_bundle(request.param)


def info_of(bundle, fingers=True):
    manifest = bundle.manifest
    return ArmInfo(manifest.robot.name, tuple(joint.name for joint in manifest.joints), manifest.gripper.joints if fingers else (),
                   ("osc", "pose", "joint"), 100.0)


def start_of(bundle, fingers=True, **changes):
    g = bundle.golden
    wanted = float(np.interp(bundle.manifest.gripper.preshape, bundle.manifest.gripper.command, bundle.manifest.gripper.opening_m))
    state = State(0.0, g["episode_joints"][0], g["episode_object_position"][0], g["episode_object_quaternion"][0], g["episode_goal"],
                  g["episode_fingers"][0] if fingers else None, None if fingers else wanted / bundle.manifest.gripper.opening_m[0],
                  speeds=np.zeros(7), efforts=np.zeros(7))
    return replace(state, **changes)


def begun(bundle, state, fingers=True):
    return Runtime(bundle, info_of(bundle, fingers), "osc").begin(state, 0.0)


def test_what_was_recorded_is_plausible(bundle):
    assert begun(bundle, start_of(bundle)) is None
    assert begun(bundle, start_of(bundle, fingers=False), fingers=False) is None
    assert begun(bundle, start_of(bundle, object_quaternion=-start_of(bundle).object_quaternion)) is None, "q and -q turn alike"


@pytest.mark.parametrize("quaternion, kind, said", [
    ([0, 0, 0, 0], "implausible", "length 0, not 1"), ([2, 0, 0, 0], "implausible", "length 2, not 1"),
    ([1e-3, 0, 0, 0], "implausible", "length 0.001"), ([0, 0, 0, 1], "start_pose", "x, y, z, w; give w first"),
    ([0, 0, 0.1, np.sqrt(0.99)], "start_pose", "more than"), ([np.sqrt(0.5), np.sqrt(0.5), 0, 0], "start_pose", "turned by 1.571"),
    ([1, 0, 0, np.nan], "not_finite", "object_quaternion"),
])
def test_the_objects_quaternion_is_a_rotation_near_upright_w_first(bundle, quaternion, kind, said):
    fault = begun(bundle, start_of(bundle, object_quaternion=np.array(quaternion, float)))
    assert fault is not None and fault.kind == kind and said in fault.detail, fault


@pytest.mark.parametrize("quaternion", [[0, 0, 0, 0], [2, 0, 0, 0]])
def test_a_quaternion_that_stops_being_one_holds_the_arm(bundle, quaternion):
    runtime = Runtime(bundle, info_of(bundle), "osc")
    assert runtime.begin(start_of(bundle), 0.0) is None
    tick = runtime.tick(start_of(bundle, object_quaternion=np.array(quaternion, float)), 0.0)
    assert tick.command.hold and tick.fault.kind == "implausible"


@pytest.mark.parametrize("opening, kind, said", [
    (lambda o, m: 100 * o, "implausible", "percentage"), (lambda o, m: 1000 * m, "implausible", "millimetres"),
    (lambda o, m: m, "start_pose", "not metres"), (lambda o, m: 0.0, "start_pose", "not within 0.15"),
    (lambda o, m: -0.2, "implausible", "-0.2"),
    (lambda o, m: float("nan"), "not_finite", "opening is nan"), (lambda o, m: None, "not_finite", "opening is None"),
    (lambda o, m: 0.5 * o, "start_pose", "not within"),
])
def test_the_opening_is_a_share_of_the_widest(bundle, opening, kind, said):
    right = start_of(bundle, fingers=False).opening
    metres = right * bundle.manifest.gripper.opening_m[0]
    fault = begun(bundle, start_of(bundle, fingers=False, opening=opening(right, metres)), fingers=False)
    assert fault is not None and fault.kind == kind and said in fault.detail, fault


def test_an_opening_that_is_given_the_other_way_round_is_refused(bundle):
    """Where the preshape is half closed, either way round looks alike, so that only a clear difference can be told."""
    right = start_of(bundle, fingers=False).opening
    fault = begun(bundle, start_of(bundle, fingers=False, opening=1.0 - right), fingers=False)
    assert fault is not None and "0 closed, 1 open" in fault.detail


@pytest.mark.parametrize("change, kind", [
    (lambda f: np.degrees(f), "start_pose"), (lambda f: f + 0.4, "start_pose"), (lambda f: f[:-1], "state_shape"),
    (lambda f: np.append(f, 0.0), "state_shape"), (lambda f: f * np.nan, "not_finite"), (lambda f: f[None], "state_shape"),
])
def test_fingers_are_as_many_and_where_they_start(bundle, change, kind):
    good = start_of(bundle)
    fault = begun(bundle, replace(good, fingers=change(good.fingers)))
    assert fault is not None and fault.kind == kind, fault


@pytest.mark.parametrize("change, said", [
    ({"object_position": lambda p: p * 1000}, "0.03|from its place"), ({"object_position": lambda p: p - [0, 0, 0.8]}, "height of"),
    ({"object_position": lambda p: p + [0.05, 0, 0]}, "from its place"),
    ({"object_position": lambda p: p + [0, 0.15, 0]}, "from its place"),
    ({"object_position": lambda p: p + [0, 0, 0.05]}, "height of 0.87"),
    ({"object_position": lambda p: p[[2, 0, 1]]}, "from its place|height of"),
    ({"goal": lambda g: g * 1000}, "the goal lies"), ({"goal": lambda g: g - [0, 0, 0.8]}, "the goal lies 0.8"),
    ({"goal": lambda g: g + [0.5, 0, 0]}, "the goal lies 0.5"),
])
def test_object_and_goal_are_in_metres_in_the_task_frame(bundle, change, said):
    good = start_of(bundle)
    (key, move), = change.items()
    fault = begun(bundle, replace(good, **{key: move(getattr(good, key))}))
    assert fault is not None and fault.kind in ("start_pose", "object_lost"), fault
    assert re.search(said, fault.detail), fault.detail


def test_an_arm_that_moves_already_is_not_taken_over(bundle):
    fault = begun(bundle, start_of(bundle, speeds=np.array([0, 0.15, 0, 0, 0, 0, 0])))
    assert fault is not None and "let it come to rest" in fault.detail


# -- recordings ----------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    root = tmp_path_factory.mktemp("made") / "hands"
    write_standin(root, ["061_foam_brick", "009_gelatin_box"], 5, 0, 24)
    return root


@pytest.fixture
def hands(made, tmp_path):
    shutil.copytree(made, tmp_path / "hands")
    return tmp_path / "hands"


def rewrite(file, change):
    with np.load(file) as arrays:
        content = dict(arrays)
    change(content)
    np.savez(file, **content)


def invert(root, *keys):
    file = next(root.glob("calibration/extr*/*.yml"))
    content = yaml.safe_load(file.read_text().replace("!!python/tuple", ""))
    for key in keys or content["extrinsics"]:
        pose = np.vstack([np.array(content["extrinsics"][key]).reshape(3, 4), [0, 0, 0, 1]])
        content["extrinsics"][key] = np.linalg.inv(pose)[:3].ravel().tolist()
    file.write_text(yaml.safe_dump(content))


def every(root):
    """Each recording is refused; what is said of each."""
    said = []
    for name in sequences(root):
        with pytest.raises(RecordingError) as refused:
            read_recording(root, name)
        said.append(str(refused.value))
    return said


def test_what_is_made_is_sound(made):
    sides = [read_recording(made, name).side for name in sequences(made)]
    assert sides.count("left") == 2 and len(sides) == 10


def test_quaternions_w_first_are_told_by_the_labels(hands):
    for name in sequences(hands):
        rewrite(hands / name / "pose.npz", lambda a: a.update(pose_y=np.concatenate([a["pose_y"][..., 3:4], a["pose_y"][..., :3],
                                                                                     a["pose_y"][..., 4:]], -1)))
    assert all("its quaternions w first" in said for said in every(hands))


def test_labels_that_turn_an_object_otherwise_are_refused(hands):
    for name in sequences(hands):
        for file in (hands / name).glob("*/labels_*.npz"):
            rewrite(file, lambda a: a["pose_y"].__setitem__((0, slice(None), slice(0, 3)), a["pose_y"][0, :, [1, 2, 0]].T))
    assert all("turned as in pose.npz" in said and "120 degrees" in said for said in every(hands))


def test_a_tag_that_is_given_the_other_way_round_is_told_by_the_table(hands):
    invert(hands, "apriltag")
    assert all("check apriltag" in said and "tag to master" in said for said in every(hands))


def test_all_extrinsics_inverted_with_the_masters_labels_alone(hands):
    invert(hands)
    for folder in hands.glob(f"*/*/{SERIALS[1]}"):
        shutil.rmtree(folder)
    assert all("tag to master" in said for said in every(hands))


def test_a_second_camera_that_is_given_the_other_way_round(hands):
    """Where the master always sees the hand, its labels alone were once read."""
    invert(hands, SERIALS[1])
    assert all("camera to master" in said for said in every(hands))


def test_cameras_that_see_the_hand_in_two_places(hands):
    for name in sequences(hands):
        for file in (hands / name / SERIALS[1]).glob("labels_*.npz"):
            rewrite(file, lambda a: a.update(joint_3d=np.where(a["joint_3d"] == -1, a["joint_3d"], a["joint_3d"] + np.float32(0.08))))
    assert all("the hand within 0.05 m of where camera" in said for said in every(hands))


def test_a_left_hand_that_is_called_right(hands):
    for name in sequences(hands):
        file = hands / name / "meta.yml"
        text = file.read_text()
        file.write_text(text.replace("- right", "- LEFT").replace("- left", "- right").replace("- LEFT", "- left"))
    said = every(hands)
    assert sum("expected the right hand that joint_3d shows, found left" in one for one in said) == 8
    assert sum("expected the left hand that joint_3d shows, found right" in one for one in said) == 2


def test_an_object_that_only_slides_shows_a_table_that_leans():
    from tasks.dexycb.recording import _against_the_table

    way = np.zeros((5, 1, 3))
    way[:, 0] = [(0.3, 0.2, 0.05), (0.35, 0.2, 0.05), (0.4, 0.2, 0.06), (0.5, 0.2, 0.06), (0.5, 0.2, 0.06)]
    assert "rises 0.01 m" in _against_the_table(way, 0)[1]
    way[2:, 0, 2] = 0.2
    assert _against_the_table(way, 0) is None

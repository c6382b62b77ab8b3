"""What a vendor's interface calls "absent" becomes ours, for every driver: not NaN, not an empty list, not a traceback."""

import time
from types import SimpleNamespace

import numpy as np
import pytest

from toolkit.bundle.reading import load_bundle
from toolkit.deploy.drivers.franka import Franka
from toolkit.deploy.drivers.kortex import Kortex
from toolkit.deploy.drivers.ros2 import Ros2
from toolkit.deploy.drivers.ur import UniversalRobots
from toolkit.deploy.runtime import Runtime, TickLog, play
from toolkit.errors import ToolkitError

N = 7
NAN = [float("nan")] * N


@pytest.fixture(scope="module")
def bundle():
    return load_bundle("iiwa")


def scene_of(bundle):
    g = bundle.golden
    return lambda: (g["episode_object_position"][0], g["episode_object_quaternion"][0], g["episode_goal"], time.monotonic())


@pytest.fixture
def arm(bundle):
    names = [joint.name for joint in bundle.manifest.joints]
    published = []
    message = lambda: SimpleNamespace(joint_names=[], points=[])  # noqa: E731
    return Ros2(SimpleNamespace(publish=published.append), message, SimpleNamespace, lambda sec, nanosec: (sec, nanosec), "iiwa", names,
                names, scene_of(bundle), lambda *to: None, lambda: 1.0)


def told(arm, bundle, velocity=(0.0,) * N, effort=(0.0,) * N, position=None, names=None):
    names = list(arm.ros_names) if names is None else names
    position = bundle.golden["episode_joints"][0].tolist() if position is None else position
    now = time.monotonic()
    header = SimpleNamespace(stamp=SimpleNamespace(sec=int(now), nanosec=int(1e9 * (now % 1.0))))
    arm.heard(SimpleNamespace(header=header, name=names, position=position, velocity=list(velocity), effort=list(effort)))


def starts(arm, bundle):
    state = arm.read()
    fault = Runtime(bundle, arm.connect(), "joint").begin(state, state.stamp)
    return None if fault is None else fault.kind


ONE = [float("nan"), *[0.0] * (N - 1)]
ABSENT = {
    "all efforts": ({"effort": NAN}, ("speeds",)), "all speeds": ({"velocity": NAN}, ("efforts",)),
    "both": ({"effort": NAN, "velocity": NAN}, ()),
    "no list of efforts": ({"effort": []}, ("speeds",)), "no lists": ({"effort": [], "velocity": []}, ()),
    "one joint's effort": ({"effort": ONE}, ("speeds",)), "one joint's speed": ({"velocity": ONE}, ("efforts",)),
    "nothing": ({}, ("speeds", "efforts")),
}


@pytest.mark.parametrize("name", ABSENT)
def test_ros2_interfaces_that_are_not_there_do_not_keep_an_arm_from_starting(arm, bundle, name):
    message, there = ABSENT[name]
    told(arm, bundle, **message)
    state = arm.read()
    assert tuple(key for key in ("speeds", "efforts") if getattr(state, key) is not None) == there
    assert starts(arm, bundle) is None


def test_ros2_an_interface_that_was_there_is_missed(arm, bundle):
    """It is not taken for one that never was: a broken sensor holds the arm."""
    told(arm, bundle)
    assert starts(arm, bundle) is None
    told(arm, bundle, effort=NAN)
    assert np.isnan(arm.read().efforts).all() and starts(arm, bundle) == "effort"
    told(arm, bundle, velocity=[])
    assert starts(arm, bundle) == "joint_speed"


def test_ros2_a_position_that_is_not_there_is_never_absent(arm, bundle):
    told(arm, bundle, position=NAN)
    assert starts(arm, bundle) == "not_finite"
    told(arm, bundle, position=[])
    with pytest.raises(ToolkitError, match="names 7 joints and has 0 positions"):
        arm.read()


@pytest.mark.parametrize("first", ["arm", "gripper"])
def test_ros2_a_grippers_own_message_hides_no_arm(arm, bundle, first):
    gripper = lambda: told(arm, bundle, [0.0], [0.0], [0.1], ["finger_joint"])  # noqa: E731
    if first == "gripper":
        gripper()
        with pytest.raises(ToolkitError, match="no joint .*; it has finger_joint"):
            arm.read()
        told(arm, bundle)
    else:
        told(arm, bundle)
        gripper()
    assert starts(arm, bundle) is None
    stamp = arm.read().stamp
    gripper()
    assert arm._heard[0] <= stamp, "a gripper's message does not make the arm's look fresh"


def test_ros2_one_message_for_arm_and_gripper(arm, bundle):
    names = ["finger_joint", *arm.ros_names]
    told(arm, bundle, [0.0, *NAN], [0.0] * 8, [0.3, *bundle.golden["episode_joints"][0]], names)
    assert arm.read().speeds is None and starts(arm, bundle) is None


# -- other vendors -------------------------------------------------------------------------------------------


@pytest.fixture
def kortex(gen3, bundle, monkeypatch):
    """changes to the feedback -> a connected arm."""

    def connected(**changes):
        gen3.angles, gen3.opening, read = bundle.golden["episode_joints"][0], 1.0, gen3.RefreshFeedback
        arm = Kortex("here", "iiwa", [joint.name for joint in bundle.manifest.joints], scene_of(bundle), ("user", "secret"))
        arm.info = arm.connect()
        monkeypatch.setattr(gen3, "RefreshFeedback", lambda: SimpleNamespace(**vars(read()) | changes))
        return arm

    yield connected
    monkeypatch.undo()


EMPTY = SimpleNamespace(gripper_feedback=SimpleNamespace(motor=[]))


@pytest.mark.parametrize("changes, sentence", [
    ({"interconnect": EMPTY}, "reports no gripper"), ({"actuators": []}, "reports 0 joints, not 7"),
])
def test_kortex_without_a_gripper_or_with_other_joints_says_so(kortex, changes, sentence):
    """Protocol buffers give an empty list for what is not there."""
    arm = kortex(**changes)
    with pytest.raises(ToolkitError, match=sentence):
        arm.read()
    arm.stop("seen")


def test_an_arm_whose_driver_reads_nothing_is_stopped_not_left(kortex, bundle, gen3):
    arm = kortex(interconnect=EMPTY)
    outcome = play(Runtime(bundle, arm.info, "joint"), arm, TickLog(None, {}), "real")
    assert outcome.stopped.startswith("driver: the state could not be read") and ("stop",) in gen3.calls


@pytest.mark.parametrize("key, value", [("getActualQ", []), ("getActualQ", [0.0] * 5), ("getActualQd", []), ("getTargetMoment", [])])
def test_ur_before_its_first_package(bundle, key, value):
    """ur_rtde gives empty lists until then, and after a lost connection."""
    names = [joint.name for joint in bundle.manifest.joints]
    arm = UniversalRobots("10.0.0.1", "iiwa", names, scene_of(bundle), lambda *to: None, lambda: 1.0)
    answers = {"getActualQ": [0.0] * N, "getActualQd": [0.0] * N, "getTargetMoment": [0.0] * N} | {key: value}
    arm._receive = SimpleNamespace(isEmergencyStopped=lambda: False, isProtectiveStopped=lambda: False,
                                   isConnected=lambda: True, getTimestamp=time.monotonic,
                                   **{name: (lambda found=found: found) for name, found in answers.items()})
    if key == "getActualQ":
        with pytest.raises(ToolkitError, match=rf"reports {len(value)} joints, not 7"):
            arm.read()
    else:
        state = arm.read()
        assert (state.speeds is None) == (key == "getActualQd") and (state.efforts is None) == (key == "getTargetMoment")


def test_franka_without_a_hand_that_answers(bundle):
    names = [joint.name for joint in bundle.manifest.joints]
    arm = Franka("172.16.0.2", "iiwa", names, scene_of(bundle), 0.08)
    arm._arm = SimpleNamespace(state=SimpleNamespace(q=np.zeros(N), dq=np.zeros(N), tau_J=np.zeros(N),
                                               time=SimpleNamespace(to_sec=time.monotonic)), has_errors=False)
    for width in (float("nan"), -1.0, 8.0):
        arm._hand = SimpleNamespace(width=width)
        with pytest.raises(ToolkitError, match="the hand reports a width of"):
            arm.read()
    arm._hand = SimpleNamespace(width=0.04)
    assert arm.read().opening == 0.5
    arm._hand = SimpleNamespace(width=0.081)  # a millimetre more than the widest is measuring noise
    assert arm.read().opening == 1.0

"""The Gen3 driver against a fake: units, rates, faults, stamps. No vendor's package and no arm is needed."""

import sys
import time
from types import SimpleNamespace

import numpy as np
import pytest
from toy_commands import ANGLES, JOINTS, joint_command, scene

from toolkit.deploy.arm import ArmInfo, Command
from toolkit.deploy.drivers import kortex, ros2, streaming
from toolkit.errors import ToolkitError


@pytest.fixture
def gen3(gen3):
    gen3.angles = ANGLES.copy()
    return gen3


@pytest.fixture
def kinova(gen3):
    """A connected Gen3."""
    driver = kortex.Kortex("10.0.0.4", "kinova3", JOINTS, scene, ("user", "secret"))
    driver.info = driver.connect()
    yield driver
    driver.stop("test over")
    assert not gen3.open, "session and connection are closed"


def test_kortex_opens_a_session_and_speaks_degrees(gen3, kinova):
    assert kinova.info == ArmInfo("kinova3", JOINTS, (), ("joint",), 40.0)
    assert gen3.calls[:2] == [("connect", "10.0.0.4", 10000), ("session", "user", "secret")] and gen3.modes == [2]
    state = kinova.read()
    np.testing.assert_allclose(state.joints, ANGLES, atol=1e-9)
    assert state.opening == pytest.approx(0.75) and state.fault == "" and state.efforts[0] == pytest.approx(2.0, abs=0.1)
    gen3.rate = np.full(7, np.pi / 2)
    assert kinova.read().speeds == pytest.approx([np.pi / 2] * 7)


def test_kortex_feeds_speeds_at_its_own_rate_and_the_arm_arrives(gen3, kinova):
    """Ten ticks of 50 ms along a line: the arm, which only knows speeds, ends where it was sent, and slower than its maker allows."""
    goal, began = ANGLES + 0.1, time.monotonic()
    for tick in range(10):
        kinova.read()
        rows = np.linspace(ANGLES + 0.01 * tick, ANGLES + 0.01 * (tick + 1), 3)[1:]
        kinova.send(Command("joint", False, rows[-1], np.full(7, 0.2), 1.0, 0.25, 0.02, rows))
        time.sleep(0.05)
    kinova.read()
    kinova.send(Command("joint", False, goal, np.zeros(7), 0.0, 0.25, 0.02, np.repeat(goal[None], 2, axis=0)))
    spent = time.monotonic() - began
    assert 0.6 * 40 * spent < len(gen3.speeds) <= 42 * spent + 2, "40 Hz, on a busy machine a little less"
    time.sleep(0.1)
    np.testing.assert_allclose(kinova.read().joints, goal, atol=0.03)
    assert max(np.abs(rate).max() for _, rate in gen3.speeds) <= 1.396 + 1e-9
    grips = [call for call in gen3.calls if call[0] == "gripper"]
    assert grips == [("gripper", 3, 1, 0.75)], "0 is open there, and it is told once"


def test_kortex_never_asks_for_more_than_the_maker_allows(gen3, kinova, wait_for):
    far = ANGLES + 2.0
    kinova.read()
    kinova.send(Command("joint", False, far, np.full(7, 5.0), 0.0, 0.25, 0.02, np.repeat(far[None], 2, axis=0)))
    wait_for(lambda: gen3.speeds)
    np.testing.assert_allclose(gen3.speeds[0][1], [1.396] * 4 + [1.2217] * 3, atol=1e-9)


def test_kortex_does_not_falter_when_a_command_is_a_little_late(gen3, kinova):
    """After the last waypoint the speed is kept for one period, then only the lag is made up."""
    kinova.read()
    rows = np.repeat(ANGLES[None], 2, axis=0)
    command = Command("joint", False, ANGLES, np.full(7, 0.2), 0.0, 0.25, 0.02, rows)
    asked = [np.radians([joint.value for joint in kinova._speeds(command, age, ANGLES).joint_speeds]) for age in (0.0, 0.06, 0.08, 0.19)]
    np.testing.assert_allclose(asked, np.outer([0.2, 0.2, 0.0, 0.0], np.ones(7)), atol=1e-9)
    behind = np.radians([joint.value for joint in kinova._speeds(command, 0.1, ANGLES - 0.1).joint_speeds])
    np.testing.assert_allclose(behind, 0.1 * kortex.CORRECTION, atol=1e-9)


def test_kortex_stops_of_itself_when_commands_cease(gen3, kinova, wait_for):
    """The vendor's arm would go on for ever: the driver's thread is its watchdog."""
    kinova.read()
    rows = np.linspace(ANGLES, ANGLES + 0.01, 3)[1:]
    kinova.send(Command("joint", False, rows[-1], np.full(7, 0.2), 1.0, 0.25, 0.02, rows))
    wait_for(lambda: gen3.speeds)
    sent = time.monotonic()
    wait_for(lambda: ("stop",) in gen3.calls)
    assert time.monotonic() - sent < streaming.WATCHDOG + 0.3 and not gen3.rate.any()
    count, stops = len(gen3.speeds), gen3.calls.count(("stop",))
    time.sleep(0.1)
    assert len(gen3.speeds) == count and gen3.calls.count(("stop",)) == stops == 1


def test_kortex_holds_at_once_when_asked(gen3, kinova, wait_for):
    kinova.read()
    kinova.send(joint_command(count=2))
    wait_for(lambda: gen3.speeds)
    kinova.send(joint_command(hold=True, count=2))
    wait_for(lambda: ("stop",) in gen3.calls, 0.5)
    assert not gen3.rate.any() and sum(call[0] == "gripper" for call in gen3.calls) == 1, "a hold leaves the gripper alone"


def test_kortex_tells_faults_and_what_it_is_refused(gen3, kinova, wait_for):
    gen3.faults[2] = 16
    assert kinova.read().fault == "actuator 3 is in fault"
    gen3.faults[2], gen3.state = 0, kortex.IN_FAULT
    assert kinova.read().fault == "in fault"
    gen3.state, gen3.refuses = 7, "SendJointSpeedsCommand"
    kinova.send(joint_command(count=2))
    wait_for(lambda: "refuses" in kinova.read().fault)
    with pytest.raises(ToolkitError, match="the arm has stopped"):
        kinova.send(joint_command(count=2))
    gen3.refuses = "RefreshFeedback"
    with pytest.raises(ToolkitError, match="refuses or does not answer"):
        kinova.read()
    gen3.refuses, gen3.motors = "", 0
    with pytest.raises(ToolkitError, match="reports no gripper"):
        kinova.read()


def test_kortex_does_not_begin_with_an_arm_in_fault(gen3):
    gen3.state = kortex.IN_FAULT
    with pytest.raises(ToolkitError, match="not ready .in fault.; clear it on the arm"):
        kortex.Kortex("10.0.0.4", "kinova3", JOINTS, scene, ("user", "secret")).connect()
    assert not gen3.open and not gen3.modes
    for refused in ("SetServoingMode", "RefreshFeedback"):
        gen3.state, gen3.refuses = 7, refused
        with pytest.raises(ToolkitError, match=f"{refused} is refused"):
            kortex.Kortex("10.0.0.4", "kinova3", JOINTS, scene, ("user", "secret")).connect()
        assert not gen3.open, "no session is left behind"
    gen3.refuses = "CreateSession"
    with pytest.raises(ToolkitError, match="no Gen3 answers at 10.0.0.4 .*user and password"):
        kortex.Kortex("10.0.0.4", "kinova3", JOINTS, scene, ("user", "wrong")).connect()
    assert not gen3.open


def test_kortex_that_only_listens_leaves_the_arm_as_it_is(gen3):
    driver = kortex.Kortex("10.0.0.4", "kinova3", JOINTS, scene, ("user", "secret"))
    driver.listen()
    np.testing.assert_allclose(driver.read().joints, ANGLES, atol=1e-9)
    driver.stop("over")
    driver.stop("over")
    assert not gen3.modes and not gen3.speeds and not gen3.open and [call[0] for call in gen3.calls] == ["connect", "session"]


def test_kortex_says_that_it_is_not_connected(gen3):
    driver = kortex.Kortex("10.0.0.4", "kinova3", JOINTS, scene, ("user", "secret"))
    with pytest.raises(ToolkitError, match="10.0.0.4 is not connected; connect first"):
        driver.read()
    driver.connect()
    driver.stop("over")
    for ask in (driver.read, lambda: driver.send(joint_command(count=2))):
        with pytest.raises(ToolkitError, match="is not connected|has stopped: over"):
            ask()


def test_kortex_without_its_package_is_told_where_it_is(monkeypatch):
    monkeypatch.setitem(sys.modules, "kortex_api", None)
    with pytest.raises(ToolkitError, match="needs Kinova's kortex_api .* not on PyPI"):
        kortex.Kortex("10.0.0.4", "kinova3", JOINTS, scene, ("user", "secret")).connect()


def test_kortex_and_ros2_repeat_themselves_and_grow_old(gen3, kinova, monkeypatch):
    feedback = gen3.RefreshFeedback()
    row = feedback.actuators[0]
    monkeypatch.setattr(gen3, "RefreshFeedback", lambda: feedback)
    first = kinova.read().stamp
    ros = ros2.Ros2(None, None, None, None, "iiwa", JOINTS, JOINTS, scene, lambda *to: None, lambda: 1.0)
    message = SimpleNamespace(header=SimpleNamespace(stamp=SimpleNamespace(sec=10**9, nanosec=0)), name=list(JOINTS),
                              position=[0.0] * 7, velocity=[], effort=[])
    ros.heard(message)
    told = ros.read().stamp
    time.sleep(0.05)
    ros.heard(message)
    assert kinova.read().stamp == pytest.approx(first, abs=2e-3) and ros.read().stamp == pytest.approx(told, abs=2e-3)
    row.torque = 1.01
    message.header.stamp.nanosec = 50_000_000
    ros.heard(message)
    assert kinova.read().stamp > first + 0.04 and ros.read().stamp > told + 0.04

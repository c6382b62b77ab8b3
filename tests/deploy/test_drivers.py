"""Drivers against fakes: units, frames, rates, names, holds. No vendor's package and no arm is needed."""

import sys
import threading
import time
from types import SimpleNamespace

import numpy as np
import pytest

from toolkit.deploy.arm import ArmInfo, Command, check_fit
from toolkit.deploy.drivers import franka, kortex, ros2, ur
from toolkit.deploy.drivers.stamps import Changes, DeviceClock
from toolkit.deploy.kinematics import matrix_of, quaternion_of, rotation_of
from toolkit.errors import ToolkitError

JOINTS = tuple(f"joint_{i}" for i in range(1, 8))
ANGLES = np.array([0.1, -0.2, 0.3, -1.4, 0.5, 1.6, -0.7])


def scene():
    return np.array([-0.1, 0.0, 0.82]), np.array([1.0, 0, 0, 0]), np.array([-0.1, 0.1, 1.02]), time.monotonic()


def joint_command(hold=False, count=25, joints=ANGLES):
    rows = np.linspace(joints - 0.01, joints, count)
    rate = np.zeros(len(joints)) if hold else np.full(len(joints), 0.2)
    return Command("joint", hold, joints.copy(), rate, 0.0 if hold else 1.0, 0.25, 0.02, rows)


def pose_command():
    quaternion = quaternion_of(rotation_of(np.array([0.3, -0.2, 2.5])))
    pose = np.append([0.4, 0.1, 0.2], quaternion)
    return Command("pose", False, pose, np.array([0.1, 0, 0, 0, 0, 0.2]), 1.0, 0.25, 0.02, np.repeat(pose[None], 25, axis=0))


# -- Universal Robots --------------------------------------------------------------------------------------------------


class FakeControl:
    """Records what ur_rtde's control interface was asked, with its real signatures (ur_rtde 1.6.5)."""

    def __init__(self, hostname, frequency=-1.0, flags=1, ur_cap_port=50002, rt_priority=0):
        self.hostname, self.frequency, self.calls, self.kicks, self.accepts = hostname, frequency, [], 0, True

    def setWatchdog(self, min_frequency=10.0):
        self.watchdog = min_frequency

    def kickWatchdog(self):
        self.kicks += 1

    def initPeriod(self):
        return time.monotonic()

    def waitPeriod(self, start):
        time.sleep(max(0.0, start + 1 / self.frequency - time.monotonic()))

    def servoJ(self, q, speed, acceleration, time, lookahead_time, gain):
        self.calls.append(("servoJ", list(q), time, lookahead_time, gain))
        return self.accepts

    def servoL(self, pose, speed, acceleration, time, lookahead_time, gain):
        self.calls.append(("servoL", list(pose), time, lookahead_time, gain))
        return self.accepts

    def servoStop(self, a=10.0):
        self.calls.append(("servoStop", a))

    def stopScript(self):
        self.calls.append(("stopScript",))


@pytest.fixture
def arm(monkeypatch):
    """A connected UR with fakes behind it."""
    made = {}

    def control(*arguments):
        made["control"] = FakeControl(*arguments)
        return made["control"]

    receive = SimpleNamespace(getActualQ=lambda: ANGLES[:6].tolist(), getActualQd=lambda: [0.1] * 6, getTargetMoment=lambda: [5.0] * 6,
                              getTimestamp=lambda: made.get("seconds", time.monotonic() + 77.0),
                              isConnected=lambda: made.get("connected", True),
                              isEmergencyStopped=lambda: False, isProtectiveStopped=lambda: made.get("protective", False))
    monkeypatch.setitem(sys.modules, "rtde_control", SimpleNamespace(RTDEControlInterface=control))
    monkeypatch.setitem(sys.modules, "rtde_receive", SimpleNamespace(RTDEReceiveInterface=lambda host: receive))
    moved = []
    driver = ur.UniversalRobots("10.0.0.2", "ur5e", JOINTS[:6], scene, lambda *to: moved.append(to), lambda: 0.4)
    info = driver.connect()
    yield SimpleNamespace(driver=driver, info=info, made=made, moved=moved)
    driver.stop("test over")


def test_ur_streams_every_waypoint_at_the_arms_rate(arm, wait_for):
    assert arm.info == ArmInfo("ur5e", JOINTS[:6], (), ("joint", "pose"), 500.0)
    control = arm.made["control"]
    assert control.frequency == 500.0 and control.watchdog == 10.0
    command = joint_command(joints=ANGLES[:6])
    assert arm.driver.send(command) is command
    wait_for(lambda: len(control.calls) > 3)
    names = {call[0] for call in control.calls}
    assert names == {"servoJ"}
    rows = command.waypoints.tolist()
    sent = [call[1] for call in control.calls]
    assert all(row in rows for row in sent), "radians, as commanded"
    assert [rows.index(row) for row in sent] == sorted(rows.index(row) for row in sent), "in order"
    assert all(call[2:] == (1 / 500, ur.LOOKAHEAD, ur.GAIN) for call in control.calls)
    assert 0.03 <= ur.LOOKAHEAD <= 0.2 and 100 <= ur.GAIN <= 2000
    assert arm.moved == [(0.25, 0.02)]


def test_ur_holds_of_itself_when_commands_cease(arm, wait_for):
    arm.driver.send(joint_command(joints=ANGLES[:6]))
    control = arm.made["control"]
    wait_for(lambda: ("servoStop", ur.DECELERATION) in control.calls)
    count = len(control.calls)
    time.sleep(0.05)
    assert len(control.calls) == count and control.kicks > 0, "still, and its own watchdog fed"


def test_ur_holds_at_once_when_asked(arm, wait_for):
    arm.driver.send(joint_command(joints=ANGLES[:6]))
    control = arm.made["control"]
    wait_for(lambda: control.calls)
    arm.driver.send(joint_command(hold=True, joints=ANGLES[:6]))
    wait_for(lambda: control.calls[-1][0] == "servoStop")
    assert len(arm.moved) == 1, "a hold leaves the gripper alone"


def test_ur_poses_are_rotation_vectors_in_the_controllers_base(arm, wait_for):
    """Half a turn about z lies between robosuite's base and the controller's; the point in space is the same."""
    command = pose_command()
    position, vector = np.split(np.array(arm.driver.pose(command.target)), 2)
    turn = np.diag([-1.0, -1.0, 1.0])
    np.testing.assert_allclose(turn @ position, command.target[:3], atol=1e-12)
    np.testing.assert_allclose(turn @ rotation_of(vector), matrix_of(command.target[3:]), atol=1e-12)
    arm.driver.send(command)
    control = arm.made["control"]
    wait_for(lambda: control.calls)
    assert control.calls[0][0] == "servoL" and control.calls[0][1] == pytest.approx([*position, *vector])


def test_ur_reads_radians_newton_metres_and_its_own_stops(arm):
    state = arm.driver.read()
    assert state.joints.tolist() == ANGLES[:6].tolist() and state.opening == 0.4 and state.fault == ""
    assert state.efforts.tolist() == [5.0] * 6 and abs(time.monotonic() - state.stamp) < 1.0
    arm.made["protective"] = True
    assert arm.driver.read().fault == "protective stop"


def test_ur_that_refuses_a_command_says_so(arm, wait_for):
    arm.made["control"].accepts = False
    arm.driver.send(joint_command(joints=ANGLES[:6]))
    wait_for(lambda: arm.driver.read().fault)
    with pytest.raises(ToolkitError, match="refused a command"):
        arm.driver.send(joint_command(joints=ANGLES[:6]))


def test_ur_stops_once_and_for_all(arm):
    arm.driver.stop("enough")
    arm.driver.stop("enough")
    assert arm.made["control"].calls[-1] == ("stopScript",)
    assert not any(thread is arm.driver._streamer for thread in threading.enumerate())


# -- Franka ------------------------------------------------------------------------------------------------------------


class FakeFranky:
    """franky's names, with the arguments that franky 2.0 takes."""

    class Exception(RuntimeError):
        pass

    def __init__(self):
        self.moves, self.widths, self.stops, self.seconds = [], [], 0, None
        state = SimpleNamespace(q=ANGLES.tolist(), dq=[0.0] * 7, tau_J=[1.0] * 7, time=self)
        self.arm = SimpleNamespace(state=state, has_errors=False, relative_dynamics_factor=1.0, stop=self._stop,
                                   move=lambda motion, asynchronous=False: self.moves.append((motion, asynchronous)))
        self.hand = SimpleNamespace(width=0.06, stop=lambda: None, move_async=lambda width, speed: self.widths.append((width, speed)))
        for name in ("JointMotion", "JointState", "JointStopMotion", "CartesianStopMotion", "CartesianMotion", "CartesianState",
                     "RobotPose", "Affine"):
            setattr(self, name, lambda *arguments, name=name: (name, *arguments))

    def Robot(self, host):
        return self.arm

    def Gripper(self, host):
        return self.hand

    def _stop(self):
        self.stops += 1

    def to_sec(self):
        return time.monotonic() - 3.0 if self.seconds is None else self.seconds


@pytest.fixture
def franky(monkeypatch):
    fake = FakeFranky()
    monkeypatch.setitem(sys.modules, "franky", fake)
    return fake


def test_franka_moves_to_targets_and_comes_to_rest(franky):
    driver = franka.Franka("10.0.0.3", "panda", JOINTS, scene, 0.08)
    assert driver.connect() == ArmInfo("panda", JOINTS, (), ("joint", "pose"), 20.0)
    assert franky.arm.relative_dynamics_factor == franka.DYNAMICS <= 0.3, "slow unless somebody decides otherwise"
    command = joint_command()
    driver.send(command)
    driver.send(command)
    (motion, asynchronous), _ = franky.moves
    assert motion[0] == "JointMotion" and motion[1][0] == "JointState" and motion[1][1] is command.target and len(motion[1]) == 2
    assert asynchronous, "20 motions a second may not wait for one another"
    assert franky.widths == [(0.02, franka.GRIPPER_SPEED)], "metres, and once"


def test_franka_poses_have_the_scalar_last(franky):
    driver = franka.Franka("10.0.0.3", "panda", JOINTS, scene, 0.08)
    driver.connect()
    command = pose_command()
    driver.send(command)
    affine = franky.moves[0][0][1][1][1]
    assert affine[0] == "Affine" and affine[1].tolist() == command.target[:3].tolist()
    w, x, y, z = command.target[3:]
    assert affine[2].tolist() == [x, y, z, w]


def test_franka_reads_holds_and_stops(franky):
    driver = franka.Franka("10.0.0.3", "panda", JOINTS, scene, 0.08)
    driver.connect()
    state = driver.read()
    assert state.joints.tolist() == ANGLES.tolist() and state.opening == pytest.approx(0.75) and state.fingers is None
    franky.arm.has_errors = True
    assert driver.read().fault
    driver.send(joint_command(hold=True))
    assert franky.moves[-1][0] == ("JointStopMotion",) and not franky.widths
    driver.stop("done")
    driver.stop("done")
    assert franky.stops == 1


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


# -- Kinova Gen3 ---------------------------------------------------------------------------------------------------------


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
    assert time.monotonic() - sent < kortex.WATCHDOG + 0.3 and not gen3.rate.any()
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


def test_kortex_without_its_package_is_told_where_it_is(monkeypatch):
    monkeypatch.setitem(sys.modules, "kortex_api", None)
    with pytest.raises(ToolkitError, match="needs Kinova's kortex_api .* not on PyPI"):
        kortex.Kortex("10.0.0.4", "kinova3", JOINTS, scene, ("user", "secret")).connect()


# -- ROS 2 ---------------------------------------------------------------------------------------------------------------


def test_ros2_looks_joints_up_by_name_and_gives_seconds():
    published, names = [], [f"lbr_A{i}" for i in range(1, 8)]
    message = lambda: SimpleNamespace(velocities=[])  # noqa: E731
    driver = ros2.Ros2(SimpleNamespace(publish=published.append), message, message, lambda sec, nanosec: sec + 1e-9 * nanosec, "iiwa",
                       JOINTS, names, scene, lambda *to: None, lambda: 1.0)
    with pytest.raises(ToolkitError, match="nothing came on /joint_states"):
        driver.read()
    shuffled = names[::-1]
    stamp = SimpleNamespace(stamp=SimpleNamespace(sec=7, nanosec=5))
    driver.heard(SimpleNamespace(header=stamp, name=shuffled, position=ANGLES[::-1].tolist(), velocity=[], effort=list(range(7))))
    state = driver.read()
    assert state.joints.tolist() == ANGLES.tolist() and state.speeds is None and state.efforts.tolist() == list(range(6, -1, -1))
    command = joint_command(count=5)
    driver.send(command)
    trajectory = published[0]
    assert trajectory.joint_names == names
    assert [p.time_from_start for p in trajectory.points] == pytest.approx([0.01, 0.02, 0.03, 0.04, 0.05])
    assert trajectory.points[-1].positions == ANGLES.tolist() and trajectory.points[-1].velocities == command.rate.tolist()
    driver.stop("done")
    assert published[-1].points == [] and driver.read().fault == "done"
    driver.heard(SimpleNamespace(header=stamp, name=names[1:], position=[0.0] * 6, velocity=[], effort=[]))
    with pytest.raises(ToolkitError, match="no joint 'lbr_A1'"):
        driver.read()


# -- a state is as old as its device says ----------------------------------------------------------------------------------


def test_a_devices_clock_is_set_by_its_quickest_packet_and_stands_still_with_it():
    now = SimpleNamespace(at=100.0)
    clock = DeviceClock(lambda: now.at)
    assert clock(5.0) == pytest.approx(100.0)
    now.at = 100.25
    assert clock(5.1) == pytest.approx(100.1, abs=1e-3), "150 ms on its way"
    now.at = 100.6
    assert clock(5.1) == pytest.approx(100.1, abs=1e-3), "dead"
    clock, ages = DeviceClock(lambda: now.at), []
    for tick in range(20 * 600):  # ten minutes on a clock that is 200 ppm slow, with packets of 2 to 20 ms
        now.at = 101.0 + 0.05 * tick
        ages.append(now.at - clock(0.1 + (0.05 * tick - 0.002 - 0.018 * (tick % 7) / 6) * (1 - 2e-4)))
    assert 0.0 <= min(ages) and max(ages[20:]) < 0.035, f"{min(ages):.4f} to {max(ages[20:]):.4f} s"


def test_a_device_that_puts_its_clock_on_or_back_is_not_believed():
    """Otherwise a packet from the past, or a controller that has started again in the midst of an episode, would pass for fresh."""
    now = SimpleNamespace(at=100.0)
    clock = DeviceClock(lambda: now.at)
    for tick in range(30):
        now.at = 100.0 + 0.05 * tick
        assert clock(5.0 + 0.05 * tick) == pytest.approx(now.at, abs=1e-3)
    now.at += 0.05
    assert now.at - clock(0.3) > 5, "started again: old until the driver connects anew"
    assert now.at - clock(5.5) == pytest.approx(1.0, abs=1e-2), "a packet out of its order"
    assert clock(7.5) - now.at == pytest.approx(1.0, abs=1e-2), "in the future: no packet comes before it was measured"
    assert clock(6.5) == pytest.approx(now.at, abs=1e-2), "and all is well again"
    assert np.isnan(clock(float("nan")))
    late = DeviceClock(lambda: now.at)
    late(5.0)
    now.at += 0.05
    assert late(5.5) == pytest.approx(now.at), "the first packets may have waited longer than those that follow"
    now.at += 600.0
    assert late(605.62) == pytest.approx(now.at), "ten minutes between two episodes on a clock that is 200 ppm fast"


def test_a_state_that_does_not_change_grows_old():
    now = SimpleNamespace(at=1.0)
    changed = Changes(lambda: now.at)
    assert changed((1, 2)) == 1.0
    now.at = 2.0
    assert changed((1, 2)) == 1.0 and changed((1, 3)) == 2.0


def test_ur_says_when_it_measured_and_that_its_line_is_cut(arm):
    assert abs(time.monotonic() - arm.driver.read().stamp) < 0.1
    arm.made["seconds"] = time.monotonic() + 77.0
    first = arm.driver.read().stamp
    time.sleep(0.1)
    assert arm.driver.read().stamp == pytest.approx(first, abs=2e-3), "its receiver is dead, and stamps at reading would not tell"
    arm.made["connected"] = False
    assert "connection" in arm.driver.read().fault


def test_franka_says_when_it_measured(franky):
    driver = franka.Franka("10.0.0.3", "panda", JOINTS, scene, 0.08)
    driver.connect()
    assert abs(time.monotonic() - driver.read().stamp) < 0.1
    franky.seconds = time.monotonic() - 3.0
    first = driver.read().stamp
    time.sleep(0.1)
    assert driver.read().stamp == pytest.approx(first, abs=2e-3)


def test_kortex_and_ros2_repeat_themselves_and_grow_old(gen3, kinova, monkeypatch):
    feedback = gen3.RefreshFeedback()
    row = feedback.actuators[0]
    monkeypatch.setattr(gen3, "RefreshFeedback", lambda: feedback)
    kinova._cyclic = gen3
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


# -- what does not fit is refused by name ------------------------------------------------------------------------------


def facts(manifest):
    return {"robot": manifest.robot.name, "joints": tuple(j.name for j in manifest.joints), "fingers": manifest.gripper.joints,
            "forms": ("osc", "joint"), "rate_hz": 500.0}


@pytest.mark.parametrize("change, sentence", [
    ({"robot": "iiwa"}, "the driver moves robot 'iiwa', but the bundle is for 'kinova3'"),
    ({"joints": ("A",) * 7}, "joint 'A'"),
    ({"joints": ("Actuator1", "Actuator2", "Actuator3", "Actuator4", "Actuator5", "Actuator6")}, "the driver lacks joint 'Actuator7'"),
    ({"fingers": ("thumb",)}, "finger joint"),
    ({"angle_unit": "deg"}, "angles in 'deg', the bundle takes 'rad'"),
    ({"length_unit": "mm"}, "lengths in 'mm'"),
    ({"frame": "camera"}, "frame in 'camera'"),
    ({"forms": ("joint",)}, "takes no 'osc' commands"),
    ({"rate_hz": 10.0}, "slower than the policy"),
    ({"model_sha256": "0" * 64}, "not the model that the bundle was made on"),
])
def test_an_arm_that_does_not_fit_is_refused_by_name(change, sentence):
    from toolkit.bundle.reading import load_bundle

    manifest = load_bundle("kinova3").manifest
    check_fit(manifest, ArmInfo(**facts(manifest)), "osc")
    check_fit(manifest, ArmInfo(**facts(manifest) | {"joints": tuple(reversed(facts(manifest)["joints"]))}), "osc")  # by name
    with pytest.raises(ToolkitError, match=sentence):
        check_fit(manifest, ArmInfo(**facts(manifest) | change), "osc")

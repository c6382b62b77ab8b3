"""The UR driver against a fake: units, frames, rates, holds, stamps. No vendor's package and no arm is needed."""

import sys
import threading
import time
from types import SimpleNamespace

import numpy as np
import pytest
from toy_commands import ANGLES, JOINTS, joint_command, pose_command, scene

from toolkit.deploy.arm import ArmInfo
from toolkit.deploy.drivers import ur
from toolkit.deploy.kinematics import matrix_of, rotation_of
from toolkit.errors import ToolkitError


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
    feeding = arm.driver._streamer._thread
    assert feeding in threading.enumerate()
    arm.driver.stop("enough")
    arm.driver.stop("enough")
    assert arm.made["control"].calls[-1] == ("stopScript",)
    assert feeding not in threading.enumerate()


def test_ur_says_when_it_measured_and_that_its_line_is_cut(arm):
    assert abs(time.monotonic() - arm.driver.read().stamp) < 0.1
    arm.made["seconds"] = time.monotonic() + 77.0
    first = arm.driver.read().stamp
    time.sleep(0.1)
    assert arm.driver.read().stamp == pytest.approx(first, abs=2e-3), "its receiver is dead, and stamps at reading would not tell"
    arm.made["connected"] = False
    assert "connection" in arm.driver.read().fault

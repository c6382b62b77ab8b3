"""The Franka driver against a fake: units, frames, holds, stamps. No vendor's package and no arm is needed."""

import sys
import time
from types import SimpleNamespace

import pytest
from toy_commands import ANGLES, JOINTS, joint_command, pose_command, scene

from toolkit.deploy.arm import ArmInfo
from toolkit.deploy.drivers import franka


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


def test_franka_says_when_it_measured(franky):
    driver = franka.Franka("10.0.0.3", "panda", JOINTS, scene, 0.08)
    driver.connect()
    assert abs(time.monotonic() - driver.read().stamp) < 0.1
    franky.seconds = time.monotonic() - 3.0
    first = driver.read().stamp
    time.sleep(0.1)
    assert driver.read().stamp == pytest.approx(first, abs=2e-3)

"""Kinova Gen3 through Kinova's Kortex API, high level: a skeleton. Its conversions are tested against a fake; nothing of it
was run on hardware.

Kinova gives its wheel out on its own site, pinned to an old protobuf, so you make the session and pass its clients in:

    from kortex_api.autogen.client_stubs.BaseClientRpc import BaseClient
    from kortex_api.autogen.client_stubs.BaseCyclicClientRpc import BaseCyclicClient
    from kortex_api.autogen.messages import Base_pb2
    arm = Kortex(BaseClient(router), BaseCyclicClient(router), Base_pb2, "kinova3", joints, scene)

What it does: joint speeds over TCP at 40 Hz. What you must still do: make session and router with your arm's address and
account, set the servoing mode to single level, move the arm to the start posture, and try it without an object first.

Units of the vendor: degrees and degrees per second, joint angles from 0 to 360; torques in N m; the gripper from 0 open to
1 closed in commands, 0 to 100 in feedback. The ``duration`` of a speed command is not implemented by the vendor: the arm
goes on until it is told otherwise. Call ``watch`` from a thread of its own, or it will, too, when your program dies.
"""

import time
from collections.abc import Sequence
from typing import Any

import numpy as np

from toolkit.deploy.arm import ArmInfo, Command, State
from toolkit.deploy.drivers.stamps import Changes
from toolkit.deploy.drivers.ur import Scene
from toolkit.errors import ToolkitError

RATE = 40.0
"""[Hz] of Kinova's high-level commands."""
CORRECTION = 2.0
"""[1/s] by which a joint that lags is sped up: speeds alone would drift."""
WATCHDOG = 0.2
"""[s] without a command after which ``watch`` stops the arm."""


class Kortex:
    """A Gen3.

    Args:
        base, cyclic, messages: Kortex's BaseClient, BaseCyclicClient and Base_pb2.
        robot: the toolkit's name of the system.
        joints: names of the arm's joints in the bundle, base to flange.
        scene: reads the cameras.
    """

    def __init__(self, base: Any, cyclic: Any, messages: Any, robot: str, joints: Sequence[str], scene: Scene) -> None:
        self.base, self.cyclic, self.messages = base, cyclic, messages
        self.robot, self.names, self.scene = robot, tuple(joints), scene
        self._sent = float("inf")
        self._measured = np.zeros(len(self.names))
        self._changed = Changes()

    def connect(self) -> ArmInfo:
        """See Driver."""
        return ArmInfo(self.robot, self.names, (), ("joint",), RATE)

    def read(self) -> State:
        """See Driver. Degrees from 0 to 360 become radians from -pi to pi. Kortex gives no time: a state is as old as the last change of
        any angle, speed or torque, whose noise never rests.

        Raises:
            ToolkitError: another number of joints, or no gripper: Kortex gives empty lists for what is not there.
        """
        feedback = self.cyclic.RefreshFeedback()
        position, quaternion, goal, stamp = self.scene()
        actuators, motors = feedback.actuators, feedback.interconnect.gripper_feedback.motor
        if len(actuators) != len(self.names):
            raise ToolkitError(f"the arm reports {len(actuators)} joints, not {len(self.names)}; is it the arm that the bundle is for?")
        if not len(motors):
            raise ToolkitError("the arm reports no gripper; is one mounted, and set in the arm's own configuration?")
        changed = self._changed([(actuator.position, actuator.velocity, actuator.torque) for actuator in actuators])
        angles = np.radians([actuator.position for actuator in actuators])
        self._measured = (angles + np.pi) % (2 * np.pi) - np.pi
        return State(
            min(stamp, changed), self._measured, position, quaternion, goal,
            opening=1.0 - motors[0].position / 100.0,
            speeds=np.radians([actuator.velocity for actuator in actuators]),
            efforts=np.array([actuator.torque for actuator in actuators]),
        )  # fmt: skip

    def send(self, command: Command) -> Command:
        """See Driver.

        Raises:
            ToolkitError: another form than joint.
        """
        if command.form != "joint":
            raise ToolkitError(f"this driver takes joint commands, not {command.form!r}")
        self._sent = time.monotonic()
        if command.hold:
            self.base.Stop()
            return command
        lag = (command.target - self._measured + np.pi) % (2 * np.pi) - np.pi
        speeds = self.messages.JointSpeeds()
        for i, speed in enumerate(np.degrees(command.rate + CORRECTION * lag)):
            joint = speeds.joint_speeds.add()
            joint.joint_identifier, joint.value, joint.duration = i, float(speed), 0
        self.base.SendJointSpeedsCommand(speeds)
        gripper = self.messages.GripperCommand()
        gripper.mode = self.messages.GRIPPER_POSITION
        finger = gripper.gripper.finger.add()
        finger.finger_identifier, finger.value = 1, 1.0 - command.opening
        self.base.SendGripperCommand(gripper)
        return command

    def watch(self) -> bool:
        """Stop the arm if no command has come lately; returns whether it did. Call it every 50 ms from a thread of its own."""
        if not time.monotonic() - self._sent > WATCHDOG:
            return False
        self.stop("watchdog")
        return True

    def stop(self, reason: str) -> None:
        """See Driver."""
        self.base.Stop()
        self._sent = float("inf")

"""Franka arms through franky (pip install franky-control). Tested against a fake; never run on hardware.

    joint   JointMotion to the tick's target, at rest there, preempting the last one; Ruckig, inside franky, keeps speed,
            acceleration and jerk within the arm's limits at 1 kHz
    pose    CartesianMotion likewise, of the end effector that is set in Desk: it must be the manifest's grasp frame
    hold    JointStopMotion or CartesianStopMotion, Ruckig's own deceleration

franky speaks rad and m like the runtime; its quaternions are x y z w. Its base frame is the arm's own, as in robosuite.
Every motion ends at rest, so an arm whose runtime has gone stands still at its last target; the price is that the arm lags
behind the targets by more than a tick. The runtime's lead limit and tracking check bound how far.
"""

from collections.abc import Sequence
from types import ModuleType
from typing import Any

import numpy as np

from toolkit.deploy.arm import WALL, ArmInfo, Clock, Command, Scene, State
from toolkit.deploy.drivers.stamps import DeviceClock, least_fresh
from toolkit.errors import ToolkitError

RATE = 20.0
"""[Hz] at which targets are given; franky interpolates."""
DYNAMICS = 0.2
"""Share of the arm's own speed, acceleration and jerk limits that franky may use. Raise it once the first day went well."""
WIDTH_NOISE = 0.005
"""[m] by which a measured width may leave what the hand can open."""
GRIPPER_SPEED = 0.1
"""[m/s] of the jaws."""


class Franka:
    """A Panda or FR3.

    Args:
        host: address of the control box, FCI unlocked.
        robot: the toolkit's name of the system.
        joints: names of the arm's joints in the bundle, base to flange.
        scene: reads the cameras.
        width: of the open gripper [m], the bundle's gripper.opening_m[0].
        clock: of the stamps.
    """

    def __init__(
        self, host: str, robot: str, joints: Sequence[str], scene: Scene, width: float, clock: Clock = WALL
    ) -> None:
        self.host, self.robot, self.names, self.scene, self.width, self.clock = host, robot, tuple(joints), scene, width, clock
        self._franky: Any = None
        self._arm: Any = None
        self._hand: Any = None
        self._width_sent: float | None = None
        self._stamped = DeviceClock(self.clock.now)

    def listen(self) -> ArmInfo:
        """As ``connect``, but no setting of the arm is touched; franky moves an arm only when it is given a motion.

        Raises:
            ToolkitError: franky is not installed, or the arm does not answer.
        """
        self._franky = franky = _package()
        try:
            self._arm, self._hand = franky.Robot(self.host), franky.Gripper(self.host)
        except (RuntimeError, franky.Exception) as error:
            raise ToolkitError(f"no Franka answers at {self.host} ({error}); is FCI on, and does franky fit its version?") from None
        self._stamped = DeviceClock(self.clock.now)
        return ArmInfo(self.robot, self.names, (), ("joint", "pose"), RATE)

    def connect(self) -> ArmInfo:
        """See Driver.

        Raises:
            ToolkitError: as of ``listen``.
        """
        info = self.listen()
        self._arm.relative_dynamics_factor = DYNAMICS
        return info

    def read(self) -> State:
        """See Driver. Efforts are the measured link-side torques [N m], gravity included; the stamp is the
        controller's own.

        Raises:
            ToolkitError: the hand reports no width that it can have.
        """
        state = self._arm.state
        fault = "an error: recover it by hand" if self._arm.has_errors else ""
        position, quaternion, goal, stamp = self.scene()
        width = float(self._hand.width)
        if not -WIDTH_NOISE <= width <= self.width + WIDTH_NOISE:
            raise ToolkitError(f"the hand reports a width of {width:.3g} m, not from 0 to {self.width:.3f}; is it homed, and in metres?")
        stamp = least_fresh(self.clock.now(), stamp, self._stamped(float(state.time.to_sec())))
        return State(
            stamp, np.array(state.q, float), position, quaternion, goal,
            opening=float(np.clip(width / self.width, 0.0, 1.0)), speeds=np.array(state.dq, float),
            efforts=np.array(state.tau_J, float), fault=fault,
        )

    def send(self, command: Command) -> Command:
        """See Driver. Asynchronous: a new motion takes over from the last one without a jump.

        Raises:
            ToolkitError: robosuite's own deltas, which franky does not know; or the arm refuses the motion.
        """
        franky = self._franky
        if command.form == "osc":
            raise ToolkitError("franky knows no robosuite deltas; use joint or pose commands")
        try:
            self._arm.move(self._motion(command), asynchronous=True)
        except (RuntimeError, franky.Exception) as error:
            raise ToolkitError(f"the arm refuses a motion ({error})") from None
        if not command.hold and command.opening_m != self._width_sent:
            self._hand.move_async(command.opening_m, GRIPPER_SPEED)
            self._width_sent = command.opening_m
        return command

    def _motion(self, command: Command) -> Any:
        franky = self._franky
        if command.hold:
            return franky.JointStopMotion() if command.form == "joint" else franky.CartesianStopMotion()
        if command.form == "joint":
            return franky.JointMotion(franky.JointState(command.target))
        affine = franky.Affine(command.target[:3], np.roll(command.target[3:], -1))  # w x y z -> x y z w
        return franky.CartesianMotion(franky.CartesianState(franky.RobotPose(affine)))

    def stop(self, reason: str) -> None:
        """See Driver."""
        if self._arm is not None:
            self._arm.stop()
            self._hand.stop()
            self._arm = None


def _package() -> ModuleType:
    try:
        import franky
    except ImportError as error:
        raise ToolkitError(f"the Franka driver needs franky ({error}); install it: pip install 'meta-evolve[franka]'") from None
    return franky

"""Universal Robots e-series through ur_rtde (pip install ur-rtde). Tested against a fake; never run on hardware.

    joint   servoJ, every waypoint at the arm's 500 Hz, from a thread of its own
    pose    servoL, likewise; the tool centre point must be set on the pendant to the manifest's tool
    hold    servoStop, the controller's own deceleration

ur_rtde speaks rad and m like the runtime; a pose is a position and a rotation vector in the arm's base frame. That frame is
the controller's: it is turned by half a turn about z from the base body of robosuite's UR5e, as in ROS (base to base_link);
``base_turn`` says so. Its watchdog stops the robot program when no command has come for 100 ms; ours stops feeding it
so long after the last command as ``streaming.WATCHDOG`` says.
"""

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from types import ModuleType
from typing import Any

import numpy as np

from toolkit.deploy.arm import WALL, ArmInfo, Clock, Command, Grip, Scene, State
from toolkit.deploy.drivers.stamps import DeviceClock, least_fresh
from toolkit.deploy.drivers.streaming import Streamer
from toolkit.deploy.kinematics import matrix_of, vector_of
from toolkit.errors import ToolkitError

RATE = 500.0
"""[Hz] of an e-series controller."""
LOOKAHEAD, GAIN = 0.1, 300.0
"""servoJ's and servoL's smoothing time [s] (0.03 to 0.2) and gain (100 to 2000): Universal Robots' defaults."""
DECELERATION = 4.0
"""[m/s^2, rad/s^2] of a hold."""


class UniversalRobots:
    """An e-series arm.

    Args:
        host: address of the controller, in remote mode.
        robot: the toolkit's name of the system.
        joints: names of the arm's joints in the bundle, base to flange; UR's own order is the same.
        scene: reads the cameras.
        gripper: moves the gripper; a Robotiq takes 255 * (1 - opening) as its position byte.
        opening: reads how far it is open, 0 to 1.
        base_turn: rotation (3, 3) of the controller's base frame in the bundle's base frame.
        clock: of the stamps, and of the age of a command.
    """

    def __init__(
        self,
        host: str,
        robot: str,
        joints: Sequence[str],
        scene: Scene,
        gripper: Grip,
        opening: Callable[[], float],
        base_turn: np.ndarray | None = None,
        clock: Clock = WALL,
    ) -> None:
        self.host, self.robot, self.names, self.clock = host, robot, tuple(joints), clock
        self.scene, self.gripper, self.opening = scene, gripper, opening
        self.base_turn = np.diag([-1.0, -1.0, 1.0]) if base_turn is None else np.array(base_turn)
        self._control: Any = None
        self._receive: Any = None
        self._streamer = Streamer(clock)
        self._stamped = DeviceClock(self.clock.now)

    def listen(self) -> ArmInfo:
        """As ``connect``, but with the interface alone that reads: no program is started on the controller.

        Raises:
            ToolkitError: ur_rtde is not installed, or the controller does not answer.
        """
        _, receive = _package()
        try:
            self._receive = receive.RTDEReceiveInterface(self.host)
        except RuntimeError as error:
            raise ToolkitError(f"no robot answers at {self.host} ({error}); is it on?") from None
        self._stamped = DeviceClock(self.clock.now)
        return ArmInfo(self.robot, self.names, (), ("joint", "pose"), RATE)

    def connect(self) -> ArmInfo:
        """See Driver.

        Raises:
            ToolkitError: ur_rtde is not installed, or the controller does not answer.
        """
        control, receive = _package()
        try:
            self._receive = receive.RTDEReceiveInterface(self.host)
            self._control = moving = control.RTDEControlInterface(self.host, RATE)
        except RuntimeError as error:
            raise ToolkitError(f"no robot answers at {self.host} ({error}); is it on, and in remote mode?") from None
        self._stamped = DeviceClock(self.clock.now)
        moving.setWatchdog(10.0)  # [Hz] at least
        self._streamer.begin(_cycles(moving), partial(self._servo, moving), partial(moving.servoStop, DECELERATION))
        return ArmInfo(self.robot, self.names, (), ("joint", "pose"), RATE)

    def read(self) -> State:
        """See Driver. Efforts are the controller's target moments [N m]; currents are no torques. The stamp is the controller's own, so
        that a connection that has died grows old.

        Raises:
            ToolkitError: no angles: ur_rtde gives empty lists before the first package and after a lost connection.
        """
        receive = self._receive
        joints, speeds, efforts = (np.array(read(), float) for read in (receive.getActualQ, receive.getActualQd, receive.getTargetMoment))
        if len(joints) != len(self.names):
            raise ToolkitError(f"the arm reports {len(joints)} joints, not {len(self.names)}; is it still connected?")
        fault = self._streamer.trouble or ("" if receive.isConnected() else "the connection to the controller is lost")
        fault = fault or ("emergency stop" if receive.isEmergencyStopped() else "")
        fault = fault or ("protective stop" if receive.isProtectiveStopped() else "")
        position, quaternion, goal, stamp = self.scene()
        stamp = least_fresh(self.clock.now(), stamp, self._stamped(float(receive.getTimestamp())))
        return State(
            stamp, joints, position, quaternion, goal, opening=self.opening(),
            speeds=speeds if len(speeds) else None, efforts=efforts if len(efforts) else None, fault=fault,
        )

    def send(self, command: Command) -> Command:
        """See Driver. The waypoints go out one by one, 2 ms apart.

        Raises:
            ToolkitError: robosuite's own deltas, which this arm's controller does not know; or it has stopped.
        """
        if command.form == "osc":
            raise ToolkitError("a Universal Robots controller knows no robosuite deltas; use joint or pose commands")
        self._streamer.send(command)
        if not command.hold:
            self.gripper(command.opening, command.opening_m)
        return command

    def stop(self, reason: str) -> None:
        """See Driver."""
        self._streamer.end(reason)
        if self._control is not None:
            self._control.servoStop(DECELERATION)
            self._control.stopScript()
            self._control = None

    def _servo(self, control: Any, command: Command, age: float) -> None:
        """The waypoint that is due.

        Raises:
            ToolkitError: the controller does not take it.
        """
        row = command.waypoints[min(int(age * RATE), len(command.waypoints) - 1)]
        target = row.tolist() if command.form == "joint" else self.pose(row)
        servo = control.servoJ if command.form == "joint" else control.servoL
        if not servo(target, 0.0, 0.0, 1.0 / RATE, LOOKAHEAD, GAIN):  # speed and acceleration are not used by UR
            raise ToolkitError("the controller refused a command")

    def pose(self, row: np.ndarray) -> list[float]:
        """A pose (7,) in the bundle's base frame as UR's: x y z [m], rotation vector [rad], in the controller's base."""
        position, rotation = self.base_turn.T @ row[:3], self.base_turn.T @ matrix_of(row[3:])
        return [*position.tolist(), *vector_of(rotation).tolist()]


def _cycles(control: Any) -> Iterator[None]:
    """The controller's own periods."""
    while True:
        period = control.initPeriod()
        yield
        control.kickWatchdog()
        control.waitPeriod(period)


def _package() -> tuple[ModuleType, ModuleType]:
    try:
        import rtde_control
        import rtde_receive
    except ImportError as error:
        raise ToolkitError(f"the UR driver needs ur_rtde ({error}); install it: pip install 'meta-evolve[ur]'") from None
    return rtde_control, rtde_receive

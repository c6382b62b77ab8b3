"""Kinova Gen3 through Kinova's Kortex API, high level. Tested against a fake; never run on hardware.

    joint   joint speeds over TCP at 40 Hz, from a thread of its own: those of the waypoint that is due, and a correction of the lag
    hold    Stop, the arm's own deceleration

Kinova gives its wheel (kortex_api) out on its own site, not on PyPI, pinned to an old protobuf; it is imported only when the driver
connects. Units of the vendor: degrees and degrees per second, joint angles from 0 to 360; torques in N m; the gripper from 0 open to 1
closed in commands, 0 to 100 in feedback. The ``duration`` of a speed command is not implemented by the vendor: the arm goes on until it is
told otherwise, so the thread is its watchdog, and the session's own timeout is what is left if the whole program dies.
"""

import threading
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from toolkit.bundle.makers import JOINT_SPEEDS
from toolkit.deploy.arm import NEWS, WALL, ArmInfo, Clock, Command, Scene, State
from toolkit.deploy.drivers.stamps import Changes, least_fresh
from toolkit.deploy.drivers.streaming import Streamer
from toolkit.errors import ToolkitError

RATE = 40.0
"""[Hz] of Kinova's high-level commands."""
CORRECTION = 2.0
"""[1/s] by which a joint that lags is sped up: speeds alone would drift."""
PORT = 10000
"""TCP port of Kortex, as in Kinova's own examples."""
SESSION_TIMEOUT, CONNECTION_TIMEOUT = 10_000, 2_000
"""[ms] without a word after which the arm itself ends the session, and the connection: as in Kinova's own examples."""
IN_FAULT = 4
"""ARMSTATE_IN_FAULT of Kortex's ArmState."""


class _Api(NamedTuple):
    """What is used of kortex_api, under its own names."""

    TCPTransport: Any
    RouterClient: Any
    RouterClientSendOptions: Any
    SessionManager: Any
    BaseClient: Any
    BaseCyclicClient: Any
    Session_pb2: Any
    Base_pb2: Any
    errors: tuple[type[BaseException], ...]


class _Connection(NamedTuple):
    """What is there from ``listen`` or ``connect`` until ``stop``."""

    api: _Api
    transport: Any
    session: Any
    base: Any
    cyclic: Any


class Kortex:
    """A Gen3.

    Args:
        host: address of the arm.
        robot: the toolkit's name of the system.
        joints: names of the arm's joints in the bundle, base to flange; Kortex numbers them in the same order.
        scene: reads the cameras.
        account: user and password on the arm.
        clock: of the stamps and of the thread that feeds the arm.
    """

    def __init__(
        self, host: str, robot: str, joints: Sequence[str], scene: Scene, account: tuple[str, str], clock: Clock = WALL
    ) -> None:
        self.host, self.robot, self.names, self.scene, self.account, self.clock = host, robot, tuple(joints), scene, account, clock
        self._fastest = np.array(JOINT_SPEEDS.get(robot, (np.inf,) * len(self.names)))
        self._connection: _Connection | None = None
        self._line = threading.Lock()  # one request at a time: whether the router takes two is not said
        self._streamer = Streamer(clock)
        self._told: float | None = None
        self._measured = np.zeros(len(self.names))
        self._changed = Changes(clock.now)

    def listen(self) -> ArmInfo:
        """As ``connect``, but the arm's servoing mode stays as it is, and nothing is ever sent.

        Raises:
            ToolkitError: kortex_api is not installed, or the arm does not answer or does not know the account.
        """
        api = _package()
        transport, session = api.TCPTransport(), None
        try:
            transport.connect(self.host, PORT)
            router = api.RouterClient(transport, api.RouterClient.basicErrorCallback)
            wanted = api.Session_pb2.CreateSessionInfo()
            wanted.username, wanted.password = self.account
            wanted.session_inactivity_timeout, wanted.connection_inactivity_timeout = SESSION_TIMEOUT, CONNECTION_TIMEOUT
            sessions = api.SessionManager(router)
            sessions.CreateSession(wanted)
            session = sessions
            self._connection = _Connection(api, transport, session, api.BaseClient(router), api.BaseCyclicClient(router))
        except api.errors as error:
            _close(api, transport, session)
            raise ToolkitError(f"no Gen3 answers at {self.host} ({error}); is it on, and are user and password right?") from None
        return ArmInfo(self.robot, self.names, (), ("joint",), RATE)

    def connect(self) -> ArmInfo:
        """See Driver. Sets single-level servoing, and begins to feed the arm.

        Raises:
            ToolkitError: as of ``listen``; or the arm is in fault, or refuses the servoing mode.
        """
        info = self.listen()
        try:
            connection = self._connected
            trouble = self._complaint(self._ask(connection.cyclic.RefreshFeedback))
            if trouble:
                raise ToolkitError(f"the arm at {self.host} is not ready ({trouble}); clear it on the arm, by hand")
            mode = connection.api.Base_pb2.ServoingModeInformation()
            mode.servoing_mode = connection.api.Base_pb2.SINGLE_LEVEL_SERVOING
            self._ask(connection.base.SetServoingMode, mode)
        except ToolkitError:
            self._leave()
            raise
        self._told = None
        self._streamer.begin(self._cycles(), self._drive, self._halt)
        return info

    def read(self) -> State:
        """See Driver. Degrees from 0 to 360 become radians from -pi to pi. Kortex gives no time: a state is as old as the last change of
        any angle, speed or torque, whose noise never rests.

        Raises:
            ToolkitError: the arm does not answer, has another number of joints, or no gripper: Kortex gives empty lists for what is not
                there.
        """
        feedback = self._ask(self._connected.cyclic.RefreshFeedback)
        position, quaternion, goal, stamp = self.scene()
        actuators, motors = feedback.actuators, feedback.interconnect.gripper_feedback.motor
        if len(actuators) != len(self.names):
            raise ToolkitError(f"the arm reports {len(actuators)} joints, not {len(self.names)}; is it the arm that the bundle is for?")
        if not len(motors):
            raise ToolkitError("the arm reports no gripper; is one mounted, and set in the arm's own configuration?")
        changed = self._changed([(actuator.position, actuator.velocity, actuator.torque) for actuator in actuators])
        angles = np.radians([actuator.position for actuator in actuators])
        measured = (angles + np.pi) % (2 * np.pi) - np.pi
        self._measured = measured
        return State(
            least_fresh(self.clock.now(), stamp, changed), measured, position, quaternion, goal, opening=1.0 - motors[0].position / 100.0,
            speeds=np.radians([actuator.velocity for actuator in actuators]),
            efforts=np.array([actuator.torque for actuator in actuators], float), fault=self._streamer.trouble or self._complaint(feedback),
        )

    def _complaint(self, feedback: Any) -> str:
        """What the arm says of itself; empty if nothing. The base's own fault bits are no matter: they stay set after a fault is gone."""
        if feedback.base.active_state == IN_FAULT:
            return "in fault"
        bad = [i for i, actuator in enumerate(feedback.actuators) if actuator.fault_bank_a or actuator.fault_bank_b]
        return f"actuator {bad[0] + 1} is in fault" if bad else ""

    def send(self, command: Command) -> Command:
        """See Driver. The speeds go out 25 ms apart.

        Raises:
            ToolkitError: another form than joint; or the arm has stopped, or refuses what the gripper is told.
        """
        if command.form != "joint":
            raise ToolkitError(f"this driver takes joint commands, not {command.form!r}")
        self._streamer.send(command)
        if not command.hold and (self._told is None or abs(command.opening - self._told) >= NEWS):
            messages = self._connected.api.Base_pb2
            gripper = messages.GripperCommand()
            gripper.mode = messages.GRIPPER_POSITION
            finger = gripper.gripper.finger.add()
            finger.finger_identifier, finger.value = 1, 1.0 - command.opening
            self._ask(self._connected.base.SendGripperCommand, gripper)
            self._told = command.opening
        return command

    def stop(self, reason: str) -> None:
        """See Driver."""
        if self._streamer.end(reason):
            try:
                self._halt()
            except ToolkitError:
                pass  # it is gone: its own timeout stops it
        self._leave()

    def _cycles(self) -> Iterator[None]:
        """The driver's own periods: what is missed is not made up."""
        due = self.clock.now()
        while True:
            yield
            now = self.clock.now()
            due = max(due + 1.0 / RATE, now)
            self.clock.sleep(due - now)

    def _drive(self, command: Command, age: float) -> None:
        self._ask(self._connected.base.SendJointSpeedsCommand, self._speeds(command, age, self._measured))

    def _halt(self) -> None:
        self._ask(self._connected.base.Stop)

    def _speeds(self, command: Command, age: float, measured: np.ndarray) -> Any:
        """Kortex's message for the waypoint that is due. A next command that is late by less than a period does not make the arm falter;
        after that only the lag is made up. Never beyond the maker's speeds."""
        place = min(int(age * RATE), len(command.waypoints) - 1)
        rate = command.rate if age < (len(command.waypoints) + 1) / RATE else np.zeros(len(self.names))
        lag = (command.waypoints[place] - measured + np.pi) % (2 * np.pi) - np.pi
        speeds = self._connected.api.Base_pb2.JointSpeeds()
        for i, speed in enumerate(np.degrees(np.clip(rate + CORRECTION * lag, -self._fastest, self._fastest))):
            joint = speeds.joint_speeds.add()
            joint.joint_identifier, joint.value, joint.duration = i, float(speed), 0
        return speeds

    @property
    def _connected(self) -> _Connection:
        """The connection.

        Raises:
            ToolkitError: there is none, or no more.
        """
        if self._connection is None:
            raise ToolkitError(f"the arm at {self.host} is not connected; connect first")
        return self._connection

    def _ask(self, call: Any, *arguments: Any) -> Any:
        """One request to the arm.

        Raises:
            ToolkitError: it is refused, or not answered.
        """
        try:
            with self._line:
                return call(*arguments)
        except self._connected.api.errors as error:
            raise ToolkitError(f"the arm at {self.host} refuses or does not answer ({error})") from None

    def _leave(self) -> None:
        """End session and connection; may be called twice."""
        connection, self._connection = self._connection, None
        if connection is not None:
            _close(connection.api, connection.transport, connection.session)


def _close(api: _Api, transport: Any, session: Any) -> None:
    """End a session, if there is one, and its connection."""
    try:
        if session is not None:
            options = api.RouterClientSendOptions()
            options.timeout_ms = 1000
            session.CloseSession(options)
    except api.errors:
        pass  # the arm ends it by itself
    transport.disconnect()


def _package() -> _Api:
    try:
        from kortex_api.autogen.client_stubs.BaseClientRpc import BaseClient
        from kortex_api.autogen.client_stubs.BaseCyclicClientRpc import BaseCyclicClient
        from kortex_api.autogen.messages import Base_pb2, Session_pb2
        from kortex_api.Exceptions.KClientException import KClientException
        from kortex_api.Exceptions.KServerException import KServerException
        from kortex_api.RouterClient import RouterClient, RouterClientSendOptions
        from kortex_api.SessionManager import SessionManager
        from kortex_api.TCPTransport import TCPTransport
    except ImportError as error:
        raise ToolkitError(f"the Gen3 driver needs Kinova's kortex_api ({error}); its wheel is on Kinova's own site, not on PyPI") from None
    errors = (OSError, RuntimeError, KClientException, KServerException)
    return _Api(TCPTransport, RouterClient, RouterClientSendOptions, SessionManager, BaseClient, BaseCyclicClient, Session_pb2, Base_pb2,
                errors)

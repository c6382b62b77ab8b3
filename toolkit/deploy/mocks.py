"""Vendors' arms without vendors: the packages that the drivers import, by their own names, units, rates and stamps, around one mock arm.

The arm is kinematic: it goes where its vendor's interface sends it, behind by that interface's own lag, and carries off the object that
its gripper closes on. What it reports can be another state than its own (``MockArm.tell``), so that a lie comes to the runtime as the
vendor would tell it: in degrees, on the device's clock, as an exception.
"""

import math
import sys
import threading
import types
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any, Literal, NamedTuple

import mujoco
import numpy as np
from numpy.typing import ArrayLike

from toolkit.bundle.reading import Bundle
from toolkit.deploy.arm import ArmInfo, Clock, Command, Driver, Form, State
from toolkit.deploy.drivers import franka, kortex, ros2, ur
from toolkit.deploy.drivers.franka import Franka
from toolkit.deploy.drivers.kortex import Kortex
from toolkit.deploy.drivers.ros2 import GripperAction, JointOpening, open_arm
from toolkit.deploy.drivers.ur import UniversalRobots
from toolkit.deploy.kinematics import Kinematics, matrix_of, quaternion_of, rotation_of, vector_of
from toolkit.errors import ToolkitError

VendorName = Literal["ur", "franka", "kortex", "ros2"]
Trouble = Literal["", "refuses", "gone"]
"""refuses: no command is taken any more.  gone: nothing answers any more."""

DEVICE = 77.0
"""[s] by which a device's clock is ahead of ours: it counts from when it was switched on."""
STROKE_TIME = 0.6
"""[s] in which the gripper goes from open to closed: a 2F-85's 85 mm at its 150 mm/s, the fastest by Robotiq's manual."""
NEAR, PLAY = 0.05, 0.002
"""[m] of the object's centre from the grasp frame at which the gripper takes it, and [m] by which it may then be wider than the object."""
NOISE = 1e-3
"""[N m] of the torques' noise, which never rests."""
ENDED, STARTED = 0.01, 10.0
"""[s] of this machine's time after which a sleeper looks whether the others still live, and within which a thread must have started."""
DAMPING, ITERATIONS = 1e-4, 8
"""Of the damped least squares (Wampler 1986) that turn a pose into joint angles."""


class SimulatedClock:
    """A Clock that goes on only while all who take part sleep, and then to where the first of them wakes.

    Threads so wait for each other and not for this machine, whose own lateness is nobody's; one runs at a time, and what they do repeats
    exactly. The thread that makes it takes part, and whoever sleeps by it.
    """

    def __init__(self) -> None:
        self._now, self._turn, self._free = 0.0, threading.Condition(), False
        self._taking, self._asleep = [threading.current_thread()], dict[threading.Thread, float]()

    def now(self) -> float:
        """See Clock."""
        return self._now

    def sleep(self, seconds: float) -> None:
        """See Clock."""
        me = threading.current_thread()
        with self._turn:
            if self._free:
                return
            if me not in self._taking:
                self._taking.append(me)
            self._asleep[me] = self._now + max(0.0, seconds)
            self._turn.notify_all()
            while me in self._asleep and not self._free:
                self._pass_on()
                if me in self._asleep:
                    self._turn.wait(ENDED)
            self._asleep.pop(me, None)

    def _pass_on(self) -> None:
        """Wake whoever is first, if nobody is awake; of several the one that has taken part the longest."""
        self._taking = [thread for thread in self._taking if thread.is_alive()]
        if all(thread in self._asleep for thread in self._taking):
            first = min(self._taking, key=self._asleep.__getitem__)
            self._now = max(self._now, self._asleep.pop(first))
            self._turn.notify_all()

    def meet(self, others: int) -> None:
        """Wait until so many other threads have begun to take part: one that has only been started would be late for its own time."""
        with self._turn:
            self._turn.wait_for(lambda: sum(thread.is_alive() for thread in self._taking) > others, timeout=STARTED)

    @contextmanager
    def released(self) -> Iterator[None]:
        """Nobody sleeps meanwhile, and no time passes: for whoever waits that other threads end."""
        with self._turn:
            self._free = True
            self._turn.notify_all()
        try:
            yield
        finally:
            self._free = False


Way = Callable[[float], np.ndarray]
"""When [s, on the arm's clock] -> where: angles (n,) [rad]."""


class Report(NamedTuple):
    """What a vendor's interface has of its arm; not a number, where the arm does not say.

    Attributes:
        stamp: [s] on our clock.  joints: (n,) [rad].  speeds: (n,) [rad/s].  efforts: (n,) [N m].
        opening: 0 closed to 1 open.
        fault: what the arm complains of; empty if nothing.
    """

    stamp: float
    joints: np.ndarray
    speeds: np.ndarray
    efforts: np.ndarray
    opening: float
    fault: str


class MockArm:
    """A kinematic arm with a gripper over a table with an object, at the start of an episode.

    Args:
        bundle: whose arm, gripper and task it is.
        lag: time constant [s] with which a joint approaches the angle it is sent to.
        clock: by which it moves.

    Attributes:
        trouble: what ails its interface.

    Raises:
        ToolkitError: the bundle is too old to say where its episodes start.
    """

    def __init__(self, bundle: Bundle, lag: float, clock: Clock) -> None:
        self.manifest, self.lag, self.clock = bundle.manifest, lag, clock
        simulation = self.manifest.simulation
        if simulation is None:
            raise ToolkitError("the bundle's manifest has no simulation.starts (format version 2); export it again")
        self._starts = simulation.starts
        self._kinematics, self._solver = (Kinematics.of(bundle.manifest, bundle.mjcf) for _ in range(2))
        self._fingers = bundle.golden["episode_fingers"][0]  # poses are told for an open gripper
        self._speed = np.array([joint.speed for joint in self.manifest.joints])
        half = np.ravel(self.manifest.task.object.get("half_size_m", [0.0]))
        self._width, self._rest = 2.0 * float(min(half)), self.manifest.task.table_top_m + float(half[-1])
        self._lock = threading.RLock()
        self.begin(0)

    def begin(self, seed: int) -> None:
        """Stand at the start, the object where a seed's draws put it, as ``manifest.simulation.starts`` tells; report the truth."""
        with self._lock:
            manifest, starts = self.manifest, self._starts
            gripper = manifest.gripper
            shift_x, shift_y, yaw = np.random.default_rng(seed).uniform(starts.low, starts.high)
            self._joints, self._rates = np.array(manifest.start.arm_rad), np.zeros(len(manifest.joints))
            self._opening = float(np.interp(gripper.preshape, gripper.command, gripper.opening_m)) / gripper.opening_m[0]
            self._position = np.array([*manifest.task.object_xy_m, self._rest]) + [shift_x, shift_y, 0.0]
            self._rotation = rotation_of(np.array([0.0, 0.0, yaw]))
            self._goal = self._position + np.array(manifest.task.goal_offset_m)
            self._held: tuple[np.ndarray, np.ndarray] | None = None
            self._wanted = self._opening
            self._way: Way | None = _standing(self._joints)
            self._told: State | None = None
            self.trouble: Trouble = ""
            self._noise = np.random.default_rng(seed)
            self._at = self.clock.now()

    # -- what an interface makes it do

    def aim(self, joints: ArrayLike) -> None:
        """Go to angles (n,) [rad]."""
        with self._lock:
            self._go()
            self._way = _standing(np.array(joints, float))

    def follow(self, seconds: list[float], rows: np.ndarray) -> None:
        """Go along angles (k, n) [rad], each due so many seconds from now."""
        with self._lock:
            self._go()
            due, rows = np.append(self._at, self._at + np.array(seconds)), np.vstack([self._joints, rows])
            self._way = lambda now: np.array([np.interp(now, due, column) for column in rows.T])

    def reach(self, position: np.ndarray, rotation: np.ndarray) -> None:
        """Go where the grasp frame has a pose in the task frame: position (3,) [m], rotation (3, 3)."""
        with self._lock:
            self._go()
            joints, kinematics = self._joints.copy(), self._solver
            model, data = kinematics.model, kinematics.data
            dofs = [int(model.joint(joint.name).dofadr[0]) for joint in self.manifest.joints]
            jacobian = np.zeros((6, model.nv))
            for _ in range(ITERATIONS):
                kinematics.place(joints, self._fingers)
                error = np.append(position - kinematics.position, vector_of(rotation @ kinematics.rotation.T))
                mujoco.mj_comPos(model, data)
                mujoco.mj_jacSite(model, data, jacobian[:3], jacobian[3:], model.site("grasp").id)
                arm = jacobian[:, dofs]
                joints = joints + arm.T @ np.linalg.solve(arm @ arm.T + DAMPING * np.eye(6), error)
            self._way = _standing(joints)

    def drive(self, rates: np.ndarray) -> None:
        """Go on at speeds (n,) [rad/s] until told otherwise."""
        with self._lock:
            self._go()
            self._way = None
            self._rates = np.array(rates, float)

    def halt(self) -> None:
        """Stand still."""
        with self._lock:
            self._go()
            self._way, self._rates = _standing(self._joints), np.zeros_like(self._rates)

    def grip(self, opening: float) -> None:
        """Move the gripper to an opening, 0 closed to 1 open."""
        with self._lock:
            self._go()
            self._wanted = float(np.clip(opening, 0.0, 1.0))

    def _go(self) -> None:
        """Let what has been asked for come true until now."""
        now = self.clock.now()
        spent, self._at = now - self._at, now
        if spent <= 0.0:
            return
        if self._way is None:
            self._joints = self._joints + self._rates * spent
        else:
            step = (self._way(now) - self._joints) * (1.0 - math.exp(-spent / self.lag))
            step = np.clip(step, -self._speed * spent, self._speed * spent)
            self._joints, self._rates = self._joints + step, step / spent
        self._opening += float(np.clip(self._wanted - self._opening, -spent / STROKE_TIME, spent / STROKE_TIME))
        self._carry()

    def _carry(self) -> None:
        """The object goes with a gripper that has closed on it, and rests where one lets go of it."""
        widest = self.manifest.gripper.opening_m[0]
        self._kinematics.place(self._joints, self._fingers)
        position, rotation = self._kinematics.position, self._kinematics.rotation
        closed = self._opening * widest <= self._width + PLAY
        if closed and self._held is None and np.linalg.norm(self._position - position) < NEAR:
            self._held = rotation.T @ (self._position - position), rotation.T @ self._rotation
        if not closed:
            self._held = None
            self._position = np.array([*self._position[:2], self._rest])
        if self._held is not None:
            self._opening = max(self._opening, self._width / widest)
            self._position, self._rotation = position + rotation @ self._held[0], rotation @ self._held[1]

    # -- what it reports

    def state(self) -> State:
        """What is true now."""
        with self._lock:
            self._go()
            efforts = NOISE * self._noise.standard_normal(len(self._joints))
            return State(self._at, self._joints.copy(), self._position.copy(), quaternion_of(self._rotation), self._goal.copy(),
                         opening=self._opening, speeds=self._rates.copy(), efforts=efforts)

    def tell(self, state: State) -> None:
        """Report this from now on, whatever is true."""
        self._told = state

    def report(self) -> Report:
        """What it reports: its own state until told otherwise."""
        state = self._told or self.state()
        unknown = np.full(len(state.joints), np.nan)
        return Report(state.stamp, state.joints, unknown if state.speeds is None else state.speeds,
                      unknown if state.efforts is None else state.efforts, np.nan if state.opening is None else state.opening, state.fault)

    def seen(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
        """A scene: what cameras report, stamped now."""
        state = self._told or self.state()
        return state.object_position, state.object_quaternion, state.goal, self.clock.now()


def _standing(place: np.ndarray) -> Way:
    """A way that stays at one place."""
    return lambda now: place


# ---- the vendors' packages -------------------------------------------------------------------------------------------


def _module(name: str, **content: Any) -> types.ModuleType:
    made = types.ModuleType(name)
    made.__dict__.update(content)
    return made


def ur_package(arm: MockArm) -> dict[str, types.ModuleType]:
    """rtde_control and rtde_receive, by the signatures of ur_rtde 1.6."""
    turn = np.diag([-1.0, -1.0, 1.0])  # of the controller's base in robosuite's
    base, origin = matrix_of(np.array(arm.manifest.robot.base_quaternion)), np.array(arm.manifest.robot.base_position_m)

    class Control:
        def __init__(self, hostname: str, frequency: float = -1.0) -> None:
            self.period = 1.0 / frequency

        def setWatchdog(self, min_frequency: float = 10.0) -> None:
            pass

        def kickWatchdog(self) -> None:
            pass

        def initPeriod(self) -> float:
            return arm.clock.now()

        def waitPeriod(self, start: float) -> None:
            arm.clock.sleep(start + self.period - arm.clock.now())

        def servoJ(self, q: list[float], speed: float, acceleration: float, time: float, lookahead_time: float, gain: float) -> bool:
            if not arm.trouble:
                arm.aim(q)
            return not arm.trouble

        def servoL(self, pose: list[float], speed: float, acceleration: float, time: float, lookahead_time: float, gain: float) -> bool:
            if not arm.trouble:
                arm.reach(origin + base @ turn @ pose[:3], base @ turn @ rotation_of(np.array(pose[3:])))
            return not arm.trouble

        def servoStop(self, a: float = 10.0) -> None:
            arm.halt()

        def stopScript(self) -> None:
            arm.halt()

    def told(read: Callable[[Report], Any]) -> Callable[[], Any]:
        return lambda: [] if arm.trouble == "gone" else read(arm.report())

    receive = SimpleNamespace(
        getActualQ=told(lambda s: s.joints.tolist()), getActualQd=told(lambda s: s.speeds.tolist()),
        getTargetMoment=told(lambda s: s.efforts.tolist()), getTimestamp=lambda: arm.report().stamp + DEVICE,
        isConnected=lambda: arm.trouble != "gone", isEmergencyStopped=lambda: False,
        isProtectiveStopped=lambda: bool(arm.report().fault),
    )
    return {"rtde_control": _module("rtde_control", RTDEControlInterface=Control),
            "rtde_receive": _module("rtde_receive", RTDEReceiveInterface=lambda hostname: receive)}


def franka_package(arm: MockArm) -> dict[str, types.ModuleType]:
    """franky, by the names of its 1.0."""
    base, origin = matrix_of(np.array(arm.manifest.robot.base_quaternion)), np.array(arm.manifest.robot.base_position_m)
    widest = arm.manifest.gripper.opening_m[0]

    class FrankyError(RuntimeError):
        pass

    def check() -> None:
        if arm.trouble:
            raise FrankyError("connection lost" if arm.trouble == "gone" else "motion aborted by reflex")

    def move(motion: tuple[str, Any], asynchronous: bool = False) -> None:
        check()
        kind, value = motion
        if kind == "joint":
            arm.aim(value)
        elif kind == "cartesian":
            position, turn = value
            arm.reach(origin + base @ position, base @ matrix_of(np.roll(turn, 1)))  # x y z w -> w x y z
        else:
            arm.halt()

    class Robot:
        def __init__(self, host: str) -> None:
            self.relative_dynamics_factor, self.move, self.stop = 1.0, move, arm.halt

        @property
        def has_errors(self) -> bool:
            return bool(arm.report().fault)

        @property
        def state(self) -> SimpleNamespace:
            if arm.trouble == "gone":
                check()
            state = arm.report()
            return SimpleNamespace(q=state.joints.tolist(), dq=state.speeds.tolist(), tau_J=state.efforts.tolist(),
                                   time=SimpleNamespace(to_sec=lambda: state.stamp + DEVICE))

    class Gripper:
        def __init__(self, host: str) -> None:
            pass

        @property
        def width(self) -> float:
            return arm.report().opening * widest

        def move_async(self, width: float, speed: float) -> None:
            arm.grip(width / widest)

        def stop(self) -> None:
            pass

    passed = lambda value: value  # noqa: E731
    content = {
        "Robot": Robot, "Gripper": Gripper, "Exception": FrankyError, "Affine": lambda position, quaternion: (position, quaternion),
        "RobotPose": passed, "CartesianState": passed, "JointState": passed, "CartesianMotion": lambda state: ("cartesian", state),
        "JointMotion": lambda state: ("joint", state), "JointStopMotion": lambda: ("stop", None),
        "CartesianStopMotion": lambda: ("stop", None),
    }
    return {"franky": _module("franky", **content)}


class _Repeated(list):
    """protobuf's repeated field of messages."""

    def add(self) -> SimpleNamespace:
        self.append(SimpleNamespace())
        return self[-1]


def kortex_package(arm: MockArm) -> dict[str, types.ModuleType]:
    """kortex_api, by the names of its 2.6: degrees from 0 to 360, and joints that go on at the last speed until told otherwise."""

    class ServerError(Exception):
        pass

    class ClientError(Exception):
        pass

    class Router:
        basicErrorCallback = staticmethod(print)

        def __init__(self, transport: Any, callback: Any) -> None:
            pass

    def check(command: bool = True) -> None:
        if arm.trouble == "gone":
            raise ClientError("the connection is lost")
        if arm.trouble and command:
            raise ServerError("the command is refused")

    class Base:
        def SetServoingMode(self, mode: Any) -> None:
            check()

        def SendJointSpeedsCommand(self, message: Any) -> None:
            check()
            arm.drive(np.radians([joint.value for joint in message.joint_speeds]))

        def SendGripperCommand(self, message: Any) -> None:
            check()
            arm.grip(1.0 - message.gripper.finger[0].value)

        def Stop(self) -> None:
            check(command=False)
            arm.halt()

        def RefreshFeedback(self) -> SimpleNamespace:
            check(command=False)
            state = arm.report()
            columns = np.degrees(state.joints) % 360.0, np.degrees(state.speeds), state.efforts
            rows = [SimpleNamespace(position=float(angle), velocity=float(speed), torque=float(effort), fault_bank_a=0, fault_bank_b=0)
                    for angle, speed, effort in zip(*columns, strict=False)]  # with a joint missing, angles alone are fewer
            motor = [SimpleNamespace(position=100.0 * (1.0 - state.opening))]
            return SimpleNamespace(base=SimpleNamespace(active_state=kortex.IN_FAULT if state.fault else 7), actuators=rows,
                                   interconnect=SimpleNamespace(gripper_feedback=SimpleNamespace(motor=motor)))

    class Sessions:
        def __init__(self, router: Any) -> None:
            pass

        def CreateSession(self, wanted: Any) -> None:
            check()

        def CloseSession(self, options: Any) -> None:
            pass

    transport = SimpleNamespace(connect=lambda host, port: None, disconnect=lambda: None)
    messages = SimpleNamespace(
        JointSpeeds=lambda: SimpleNamespace(joint_speeds=_Repeated()), GRIPPER_POSITION=3, SINGLE_LEVEL_SERVOING=2,
        GripperCommand=lambda: SimpleNamespace(gripper=SimpleNamespace(finger=_Repeated())), ServoingModeInformation=SimpleNamespace,
    )
    base = Base()
    content: dict[str, dict[str, Any]] = {
        "kortex_api": {}, "kortex_api.autogen": {}, "kortex_api.autogen.client_stubs": {}, "kortex_api.Exceptions": {},
        "kortex_api.autogen.client_stubs.BaseClientRpc": {"BaseClient": lambda router: base},
        "kortex_api.autogen.client_stubs.BaseCyclicClientRpc": {"BaseCyclicClient": lambda router: base},
        "kortex_api.autogen.messages": {"Base_pb2": messages, "Session_pb2": SimpleNamespace(CreateSessionInfo=SimpleNamespace)},
        "kortex_api.Exceptions.KClientException": {"KClientException": ClientError},
        "kortex_api.Exceptions.KServerException": {"KServerException": ServerError},
        "kortex_api.RouterClient": {"RouterClient": Router, "RouterClientSendOptions": SimpleNamespace},
        "kortex_api.SessionManager": {"SessionManager": Sessions}, "kortex_api.TCPTransport": {"TCPTransport": lambda: transport},
    }
    return {name: _module(name, **found) for name, found in content.items()}


GRIPPER_JOINT, GRIPPER_CLOSED = "gripper_joint", 0.8
"""Of the mock ROS arm's gripper: its joint, and where that stands closed [rad]; open at 0."""


def ros2_package(arm: MockArm) -> dict[str, types.ModuleType]:
    """rclpy and the messages, as far as the driver uses them: joint states at 100 Hz, in an order of their own, and a controller that
    follows trajectories. An interface that is gone falls silent, and one that refuses says nothing of it: that is how topics are."""
    names = [*(f"joint_{i + 1}" for i in range(len(arm.manifest.joints))), GRIPPER_JOINT]
    heard: list[Callable[[Any], None]] = []

    def joint_states() -> SimpleNamespace:
        state = arm.report()
        seconds = state.stamp + DEVICE
        known = len(state.joints)  # of a message with a joint missing
        order = [known, *range(known - 1, -1, -1)]
        rows = lambda values, last: [[*values, last][i] for i in order]  # noqa: E731
        told = [*names[:known], GRIPPER_JOINT]
        return SimpleNamespace(
            header=SimpleNamespace(stamp=SimpleNamespace(sec=math.floor(seconds), nanosec=int(1e9 * (seconds % 1.0)))),
            name=[told[i] for i in order], position=rows(state.joints, GRIPPER_CLOSED * (1.0 - state.opening)),
            velocity=rows(state.speeds[:known], 0.0), effort=rows(state.efforts[:known], 0.0),
        )

    def speak() -> None:
        if arm.trouble != "gone":
            message = joint_states()
            for callback in heard:
                callback(message)

    def publish(message: Any) -> None:
        if arm.trouble:
            return
        if not message.points:
            arm.halt()
        else:
            arm.follow([point.time_from_start for point in message.points], np.array([point.positions for point in message.points]))

    class Node:
        def create_publisher(self, kind: Any, topic: str, depth: int) -> SimpleNamespace:
            return SimpleNamespace(publish=publish)

        def create_subscription(self, kind: Any, topic: str, callback: Callable[[Any], None], depth: int) -> None:
            heard.append(callback)

        def destroy_node(self) -> None:
            heard.clear()

    def spin_once(node: Node, timeout_sec: float) -> None:
        arm.clock.sleep(0.01)
        speak()

    content: dict[str, dict[str, Any]] = {
        "rclpy": {"ok": lambda: True, "init": lambda: None, "create_node": lambda name: Node(), "spin_once": spin_once, "speak": speak},
        "builtin_interfaces": {}, "builtin_interfaces.msg": {"Duration": lambda sec, nanosec: sec + 1e-9 * nanosec},
        "sensor_msgs": {}, "sensor_msgs.msg": {"JointState": object}, "trajectory_msgs": {},
        "trajectory_msgs.msg": {"JointTrajectory": SimpleNamespace, "JointTrajectoryPoint": SimpleNamespace},
    }
    return {name: _module(name, **found) for name, found in content.items()}


# ---- a driver on its vendor's package ------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Vendor:
    """A vendor's interface.

    Attributes:
        package: arm -> modules by name.  forms: of command that the driver takes.
        lag: time constant [s] of the arm behind it.
        clock: whether states carry a device's time.  complains: whether the arm itself can report a fault.
        threads: that the driver, once connected, feeds or hears the arm by.
        turn: whether it tells angles within a turn, from -pi to pi.
    """

    package: Callable[[MockArm], dict[str, types.ModuleType]]
    forms: tuple[Form, ...]
    lag: float
    clock: bool = True
    complains: bool = True
    threads: int = 1
    turn: bool = False


VENDORS: dict[VendorName, Vendor] = {
    "ur": Vendor(ur_package, ("pose", "joint"), ur.LOOKAHEAD / 2),
    "franka": Vendor(franka_package, ("pose", "joint"), 0.5 / franka.RATE, threads=0),
    "kortex": Vendor(kortex_package, ("joint",), 0.5 / kortex.RATE, clock=False, turn=True),
    "ros2": Vendor(ros2_package, ("joint",), 1.0 / ros2.RATE, complains=False),
}
"""Lags: half of a UR's smoothing time, half a period of the others' commands: the mean age of what a servo of that rate has been told."""


class MockedDriver:
    """A vendor's driver on a mock of its package; a driver of ``toolkit.deploy.faults.Begun``, with a time of its own. Works within
    ``mocked``.

    Args:
        bundle: whose arm stands there, whoever makes it.
        name: of the vendor.

    Raises:
        ToolkitError: a joint's angles are none that the vendor can tell.
    """

    def __init__(self, bundle: Bundle, name: VendorName) -> None:
        self.vendor, self.name, self._bundle = VENDORS[name], name, bundle
        beyond = [joint for joint in bundle.manifest.joints if max(abs(joint.low or 0.0), abs(joint.high or 0.0)) > math.pi]
        if self.vendor.turn and beyond:
            raise ToolkitError(f"{name} tells angles from -pi to pi, and joint {beyond[0].name} of {bundle.manifest.robot.name} goes from "
                               f"{beyond[0].low:.2f} to {beyond[0].high:.2f} rad; take another driver")
        self.clock = SimulatedClock()
        self.now, self.sleep = self.clock.now, self.clock.sleep
        self.arm = MockArm(bundle, self.vendor.lag, self.clock)
        self.modules = self.vendor.package(self.arm)
        self._driver: Driver | None = None
        self._close: Callable[[], None] = lambda: None

    def connect(self) -> ArmInfo:
        """See Driver."""
        self.stop("connected anew")
        self._driver, self._close = self._make()
        info = self._driver.connect()
        self.clock.meet(self.vendor.threads)
        return info

    def _make(self) -> tuple[Driver, Callable[[], None]]:
        arm, manifest = self.arm, self._bundle.manifest
        robot, joints, nothing = manifest.robot.name, [joint.name for joint in manifest.joints], lambda: None
        if self.name == "ur":
            return UniversalRobots("mock", robot, joints, arm.seen, lambda opening, _: arm.grip(opening),
                                   lambda: arm.report().opening, clock=self.clock), nothing
        if self.name == "franka":
            return Franka("mock", robot, joints, arm.seen, manifest.gripper.opening_m[0], self.clock), nothing
        if self.name == "kortex":
            return Kortex("mock", robot, joints, arm.seen, ("mock", "mock"), self.clock), nothing
        client = SimpleNamespace(send_goal_async=lambda goal: arm.grip(1.0 - goal.command.position / GRIPPER_CLOSED))
        grip = GripperAction(client, lambda: SimpleNamespace(command=SimpleNamespace()), 0.0, GRIPPER_CLOSED, 40.0)
        opening = JointOpening(GRIPPER_JOINT, 0.0, GRIPPER_CLOSED, self.clock.now)
        self.modules["rclpy"].create_node("gripper").create_subscription(None, ros2.STATES, opening.heard, 1)
        return open_arm(robot, joints, arm.seen, grip, opening, [f"joint_{i + 1}" for i in range(len(joints))], clock=self.clock)

    def begin(self, seed: int) -> None:
        """Put the arm at a seed's start, and connect anew: a driver that has stopped an arm stays stopped."""
        self.stop("a new episode")
        self.arm.begin(seed)
        self.connect()

    def report(self, state: State) -> State:
        """What the driver reads while its arm reports ``state``."""
        self.arm.tell(state)
        if self.name == "ros2":
            self.modules["rclpy"].speak()  # its messages come by themselves, 10 ms apart
        return self.read()

    @property
    def _connected(self) -> Driver:
        """The vendor's driver.

        Raises:
            ToolkitError: it has been stopped, or was never connected.
        """
        if self._driver is None:
            raise ToolkitError(f"the mock of {self.name} is not connected; begin an episode first")
        return self._driver

    def read(self) -> State:
        """See Driver."""
        return self._connected.read()

    def send(self, command: Command) -> Command:
        """See Driver."""
        return self._connected.send(command)

    def stop(self, reason: str) -> None:
        """See Driver."""
        if self._driver is not None:
            with self.clock.released():
                self._driver.stop(reason)
                self._close()
            self._driver = None


@contextmanager
def mocked(bundle: Bundle, name: VendorName) -> Iterator[MockedDriver]:
    """A vendor's driver that finds the mock where it imports its package; what was there before is there again afterwards."""
    driver = MockedDriver(bundle, name)
    before = {module: sys.modules.get(module) for module in driver.modules}
    sys.modules.update(driver.modules)
    try:
        yield driver
    finally:
        driver.stop("over")
        for module, found in before.items():
            if found is None:
                del sys.modules[module]
            else:
                sys.modules[module] = found

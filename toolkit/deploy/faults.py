"""A bad day, on purpose: faults injected between an arm and the runtime, and what the runtime made of each.

An ``Injector`` stands between the runtime and any driver, knows what the arm truly does, and lies from one tick on: about the state,
about its stamp, about the order given, or by sleeping. On a vendor's driver it lies through the mock of the vendor's package, so that the
lie passes through the driver. ``trials`` plays every fault in one form of command and says how soon the arm
was held, how far it truly went until it was held and until it stood, and whether that is what must be.
"""

import dataclasses
import json
import signal
import socket
import struct
import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal, Protocol

import numpy as np

from toolkit.bundle.manifest import Manifest
from toolkit.bundle.reading import Bundle
from toolkit.deploy import wire
from toolkit.deploy.arm import ArmInfo, Clock, Command, Driver, Form, State
from toolkit.deploy.drivers.sim import SimDriver
from toolkit.deploy.kinematics import Kinematics
from toolkit.deploy.mocks import MockedDriver, Trouble, Vendor
from toolkit.deploy.runtime import Outcome, Pace, Runtime, TickLog, play
from toolkit.errors import ToolkitError
from toolkit.runs.seeds import EVALUATION_SEEDS

Must = Literal["stop", "pass", "play", "refuse"]
"""stop: held, then stopped with a reason.  pass: held, and played on.  play: borne, whether or not the policy
then succeeds; but a delay beyond manifest.borne_delay_steps may end at a limit of AT_TABLE, and a policy that plays and has truly dropped
the object with object_lost.  refuse: never moved."""
AT_TABLE = ("table_clearance", "tracking")
"""By which an arm is stopped that comes down on the table: on its way, or as it pushes."""
TICKS, WAY, SHOWING = 3, 0.01, 2
"""Ticks and way [m] within which the arm must be held, and ticks at the speed of the fault's beginning that are added to that way: what
is not there shows only a tick later, and an order is obeyed in the tick after it."""


class Begun(Driver, Clock, Protocol):
    """A driver of a simulated arm, which can be put at a start, and the clock by which that arm lives."""

    def begin(self, seed: int) -> None:
        """Put arm, gripper and object at the start that a seed determines."""


@dataclass(frozen=True)
class InjectedFault:
    """One fault.

    Attributes:
        name: what is wrong, in a few words.  layer: state, stamp, start, order, vendor, process or disk.
        must: what must come of it.
        when: from when on: at the "start", while the arm is "moving" fastest on its way to the object, or "lifting" it.
        state: (true states so far, noise) -> what is reported; the newest comes last.
        command: (commands so far) -> what is really sent.
        sleep: [s] that the policy's side does nothing, once.
        lasting: ticks; afterwards all is well again.
        allowed: ticks that a limit of the manifest allows it on top.
        prompt: whether it must be seen within TICKS and WAY; a camera without noise that dies is as good as one that lives until the
            object must have moved.
        before: likewise state, of the ticks before the fault.
        trouble: of a vendor's mock arm.
        late: ticks by which states or orders come late.
    """

    name: str
    layer: str
    must: Must
    when: Literal["start", "moving", "lifting"] = "moving"
    state: Callable[[list[State], np.random.Generator], State] | None = None
    command: Callable[[list[Command]], Command] | None = None
    sleep: float = 0.0
    lasting: int = 10**6
    allowed: int = 0
    prompt: bool = True
    before: Callable[[list[State], np.random.Generator], State] | None = None
    trouble: Trouble = ""
    late: int = 0


@dataclass(frozen=True)
class Trial:
    """What came of a fault.

    Attributes:
        fault, layer, form, must: as injected.
        seen: the runtime's word for it; empty if it noticed nothing.
        ticks: from the first tick with the fault to the first that is held, or in which the arm is stopped; None if none is.
        to_hold_mm, to_rest_mm: how far the grasp frame truly went meanwhile, and until the arm was stopped or went on.
        outcome: "stopped: ...", "success" or "horizon".
        met: whether that is what must be.
    """

    fault: str
    layer: str
    form: str
    must: str
    seen: str
    ticks: int | None
    to_hold_mm: float
    to_rest_mm: float
    outcome: str
    met: bool


def _change(**changes: Callable[[State], Any]) -> Callable[[list[State], np.random.Generator], State]:
    return lambda states, rng: dataclasses.replace(states[-1], **{key: change(states[-1]) for key, change in changes.items()})


def _first(states: list[State], *names: str) -> State:
    """The newest state, with some entries as they were when the fault began."""
    return dataclasses.replace(states[-1], **{name: getattr(states[0], name) for name in names})


def _frozen(states: list[State], rng: np.random.Generator) -> State:
    return dataclasses.replace(states[0], stamp=states[-1].stamp)


def _frozen_noisy(states: list[State], rng: np.random.Generator) -> State:
    return dataclasses.replace(_frozen(states, rng), joints=states[0].joints + rng.normal(0, 1e-5, len(states[0].joints)))


def _blind(states: list[State], rng: np.random.Generator) -> State:
    return _first(states, "object_position", "object_quaternion")


def _seen(position: float = 0.0, bias: float = 0.0) -> Callable[[list[State], np.random.Generator], State]:
    """A camera with noise (standard deviation) and a bias [m]."""
    return lambda states, rng: dataclasses.replace(
        states[-1], object_position=states[-1].object_position + rng.normal(0, position, 3) + [bias, 0, 0]
    )


def _delayed(ticks: int) -> Callable[[list[State], np.random.Generator], State]:
    return lambda states, rng: dataclasses.replace(states[max(0, len(states) - 1 - ticks)], stamp=states[-1].stamp)


def _spoilt(which: int, value: float) -> Callable[[State], np.ndarray]:
    def spoil(state: State) -> np.ndarray:
        joints = state.joints.copy()
        joints[which] = value
        return joints

    return spoil


def _shifted(which: int, by: float) -> Callable[[State], np.ndarray]:
    return lambda state: state.joints + by * (np.arange(len(state.joints)) == which)


def _gripper(fingers: Callable[[np.ndarray], np.ndarray], opening: float) -> Callable[[list[State], np.random.Generator], State]:
    """Of an arm that reports fingers, other ones; of one that reports an opening, this."""
    return _change(fingers=lambda s: None if s.fingers is None else fingers(s.fingers),
                   opening=lambda s: None if s.opening is None else opening)


COMPLAINT = "arm reports a protective stop"
_W_LAST = _change(object_quaternion=lambda s: np.roll(s.object_quaternion, -1))
_STATE = (
    InjectedFault("nothing", "none", "play", "start"),
    InjectedFault("whole state frozen, fresh stamp", "state", "stop", state=_frozen),
    InjectedFault("whole state frozen from the start", "state", "stop", "start", state=_frozen),
    InjectedFault("whole state frozen while lifting", "state", "stop", "lifting", state=_frozen),
    InjectedFault("frozen but for encoder noise", "state", "stop", state=_frozen_noisy),
    InjectedFault("joints frozen, camera alive", "state", "stop", state=lambda s, r: _first(s, "joints", "speeds")),
    InjectedFault("nothing new comes, nor a stamp", "state", "stop", state=lambda s, r: s[0], allowed=1),
    InjectedFault("state twice, then alive", "state", "pass", state=_frozen, lasting=2),
    InjectedFault("camera without noise frozen from the start", "state", "stop", "start", state=_blind, prompt=False),
    InjectedFault("camera without noise frozen while lifting", "state", "stop", "lifting", state=_blind, prompt=False),
    InjectedFault("camera with noise frozen", "state", "stop", state=_blind, before=_seen(0.001)),
    InjectedFault("joint not a number", "state", "stop", state=_change(joints=_spoilt(2, np.nan))),
    InjectedFault("joint infinite", "state", "stop", state=_change(joints=_spoilt(0, np.inf))),
    InjectedFault("joint jumps by 0.5 rad", "state", "stop", state=_change(joints=_shifted(1, 0.5))),
    InjectedFault("joints in degrees", "state", "stop", state=_change(joints=lambda s: np.degrees(s.joints))),
    InjectedFault("a joint missing", "state", "stop", state=_change(joints=lambda s: s.joints[:-1])),
    InjectedFault("joint speed of 50 rad/s", "state", "stop", state=_change(speeds=lambda s: np.full(len(s.joints), 50.0))),
    InjectedFault("effort of 10 kN m", "state", "stop", state=_change(efforts=lambda s: np.full(len(s.joints), 1e4))),
    InjectedFault("object jumps by 30 cm", "state", "stop", state=_change(object_position=lambda s: s.object_position + [0.3, 0, 0])),
    InjectedFault("object not a number", "state", "stop", state=_change(object_position=lambda s: np.full(3, np.nan))),
    InjectedFault("object's quaternion zero", "state", "stop", state=_change(object_quaternion=lambda s: np.zeros(4))),
    InjectedFault("object's quaternion doubled", "state", "stop", state=_change(object_quaternion=lambda s: 2 * s.object_quaternion)),
    InjectedFault("object's quaternion w last", "state", "stop", state=_W_LAST),
    InjectedFault("gripper not numbers", "state", "stop", state=_gripper(lambda fingers: fingers * np.nan, np.nan)),
    InjectedFault("opening in per cent", "state", "stop", state=_change(fingers=lambda s: None, opening=lambda s: 80.0)),
    InjectedFault(COMPLAINT, "state", "stop", state=_change(fault=lambda s: "protective stop")),
    InjectedFault("object below the table", "state", "stop",
                  state=_change(object_position=lambda s: np.array([*s.object_position[:2], 0.5]))),
    InjectedFault("pose noise of 2 mm", "state", "play", "start", state=_seen(0.002)),
    InjectedFault("pose noise of 5 mm", "state", "play", "start", state=_seen(0.005)),
    InjectedFault("pose noise of 10 mm", "state", "play", "start", state=_seen(0.010)),
    InjectedFault("states one tick late", "state", "play", "start", state=_delayed(1), late=1),
    InjectedFault("states two ticks late", "state", "play", "start", state=_delayed(2), late=2),
)
_STAMP = (
    InjectedFault("stamp a second old", "stamp", "stop", state=_change(stamp=lambda s: s.stamp - 1.0)),
    InjectedFault("stamp a second ahead", "stamp", "stop", state=_change(stamp=lambda s: s.stamp + 1.0)),
    InjectedFault("stamp stands still", "stamp", "stop", state=lambda s, r: _first(s, "stamp"), allowed=1),
    InjectedFault("one state 0.3 s old", "stamp", "pass", state=_change(stamp=lambda s: s.stamp - 0.3), lasting=1),
)
_START = (
    InjectedFault("object 5 cm off", "start", "refuse", "start", state=_change(object_position=lambda s: s.object_position + [0.05, 0, 0])),
    InjectedFault("object 15 cm off", "start", "refuse", "start",
                  state=_change(object_position=lambda s: s.object_position + [0, 0.15, 0])),
    InjectedFault("object in millimetres", "start", "refuse", "start", state=_change(object_position=lambda s: 1e3 * s.object_position)),
    InjectedFault("object's quaternion w last", "start", "refuse", "start", state=_W_LAST),
    InjectedFault("goal 50 cm away", "start", "refuse", "start", state=_change(goal=lambda s: s.goal + [0, 0.5, 0])),
    InjectedFault("gripper half closed", "start", "refuse", "start", state=_gripper(lambda fingers: fingers + 0.4, 0.5)),
    InjectedFault("opening in metres", "start", "refuse", "start", state=_change(fingers=lambda s: None, opening=lambda s: 0.08)),
    InjectedFault("arm already moving", "start", "refuse", "start", state=_change(speeds=lambda s: np.full(len(s.joints), 0.2))),
    InjectedFault("a joint 0.1 rad off", "start", "refuse", "start", state=_change(joints=_shifted(3, 0.1))),
    InjectedFault("joints in degrees", "start", "refuse", "start", state=_change(joints=lambda s: np.degrees(s.joints))),
)


def _still(commands: list[Command]) -> Command:
    """The arm stands where it stood, whatever is asked of it."""
    first = commands[0]
    if first.form == "osc":
        return dataclasses.replace(first, hold=True, target=np.zeros(6), grip=0.0)
    return dataclasses.replace(first, hold=True, rate=np.zeros_like(first.rate), grip=0.0)


_ORDER = (
    InjectedFault("the arm does not obey", "order", "stop", command=_still),
    InjectedFault("orders one tick late", "order", "play", "start", command=lambda c: c[max(0, len(c) - 2)], late=1),
    InjectedFault("orders two ticks late", "order", "play", "start", command=lambda c: c[max(0, len(c) - 3)], late=2),
)
_PROCESS = (
    InjectedFault("policy asleep for 0.5 s", "process", "pass", sleep=0.5, lasting=1),
    InjectedFault("policy asleep for 1.5 s", "process", "stop", sleep=1.5, lasting=1),
)
FAULTS = (*_STATE, *_STAMP, *_START, *_ORDER, *_PROCESS)
VENDOR_FAULTS = (
    InjectedFault("the arm refuses orders", "vendor", "stop", trouble="refuses"),
    InjectedFault("the connection is gone", "vendor", "stop", trouble="gone", allowed=1),
)


def faults_for(vendor: Vendor | None) -> tuple[InjectedFault, ...]:
    """The faults that an arm behind a vendor's interface can have, or the twin (None): who gives no time cannot give a wrong one."""
    if vendor is None:
        return FAULTS
    return tuple(fault for fault in (*FAULTS, *VENDOR_FAULTS) if (vendor.clock or fault.layer != "stamp")
                 and (vendor.complains or fault.name != COMPLAINT))


class Injector:
    """A driver that lies, around one that does not.

    Args:
        driver: connected; its own states are taken for the truth, or those of its mock arm, if it has one.
        fault: what is wrong.
        onset: tick from which on.
        place: state -> (3,) [m] where the grasp frame truly is.
        seed: of noise.

    Attributes:
        truths: (ticks, 3) [m] where the grasp frame truly was, tick by tick.  apart: (ticks,) [m] how far the object truly was from it.
        held: whether the command of each tick was to hold.
    """

    def __init__(self, driver: Begun, fault: InjectedFault, onset: int, place: Callable[[State], np.ndarray], seed: int = 0) -> None:
        self.driver, self.fault, self.onset, self._place = driver, fault, onset, place
        self.truths: list[np.ndarray] = []
        self.apart: list[float] = []
        self.held: list[bool] = []
        self._states: list[State] = []
        self._commands: list[Command] = []
        self._rng = np.random.default_rng(seed)
        self._slept = False

    def connect(self) -> ArmInfo:
        """See Driver."""
        return self.driver.connect()

    @property
    def _wrong(self) -> bool:
        """Whether this is a tick with the fault; the first state read is that of the start check, before any tick."""
        return self.onset <= len(self.held) < self.onset + self.fault.lasting

    def read(self) -> State:
        """See Driver."""
        mock = self.driver if isinstance(self.driver, MockedDriver) else None
        truth = mock.arm.state() if mock else self.driver.read()
        self.truths.append(self._place(truth))
        self.apart.append(float(np.linalg.norm(truth.object_position - self.truths[-1])))
        told = self._told(truth)
        if mock is None:
            return told
        mock.arm.trouble = self.fault.trouble if self._wrong else ""
        return mock.report(told)

    def _told(self, truth: State) -> State:
        """What is reported in place of the truth."""
        if not self._wrong:
            before = self.fault.before if len(self.held) < self.onset else None
            told = before([truth], self._rng) if before is not None else truth
            self._states = [told]  # with which the fault begins: the last honest one
            return told
        if self.fault.sleep and not self._slept:
            self._slept = True
            self.driver.sleep(self.fault.sleep)
        if self.fault.state is None:
            return truth
        self._states.append(truth)
        return dataclasses.replace(self.fault.state(self._states, self._rng), outcome=truth.outcome)

    def send(self, command: Command) -> Command:
        """See Driver."""
        wrong = self._wrong
        self.held.append(command.hold)
        if self.fault.command is None or not wrong:
            self._commands = [command]
            return self.driver.send(command)
        self._commands.append(command)
        self.driver.send(self.fault.command(self._commands))
        return command

    def stop(self, reason: str) -> None:
        """See Driver."""
        self.driver.stop(reason)


def onsets(bundle: Bundle) -> dict[str, int]:
    """When -> tick: the start, the fastest tick of the recorded episode before the fingers close, and the first with the object lifted."""
    golden, kinematics = bundle.golden, Kinematics.of(bundle.manifest, bundle.mjcf)
    places = []
    for joints, fingers in zip(golden["episode_joints"], golden["episode_fingers"], strict=True):
        kinematics.place(joints, fingers)
        places.append(kinematics.position)
    height = golden["episode_object_position"][:, 2]
    lifted = int(np.argmax(height > height[0] + 0.03))
    speed = np.linalg.norm(np.diff(places, axis=0), axis=1)
    return {"start": 0, "moving": max(2, int(np.argmax(speed[: max(3, lifted // 2)]))), "lifting": lifted}


def trial(bundle: Bundle, driver: Begun, info: ArmInfo, form: Form, fault: InjectedFault, onset: int, seed: int) -> Trial:
    """Play one episode with one fault.

    Args:
        bundle, driver, info, form: as for a Runtime.
        fault, onset: the fault, and the tick from which on.
        seed: of the start.

    Raises:
        ToolkitError: the driver's arm has gone.
    """
    runtime, kinematics = Runtime(bundle, info, form), Kinematics.of(bundle.manifest, bundle.mjcf)

    def place(state: State) -> np.ndarray:
        kinematics.place(runtime.observer.in_order(state.joints), runtime.observer.fingers(state))
        return kinematics.position

    driver.begin(seed)
    injector = Injector(driver, fault, onset, place)
    outcome = play(runtime, injector, TickLog(None, {}), clock=driver)
    return _judged(injector, outcome, form, bundle.manifest)


def _judged(injector: Injector, outcome: Outcome, form: Form, manifest: Manifest) -> Trial:
    fault, onset, held, way = injector.fault, injector.onset, injector.held, np.array(injector.truths)
    step = np.linalg.norm(np.diff(way, axis=0), axis=1)
    seen = ", ".join(outcome.faults)
    first = next((i for i in range(onset, len(held)) if held[i]), len(held) - 1 if held and outcome.stopped else None)
    # way[0] is the start check's, so that way[i + 1] is where tick i found the arm.
    to_hold = float(step[onset : first + 1].sum()) if first is not None else float(step[onset:].sum())
    last = next((i for i in range(first, len(held)) if not held[i]), len(held)) if first is not None else len(held)
    to_rest = float(step[onset : last + 1].sum())
    speed = float(step[max(0, onset - 1) : onset + SHOWING].max(initial=0.0))
    soon = first is not None and (
        not fault.prompt or first - onset <= TICKS and to_hold <= WAY + (SHOWING + fault.allowed) * speed
    )
    beyond = fault.late > (manifest.borne_delay_steps or 0) and outcome.stopped.startswith(AT_TABLE)
    stopping = len(held) - next((i for i, hold in enumerate(reversed(held)) if not hold), len(held))  # first tick of the last hold
    dropped = outcome.stopped.startswith("object_lost") and max(injector.apart[stopping + 1 :], default=0.0) > manifest.watch.held_m
    went_on = first is not None and not all(held[first:])
    met = {
        "stop": bool(outcome.stopped) and soon, "pass": soon and went_on and (not outcome.stopped or dropped),
        "play": not outcome.stopped or beyond or dropped,
        "refuse": not held and bool(outcome.stopped),
    }[fault.must]
    return Trial(fault.name, fault.layer, form, fault.must, seen, None if first is None else first - onset, 1e3 * to_hold, 1e3 * to_rest,
                 f"stopped: {outcome.stopped}" if outcome.stopped else "success" if outcome.success else "horizon", bool(met))


def trials(bundle: Bundle, driver: Begun, info: ArmInfo, form: Form, faults: tuple[InjectedFault, ...]) -> Iterator[Trial]:
    """Every fault in one form of command, one after another, from the evaluation's first start."""
    when = onsets(bundle)
    for fault in faults:
        yield trial(bundle, driver, info, form, fault, when[fault.when], EVALUATION_SEEDS)


# ---- what befalls processes, connections and disks ---------------------------------------------------------------------

Start = Callable[[Pace], tuple[subprocess.Popen, int]]
"""Starts a twin of the bundle in a process of its own; returns it, and the port on which it listens."""
FULL_DISK = Path("/dev/full")
ANSWER = 2.0
"""[s] for an answer of the twin, before it counts as hung."""
STILL, SOON = 0.05, 0.8
"""[rad/s] below which an arm stands still, and [s] after which it must: the twin's watchdog takes 0.2 s, its arm the rest."""
MOVING, PUSHES = 0.2, 100
"""[rad/s] from which on it moves, and periods in which it must begin to: on a machine that comes late the watchdog holds it in between."""
NONSENSE = {
    "a client of HTTP": b"GET / HTTP/1.1\r\n\r\n", "a message of 2 GiB": struct.pack(">I", 2**31) + b"x" * 1000, "zeros": bytes(5000),
    "a message that is no JSON": struct.pack(">I", 5) + b"{nope", "half a message": struct.pack(">I", 100) + b'{"do": ',
}


@contextmanager
def _twin(start: Start, pace: Pace) -> Iterator[tuple[subprocess.Popen, int]]:
    process, port = start(pace)
    try:
        yield process, port
    finally:
        process.kill()
        process.wait()


class _Cut:
    """A driver at whose ``tick``-th command something happens."""

    def __init__(self, driver: SimDriver, tick: int, happen: Callable[[], None]) -> None:
        self.driver, self.left, self.happen = driver, tick, happen
        self.connect, self.read, self.stop = driver.connect, driver.read, driver.stop

    def send(self, command: Command) -> Command:
        """See Driver."""
        self.left -= 1
        if self.left == 0:
            self.happen()
        return self.driver.send(command)


def line_trials(bundle: Bundle, start: Start) -> Iterator[Trial]:
    """Processes that die, hang and fall silent, clients that talk nonsense, and a disk that is full, in robosuite's own form."""
    for name, sign in (("twin killed", signal.SIGKILL), ("twin hung", signal.SIGSTOP)):
        with _twin(start, "lockstep") as (process, port):
            yield _loses_its_arm(bundle, port, name, partial(process.send_signal, sign))
    with _twin(start, "real") as (process, port):
        yield _left_alone(port, "policy killed", True)
        yield _left_alone(port, "policy silent", False)
        for name, content in NONSENSE.items():
            yield _told(port, name, content)
        yield _second(port)
        yield _bad_order(port)
    if FULL_DISK.exists():
        with _twin(start, "lockstep") as (process, port):
            yield _full_disk(bundle, port)


def _said(name: str, layer: str, must: str, seen: str, outcome: str, met: bool) -> Trial:
    return Trial(name, layer, "osc", must, seen, None, 0.0, 0.0, outcome, met)


def _episode(bundle: Bundle, port: int) -> tuple[SimDriver, Runtime]:
    arm = SimDriver("127.0.0.1", port, answer=ANSWER)
    runtime = Runtime(bundle, arm.connect())
    arm.answer = 10 * ANSWER  # a busy machine takes its time for a reset
    arm.begin(EVALUATION_SEEDS)
    arm.answer = ANSWER
    return arm, runtime


def _loses_its_arm(bundle: Bundle, port: int, name: str, happen: Callable[[], None]) -> Trial:
    arm, runtime = _episode(bundle, port)
    outcome = play(runtime, _Cut(arm, onsets(bundle)["moving"], happen), TickLog(None, {}), "lockstep")
    arm.leave()
    return _said(name, "process", "stop", ", ".join(outcome.faults), f"stopped: {outcome.stopped}", outcome.stopped.startswith("driver"))


def _fastest(state: State) -> float:
    """[rad/s] of the fastest joint; infinite where the arm does not say, which stands still for nobody."""
    return np.inf if state.speeds is None else float(np.abs(state.speeds).max())


def _pushed(port: int) -> tuple[SimDriver, float]:
    """A driver whose arm moves upwards, and its fastest joint's speed [rad/s]."""
    arm, speed = SimDriver("127.0.0.1", port), 0.0
    arm.connect()
    arm.begin(EVALUATION_SEEDS)
    for _ in range(PUSHES):
        arm.send(Command("osc", False, np.array([0, 0, 1.0, 0, 0, 0]), np.zeros(0), 0.0, 1.0, 0.1))
        arm.sleep(0.05)
        speed = _fastest(arm.read())
        if speed > MOVING:
            break
    return arm, speed


def _left_alone(port: int, name: str, leaves: bool) -> Trial:
    """The arm must stand still by itself, and the twin go on."""
    arm, before = _pushed(port)
    if leaves:
        arm.leave()
    arm.sleep(SOON)
    if leaves:
        arm = SimDriver("127.0.0.1", port)
        arm.connect()
    state = arm.read()
    arm.leave()
    speed = _fastest(state)
    met = before > STILL > speed and (not leaves or bool(state.fault))
    return _said(name, "process", "stop", state.fault, f"{before:.2f} rad/s, {speed:.3f} after {SOON} s", met)


def _told(port: int, name: str, content: bytes) -> Trial:
    """Who talks nonsense is sent away, and the next one served."""
    with socket.create_connection(("127.0.0.1", port), timeout=10 * ANSWER) as client:  # a busy machine takes its time
        client.sendall(content)
        client.shutdown(socket.SHUT_WR)
        try:
            said = b"".join(iter(lambda: client.recv(4096), b""))
        except OSError:
            said = b""
    heard = json.loads(said[4:])["error"] if len(said) > 4 else ""
    try:
        arm, _ = _pushed(port)
        arm.leave()
    except ToolkitError as error:
        return _said(name, "line", "pass", heard, f"the next client is refused: {error}", False)
    return _said(name, "line", "pass", heard, "the next client is served", bool(heard) or name == "half a message")


def _second(port: int) -> Trial:
    arm, _ = _pushed(port)
    began = time.monotonic()
    try:
        SimDriver("127.0.0.1", port).connect()
        heard = ""
    except ToolkitError as error:
        heard = str(error)
    took, served = time.monotonic() - began, not arm.read().fault
    arm.leave()
    return _said("a second client", "line", "pass", heard, f"told after {took:.2f} s, the first served on",
                 "another client" in heard and took < ANSWER and served)


def _bad_order(port: int) -> Trial:
    order = Command("osc", False, np.full(6, np.nan), np.zeros(0), 0.0, 1.0, 0.1)
    content = json.dumps({"do": "send", "command": wire.command_to_json(order)}).encode()
    client = socket.create_connection(("127.0.0.1", port), timeout=ANSWER)
    client.sendall(struct.pack(">I", len(content)) + content)
    line = wire.Line(client)
    heard = wire.exchange(line, {"do": "read"}, ANSWER).get("error", "")
    served = "joints" in wire.exchange(line, {"do": "result"}, ANSWER)  # the answer to the question before
    line.close()
    return _said("an order that is not a number", "line", "pass", heard, "refused by a sentence, served on", bool(heard) and served)


def _full_disk(bundle: Bundle, port: int) -> Trial:
    arm, runtime = _episode(bundle, port)
    log = TickLog(FULL_DISK, {})
    outcome = play(runtime, arm, log, "lockstep")
    log.close()
    arm.leave()
    return _said("log on a full disk", "disk", "play", log.trouble, "success" if outcome.success else outcome.stopped or "horizon",
                 outcome.success and bool(log.trouble))

"""The runtime: one tick turns a state into a command; an episode is ticks at the policy's rate; every tick is logged.

    state -> checks -> observation -> checks -> policy -> checks -> command within limits -> checks -> driver
"""

import itertools
import json
import time
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal, NamedTuple, TextIO, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from tasks.task import Judge
from toolkit.bundle.reading import Bundle
from toolkit.deploy.arm import FORMS, WALL, ArmInfo, Clock, Command, Driver, Form, State, check_fit
from toolkit.deploy.kinematics import Kinematics
from toolkit.deploy.motion import motion_of
from toolkit.deploy.observer import Observer
from toolkit.deploy.safety import OVERDUE, Fault, Guard
from toolkit.errors import ToolkitError
from toolkit.io.claims import open_claimed

Pace = Literal["real", "lockstep"]
STAGES = ("read", "observe", "policy", "command", "send")
"""Parts of a tick that the log times [ms]; the runtime's own are all but read and send, which wait for the arm."""
PUNCTUAL = 1e-6
"""[s] by which a tick that ends with its period may end after it: a rounding of clocks that count steps."""


def wilson_interval(successes: int, episodes: int) -> tuple[float, float]:
    """95 % interval of a success rate (Wilson 1927)."""
    z, rate = 1.959963984540054, successes / episodes
    middle = (rate + z**2 / (2 * episodes)) / (1 + z**2 / episodes)
    half = z / (1 + z**2 / episodes) * np.sqrt(rate * (1 - rate) / episodes + z**2 / (4 * episodes**2))
    return float(max(0.0, middle - half)), float(min(1.0, middle + half))


class _Seen(NamedTuple):
    """What a state that nothing is wrong with shows: the observation (n_obs,), and the arm's angles (n,) [rad]."""

    observation: np.ndarray
    arm: np.ndarray


@dataclass(eq=False)
class Tick:
    """What one tick did.

    Attributes:
        command: what to send.
        fault: why the arm is held, if it is.
        stop: why it is to be stopped, once it has been held long enough.
        warning: entry of the observation farthest outside what training saw, if any.
        action: (7,) of the policy; NaN before it was asked.
        times: stage -> [s].
    """

    command: Command
    fault: Fault | None
    stop: Fault | None
    warning: str
    action: np.ndarray
    times: dict[str, float]


class Runtime:
    """A bundle ready to move an arm.

    Args:
        bundle: checked on loading.
        info: the arm, as its driver says.
        form: of the commands.
        policy: in place of the bundle's own: observation (n_obs,) -> action (7,); for tests.

    Raises:
        ToolkitError: the arm does not fit the bundle; the message names what differs.
    """

    def __init__(
        self, bundle: Bundle, info: ArmInfo, form: Form = "osc", policy: Callable[[np.ndarray], np.ndarray] | None = None
    ) -> None:
        manifest = bundle.manifest
        check_fit(manifest, info, form)
        self.manifest, self.info, self.form = manifest, info, form
        self.policy = policy or bundle
        kinematics = Kinematics.of(manifest, bundle.mjcf)
        self.observer = Observer(manifest, kinematics, info)
        self.guard = Guard(manifest, self.observer)
        self.motion = motion_of(form, manifest, kinematics, info.rate_hz, bundle.mjcf, bundle.golden["episode_joints"])
        self.period = 1.0 / manifest.policy_hz
        self._judge = self._new_judge()
        self._held = 0
        self._fault: Fault | None = None

    def begin(self, state: State, now: float) -> Fault | None:
        """Start an episode at a state; a fault means that the arm must not be moved."""
        self.guard.begin()
        self.observer.begin()
        self._judge = self._new_judge()
        self._held = 0
        self._fault = self.guard.start(state, now)
        if self._fault is None:
            self.observer(state, self.manifest.gripper.preshape)
            self.motion.begin(self.observer.arm(state))
        return self._fault

    def tick(self, state: State | Fault, now: float, late: bool = False, overdue: float = 0.0) -> Tick:
        """One tick, after ``begin``.

        Args:
            state: measured; a Fault in its place is what kept the driver from reading one.
            now: on the clock of the state's stamp [s].
            late: whether the last tick ended after its period.
            overdue: by how much this one begins after its time [s].
        """
        clock = [time.perf_counter()]
        seen = self._seen(state, now, self.guard.timing(late, overdue))
        clock.append(time.perf_counter())
        fault, warning, action = None, "", np.full(len(self.manifest.action), np.nan)
        if isinstance(seen, Fault):
            fault = seen
        else:
            warning = self.guard.unknown(seen.observation)
            action = np.array(self.policy(seen.observation), float)
            fault = self.guard.action(action)
        clock.append(time.perf_counter())
        command = None
        if not isinstance(seen, Fault) and fault is None and (self._fault is None or self._fault.passing):
            advanced = self.motion.advance(action, seen.arm)
            fault = self.guard.command(advanced, self.motion)
            if fault is None:
                command = advanced
            else:
                self.motion.undo()
        self._fault = self._fault if self._fault is not None and not self._fault.passing else fault
        if command is None or isinstance(seen, Fault):
            command = self.motion.hold()
            self._held += 1
        else:
            self._held = 0
            if self.observer.goal is not None:
                left = float(np.linalg.norm(seen.observation[self.observer.goal]))
                self._judge.tell(left < self.manifest.task.goal_tolerance_m)
        self.guard.sent(command, self.motion)
        clock.append(time.perf_counter())
        times = dict(zip(STAGES[1:4], np.diff(clock).tolist(), strict=True))
        command = self.observer.reported(command)
        return Tick(command, self._fault, self._stop, warning, action, times)

    def _seen(self, state: State | Fault, now: float, timing: Fault | None) -> _Seen | Fault:
        """What a state shows; or what is wrong with it, with what is observed of it, or else with when this tick comes (``timing``)."""
        if isinstance(state, Fault):
            self.guard.blind()
            return state
        fault = self.guard.state(state, now) or timing
        if fault is None:
            observation = self.observer(state, self.motion.grip.command)
            fault = self.guard.observation(observation)
            if fault is None:
                return self.guard.alive(state, self.motion.grip.opening_m) or _Seen(observation, self.observer.arm(state))
        self.guard.blind()
        return fault

    @property
    def _stop(self) -> Fault | None:
        """Why the arm is to be stopped: it has been held long enough; nobody who has slept waits any longer."""
        fault = self._fault
        return fault if fault is not None and (self._held > self.manifest.watch.hold_ticks or fault.kind == "asleep") else None

    def overslept(self, tick: Tick, seconds: float) -> Tick:
        """The tick with a command to hold in place of its own, which would be sent too late [s] for the state that it answers."""
        if tick.fault is None:
            self.motion.undo()
            self._held += 1
        if self._fault is None or self._fault.passing:
            self._fault = self.guard.overdue(seconds)
        self.guard.blind()
        return replace(tick, command=self.observer.reported(self.motion.hold()), fault=self._fault, stop=self._stop)

    def _new_judge(self) -> Judge:
        says = self.manifest.simulation  # None in format version 2, whose tasks counted like all others
        return Judge(self.manifest.task.hold_steps, says is None or says.holding.consecutive)

    @property
    def succeeded(self) -> bool:
        """Whether the object has been at the goal for the task's hold_steps, as far as the runtime sees."""
        return self._judge.succeeded


# ---- an episode ------------------------------------------------------------------------------------------------------


@dataclass
class Outcome:
    """How an episode went.

    Attributes:
        success: the task was done.
        ticks: played.
        stopped: why the arm was stopped; empty if it was not.
        held: ticks in which the arm was held.  faults: kind -> ticks.
        late: ticks that ended after their period.
        warnings: ticks with an observation outside what training saw.
        tick_ms: (ticks,) the runtime's own time per tick.
    """

    success: bool = False
    ticks: int = 0
    stopped: str = ""
    held: int = 0
    faults: Counter = field(default_factory=Counter)
    late: int = 0
    warnings: int = 0
    tick_ms: list[float] = field(default_factory=list)


def play(
    runtime: Runtime, driver: Driver, log: "TickLog", pace: Pace = "real", episode: int = 0, clock: Clock = WALL
) -> Outcome:
    """One episode, from the start check to success, a stop, or the horizon.

    Args:
        runtime: of the bundle.
        driver: connected, its arm at the start.
        log: told of every tick.
        pace: "real": a tick starts every policy period by the clock; "lockstep": as soon as the last one has ended, for a
            simulation that waits, whose states are therefore never stale and whose episodes repeat exactly.
        episode: number for the log.
        clock: by which the arm's states are stamped and, at a "real" pace, ticks begin.
    """
    outcome = Outcome()
    first = _read(driver)
    fault = first if isinstance(first, Fault) else runtime.begin(*_timed(first, pace, 0.0, clock))
    if fault is not None:
        outcome.stopped, outcome.faults = str(fault), Counter([fault.kind])
        driver.stop(outcome.stopped)
        log.note(episode, "stop", outcome.stopped)
        return outcome
    due, late, overdue = clock.now(), False, 0.0
    try:
        for number in range(runtime.manifest.task.horizon_steps + runtime.manifest.watch.hold_ticks):
            began = time.perf_counter()
            if pace == "real":
                overdue = max(overdue, clock.now() - due)
            state = _read(driver)
            read = time.perf_counter() - began
            seen, now = _timed(state, pace, number * runtime.period, clock)
            tick = runtime.tick(seen, now, late, overdue)
            if pace == "real" and (slept := clock.now() - due - runtime.period) > OVERDUE:
                tick = runtime.overslept(tick, slept)
            sending = time.perf_counter()
            sent = _send(driver, tick.command)
            tick.times |= {"read": read, "send": time.perf_counter() - sending}
            due += runtime.period
            overdue = max(0.0, clock.now() - due) if pace == "real" else 0.0
            late = overdue > PUNCTUAL
            _count(outcome, tick, late)
            log.tick(episode, number, seen, tick, sent, late, now)
            if isinstance(sent, Fault):
                outcome.stopped = str(sent)
            elif tick.stop is not None:
                outcome.stopped = str(tick.stop)
            told = "" if isinstance(state, Fault) else state.outcome
            outcome.success = told == "success" or (not told and runtime.succeeded)
            if outcome.stopped or outcome.success:
                break
            if late:
                due = clock.now()  # what was missed is not made up in a hurry
            elif pace == "real":
                clock.sleep(max(0.0, due - clock.now()))
    except BaseException:
        driver.stop("interrupted")
        raise
    if outcome.stopped:
        driver.stop(outcome.stopped)
        log.note(episode, "stop", outcome.stopped)
    return outcome


StateOrFault = TypeVar("StateOrFault", State, State | Fault)


def _timed(state: StateOrFault, pace: Pace, due: float, clock: Clock) -> tuple[StateOrFault, float]:
    """A state and the time; in lockstep on the episode's own clock, in which a tick takes its period however busy this machine is."""
    if pace == "real":
        return state, clock.now()
    return (replace(state, stamp=due) if isinstance(state, State) else state), due


def _count(outcome: Outcome, tick: Tick, late: bool) -> None:
    outcome.ticks += 1
    outcome.late += late
    outcome.warnings += bool(tick.warning)
    outcome.tick_ms.append(1e3 * sum(tick.times[stage] for stage in STAGES[1:4]))
    if tick.fault is not None:
        outcome.held += 1
        outcome.faults[tick.fault.kind] += 1


def _read(driver: Driver) -> State | Fault:
    try:
        return driver.read()
    except (OSError, ToolkitError, RuntimeError) as error:
        return Fault("driver", f"the state could not be read ({error})")


def _send(driver: Driver, command: Command) -> Command | Fault:
    try:
        return driver.send(command)
    except (OSError, ToolkitError, RuntimeError) as error:
        return Fault("driver", f"the command could not be sent ({error})")


# ---- the log ---------------------------------------------------------------------------------------------------------

LOG_FORMAT = "meta-evolve deployment log"


class TickLog:
    """One JSON line per tick, after a first line that says what is logged; constant memory.

    An arm does not stop for its log: a line that cannot be written ends the log, not the episode.

    Args:
        path: file, begun anew; None: nothing is written.
        about: for the first line.

    Attributes:
        trouble: why the log ends early, in a sentence; empty if it does not.

    Raises:
        ToolkitError: the file cannot be begun.
    """

    def __init__(self, path: Path | None, about: dict[str, Any]) -> None:
        self.path = path
        self._file: TextIO | None = None
        self.trouble, self._lines = "", 0
        if path is None:
            return
        try:
            self._file = open_claimed(path, "a", "--log")
            if self._file.seekable() and self._file.tell():
                self._file.truncate(0)  # begun anew, but not under another's pen
        except OSError as error:
            raise ToolkitError(f"the log {path} cannot be written ({error.strerror}); choose another --log") from error
        self._write(self._file, {"format": LOG_FORMAT, "version": 1, "times": "ms", **about})

    def tick(
        self, episode: int, number: int, state: State | Fault, tick: Tick, sent: Command | Fault, late: bool, now: float
    ) -> None:
        """A line for one tick, which began at ``now`` [s] on the clock of the state's stamp."""
        if self._file is None:
            return
        row: dict[str, Any] = {"episode": episode, "tick": number, "t": now, "late": late, "hold": tick.command.hold}
        row |= {f"{stage}_ms": round(1e3 * tick.times[stage], 4) for stage in STAGES}
        if isinstance(state, State):
            row |= {"age_ms": _listed([1e3 * (row["t"] - state.stamp)])[0], "joints": _listed(state.joints),
                    "object": _listed(state.object_position)}
        row |= {"action": _listed(tick.action), "target": _listed(tick.command.target), "opening": round(tick.command.opening, 5)}
        if isinstance(sent, Command) and sent is not tick.command:
            row["sent"] = _listed(sent.target)
        if tick.fault is not None:
            row["fault"], row["detail"] = tick.fault.kind, tick.fault.detail
        if tick.warning:
            row["unknown"] = tick.warning
        self._write(self._file, row)

    def note(self, episode: int, what: str, text: str) -> None:
        """A line that is no tick."""
        if self._file is not None:
            self._write(self._file, {"episode": episode, what: text})

    def close(self) -> None:
        """Finish the file."""
        if self._file is not None:
            file, self._file = self._file, None
            try:
                file.close()
            except OSError as error:
                self._end(error)

    def _write(self, file: TextIO, row: dict[str, Any]) -> None:
        try:
            file.write(json.dumps(row) + "\n")
            self._lines += 1
        except OSError as error:
            self._end(error)
            self.close()

    def _end(self, error: OSError) -> None:
        why = error.strerror or str(error)
        self.trouble = self.trouble or f"{self.path} is cut off after {self._lines} lines at most ({why}); the arm was not stopped for it"


def _listed(values: ArrayLike) -> list[float | None]:
    """Rounded numbers; null where one is not finite, as JSON has no NaN, and for what is no number at all."""
    try:
        numbers = np.ravel(np.asarray(values, float)).tolist()
    except (TypeError, ValueError):
        return [None]
    return [round(v, 6) if np.isfinite(v) else None for v in numbers]


# ---- a self-test without an arm --------------------------------------------------------------------------------------


def replay_golden(bundle: Bundle) -> dict[str, float]:
    """The recorded closed-loop episode through this machine's own kinematics, observer and policy.

    Returns:
        observation_max_abs_error, action_max_abs_error: largest differences from the recorded numbers.
    """
    golden = bundle.golden
    observer = Observer(bundle.manifest, Kinematics.of(bundle.manifest, bundle.mjcf))
    seen, acted = [], []
    for row in range(len(golden["episode_joints"])):
        state = State(
            0.0, golden["episode_joints"][row], golden["episode_object_position"][row], golden["episode_object_quaternion"][row],
            golden["episode_goal"], golden["episode_fingers"][row],
        )
        seen.append(observer(state, float(golden["episode_command"][row])))
        acted.append(bundle(seen[-1]))
    return {
        "observation_max_abs_error": float(np.abs(np.array(seen) - golden["episode_observations"]).max()),
        "action_max_abs_error": float(np.abs(np.array(acted) - golden["episode_actions"]).max()),
    }


REHEARSED_TICKS, REHEARSED_HZ = 20, 500.0
"""Ticks of the recorded episode that are replayed, its first second; the rate of the arm's waypoints, the highest of the drivers'."""


def rehearse(bundle: Bundle, form: Form) -> Iterator[Callable[[], Tick]]:
    """Without end, one tick after another of a runtime that is shown the recorded episode's first second over and over."""
    golden, manifest = bundle.golden, bundle.manifest
    joints = tuple(joint.name for joint in manifest.joints)
    runtime = Runtime(bundle, ArmInfo(manifest.robot.name, joints, manifest.gripper.joints, FORMS, REHEARSED_HZ), form)
    names = ("joints", "object_position", "object_quaternion", "fingers")
    rows = list(zip(*(golden[f"episode_{name}"][:REHEARSED_TICKS] for name in names), strict=True))
    for number in itertools.count():
        now, row = number * runtime.period, number % len(rows)
        arm, position, quaternion, fingers = rows[row]
        state = State(now, arm, position, quaternion, golden["episode_goal"], fingers)
        if row == 0:
            runtime.begin(state, now)
        yield partial(runtime.tick, state, now)


def time_ticks(bundle: Bundle, form: Form, ticks: int) -> np.ndarray:
    """(ticks, 3) [ms] that observing, deciding and commanding took in a rehearsal, after two seconds of warming up."""
    turns = rehearse(bundle, form)
    for tick in itertools.islice(turns, 2 * REHEARSED_TICKS):
        tick()
    return 1e3 * np.array([[done.times[stage] for stage in STAGES[1:4]] for done in (tick() for tick in itertools.islice(turns, ticks))])

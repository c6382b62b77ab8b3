"""Hostile ticks: wild policies and lying states against the runtime, and every command held against the manifest by another reader of it.

The arm obeys, more or less, in a world that lies now and then; nothing here waits for a clock. What must hold, tick by tick: the command
is finite and within the manifest's limits, a lie holds the arm in its own tick, what does not pass keeps it held, and it is then stopped.
"""

import dataclasses
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

import mujoco
import numpy as np

from toolkit.bundle.reading import Bundle
from toolkit.deploy.arm import FORMS, ArmInfo, Command, Form, State
from toolkit.deploy.kinematics import Kinematics, vector_of
from toolkit.deploy.motion import Expected
from toolkit.deploy.runtime import Runtime, Tick
from toolkit.deploy.safety import OVERSHOOT, PASSING

FAULTS = ("nan joint", "inf joint", "nan object", "stale", "future", "jump", "teleport", "fast", "effort", "fault", "lost", "short", "late")
"""What the world lies about."""
HARMED, TEMPER, NOT_FINITE = 0.03, 0.05, 0.005
"""Shares of ticks with a lie, with a policy that changes its temper, and with an action that is not finite."""
OBEYED, NOISE, AGE = 0.9, 2e-4, 0.002
"""Share of a command that comes true in a tick, noise of a joint [rad], and age of a state [s]."""
ROUNDING, NEARLY, ALIKE = 1e-9, 1e-6, 1e-12
"""By which a number may pass its limit: a rounding; where it went through a rotation; and between two ways to the same product."""
RATE = 100.0
"""[Hz] of the arm's waypoints."""


def _rotation(quaternion: tuple[float, ...] | np.ndarray) -> np.ndarray:
    """(3, 3) of a unit quaternion (4,), w first, written out: not the code under test."""
    w, x, y, z = quaternion
    return np.array([[1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
                     [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
                     [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)]])


class Checker:
    """The manifest's limits, read again and checked without the code that keeps them.

    Args:
        bundle: whose limits.
        form: of the commands.
    """

    def __init__(self, bundle: Bundle, form: Form) -> None:
        m = self.manifest = bundle.manifest
        self.form, self.period = form, 1.0 / m.policy_hz
        self.last: Command | None = None
        self._model = mujoco.MjModel.from_xml_string(bundle.mjcf)
        self._data = mujoco.MjData(self._model)
        self._address = [int(self._model.joint(joint.name).qposadr[0]) for joint in m.joints]
        self._start, self._base = _rotation(m.start.grasp_quaternion), _rotation(m.robot.base_quaternion)
        self._low, self._high = np.array(m.cartesian.low), np.array(m.cartesian.high)

    def begin(self) -> None:
        """A new episode."""
        self.last = None

    def breaches(self, command: Command, joints: np.ndarray) -> Iterator[str]:
        """What is wrong with a command for an arm that stands at angles (n,), in words; nothing if all is well."""
        numbers = np.concatenate([command.target, command.rate, command.waypoints.ravel(),
                                  [command.grip, command.opening, command.opening_m]])
        if not np.isfinite(numbers).all() or command.form != self.form:
            yield "the command is not finite, or of another form"
            return
        if command.grip not in (-1, 0, 1) or not 0 <= command.opening <= 1:
            yield "the gripper's command is none"
        if command.hold and (np.any(command.rate) or command.grip != 0):
            yield "a hold moves"
        yield from {"osc": self._osc, "pose": self._pose, "joint": self._joint}[self.form](command, joints)
        self.last = command

    def _osc(self, command: Command, joints: np.ndarray) -> Iterator[str]:
        m, action = self.manifest, command.target
        before = np.zeros(6) if self.last is None else self.last.target
        for entry, now, then in zip(m.action[:6], action, before, strict=True):
            if not entry.low <= now <= entry.high:
                yield f"{entry.name} is beyond its limits"
            # Slowing down may be as quick as the workspace asks for; speeding up may not.
            if (abs(now) > abs(then) or now * then < 0) and abs(now - then) > entry.step + ROUNDING:
                yield f"{entry.name} steps too far"
        if command.hold:
            if action.any():
                yield "a hold moves"
            return
        scale = np.repeat([m.controller.translation_m, m.controller.rotation_rad], 3)
        if (np.abs(action) * scale * np.abs(m.controller.response.steady) * m.policy_hz > np.array(m.cartesian.speed) + ROUNDING).any():
            yield "the expected speed is beyond the limit"
        here = self._coordinates(joints)
        goal = here + action * scale
        outside, already = (np.maximum(self._low - place, place - self._high) for place in (goal, here))
        if (outside > np.maximum(already, 0) + NEARLY).any():
            yield "the goal leaves the workspace box"

    def _pose(self, command: Command, joints: np.ndarray) -> Iterator[str]:
        m, speed = self.manifest, np.array(self.manifest.cartesian.speed)
        for row in command.waypoints:
            place = self._from_base(row)
            if abs(np.linalg.norm(row[3:]) - 1) > ROUNDING:
                yield "a quaternion is not of unit length"
            if (place < self._low - NEARLY).any() or (place > self._high + NEARLY).any():
                yield "a waypoint is outside the workspace box"
        if (np.abs(command.rate[:3]) > speed[:3] + ROUNDING).any():
            yield "the speed is beyond the limit"
        if self.last is not None and command.hold:
            if np.abs(command.target - self.last.target).max() > ALIKE:
                yield "a hold moves"
        elif self.last is not None:
            if np.abs(command.rate - self.last.rate).max() > max(m.cartesian.acceleration) * self.period + ROUNDING:
                yield "the acceleration is beyond the limit"
            if (np.abs(self._from_base(command.target) - self._from_base(self.last.target)) > speed * self.period + NEARLY).any():
                yield "a tick leads farther than the speed allows"

    def _joint(self, command: Command, joints: np.ndarray) -> Iterator[str]:
        entries = self.manifest.joints
        low = np.array([-np.inf if joint.low is None else joint.low for joint in entries])
        high = np.array([np.inf if joint.high is None else joint.high for joint in entries])
        speed, push = (np.array([getattr(joint, key) for joint in entries]) for key in ("speed", "acceleration"))
        if ((command.waypoints < low) | (command.waypoints > high)).any():
            yield "a waypoint is beyond a joint's limit"
        if (np.abs(command.rate) > speed + ROUNDING).any():
            yield "a joint is too fast"
        if self.last is not None:
            steps = np.diff(np.vstack([self.last.target, command.waypoints]), axis=0) / (self.period / len(command.waypoints))
            if (np.abs(steps) > speed + NEARLY).any():
                yield "a joint is too fast between waypoints"
            if command.hold and not np.array_equal(command.target, self.last.target):
                yield "a hold moves"
            if not command.hold and (np.abs(command.rate - self.last.rate) > push * self.period + ROUNDING).any():
                yield "a joint's acceleration is beyond the limit"
        place, reach = self._coordinates(command.target), OVERSHOOT + ROUNDING
        if (place < self._low - reach).any() or (place > self._high + reach).any():
            yield "the commanded angles lie outside the workspace box"

    def _coordinates(self, joints: np.ndarray) -> np.ndarray:
        self._data.qpos[self._address] = joints
        mujoco.mj_kinematics(self._model, self._data)
        site = self._model.site("grasp").id
        return np.append(self._data.site_xpos[site], vector_of(self._data.site_xmat[site].reshape(3, 3) @ self._start.T))

    def _from_base(self, row: np.ndarray) -> np.ndarray:
        position = np.array(self.manifest.robot.base_position_m) + self._base @ row[:3]
        return np.append(position, vector_of(self._base @ _rotation(row[3:]) @ self._start.T))


class SimulatedArm:
    """An arm that obeys, more or less, in a world that lies now and then.

    Args:
        bundle: whose arm.
        rng: of its noise and its lies.

    Attributes:
        state: the truth.
    """

    def __init__(self, bundle: Bundle, rng: np.random.Generator) -> None:
        self._bundle, self._rng, m = bundle, rng, bundle.manifest
        self.kinematics = Kinematics.of(m, bundle.mjcf)
        self._expected, self._base = Expected(m), _rotation(m.robot.base_quaternion)
        self._dofs = [int(self.kinematics.model.joint(joint.name).dofadr[0]) for joint in m.joints]
        self._low = np.array([-np.inf if joint.low is None else joint.low for joint in m.joints])
        self._high = np.array([np.inf if joint.high is None else joint.high for joint in m.joints])

    def begin(self, now: float) -> None:
        """Stand where the recorded episode began."""
        golden, none = self._bundle.golden, np.zeros(len(self._bundle.manifest.joints))
        joints, position, quaternion = (golden[f"episode_{key}"][0].copy() for key in ("joints", "object_position", "object_quaternion"))
        fingers = self._fingers = golden["episode_fingers"][0].copy()
        self.state = State(now, joints, position, quaternion, golden["episode_goal"].copy(), fingers, speeds=none,
                           efforts=none)
        self._expected.begin()

    def obey(self, command: Command) -> None:
        """A command comes true, but for a tenth and some noise."""
        joints = self.state.joints
        motion = command.target - joints if command.form == "joint" else self._joint_step(command)
        joints = np.clip(joints + OBEYED * motion, self._low, self._high) + self._rng.normal(0, NOISE, len(joints))
        self.state = dataclasses.replace(self.state, joints=joints)

    def _joint_step(self, command: Command) -> np.ndarray:
        """(n,) [rad] towards a pose, or as robosuite's controller answers a delta."""
        model, data = self.kinematics.model, self.kinematics.data
        self.kinematics.place(self.state.joints, self._fingers)
        if command.form == "osc":
            motion = self._expected.step(command.target)
        else:
            place = self._base @ command.target[:3] + np.array(self._bundle.manifest.robot.base_position_m)
            turn = self._base @ _rotation(command.target[3:]) @ self.kinematics.rotation.T
            motion = np.concatenate([place - self.kinematics.position, vector_of(turn)])
        mujoco.mj_comPos(model, data)
        jacobian = np.zeros((6, model.nv))
        mujoco.mj_jacSite(model, data, jacobian[:3], jacobian[3:], model.site("grasp").id)
        jacobian = jacobian[:, self._dofs]
        return jacobian.T @ np.linalg.solve(jacobian @ jacobian.T + 1e-3 * np.eye(6), motion)

    def read(self, now: float, injected: str) -> State:
        """What is reported at a time [s]: the truth, or a lie of FAULTS."""
        state, rng, n = dataclasses.replace(self.state, stamp=now - AGE), self._rng, len(self.state.joints)
        spoilt, which = state.joints.copy(), rng.integers(n)
        spoilt[which] = {"nan joint": np.nan, "inf joint": np.inf}.get(injected, spoilt[which] + 2.0)
        shift = state.object_position + rng.choice([-1, 1], 3) * 0.5
        changes: dict[str, dict[str, Any]] = {
            "nan joint": {"joints": spoilt}, "inf joint": {"joints": spoilt}, "teleport": {"joints": spoilt},
            "nan object": {"object_position": np.full(3, np.nan)}, "stale": {"stamp": now - 1}, "future": {"stamp": now + 1},
            "jump": {"object_position": np.abs(shift) + 0.8}, "fast": {"speeds": np.full(n, 50.0)},
            "effort": {"efforts": np.full(n, 1e4)}, "fault": {"fault": "protective stop"}, "lost": {"outcome": "lost"},
            "short": {"joints": state.joints[:-1]},
        }
        return dataclasses.replace(state, **changes.get(injected, {}))


def wild_policy(rng: np.random.Generator) -> Callable[[np.ndarray], np.ndarray]:
    """A policy whose temper changes: uniform, bang-bang, steady pushes, huge, and now and then not finite."""
    temper: dict[str, Any] = {"kind": "uniform", "push": np.zeros(7)}

    def act(observation: np.ndarray) -> np.ndarray:
        if rng.random() < TEMPER:
            temper["kind"] = rng.choice(["uniform", "bang", "steady", "huge"])
            temper["push"] = rng.choice([-1.0, 1.0], 7)
        action = {"uniform": lambda: rng.uniform(-1, 1, 7), "bang": lambda: rng.choice([-1.0, 1.0], 7),
                  "steady": lambda: temper["push"].copy(), "huge": lambda: 1e30 * rng.uniform(-1, 1, 7)}[temper["kind"]]()
        if rng.random() < NOT_FINITE:
            action[rng.integers(7)] = rng.choice([np.nan, np.inf, -np.inf])
        return action

    return act


@dataclass
class HostileTally:
    """What came of hostile ticks in one form of command.

    Attributes:
        form: of the commands.  ticks, episodes: played.  lies: told.
        faults: kind -> ticks held for it.
        breaches: what must not be -> how often.  first: the first of them, with its tick.
    """

    form: Form
    ticks: int = 0
    episodes: int = 0
    lies: int = 0
    faults: Counter = field(default_factory=Counter)
    breaches: Counter = field(default_factory=Counter)
    first: str = ""

    def to_json(self) -> dict[str, Any]:
        """As ``bench hostile --json`` prints it."""
        return self.__dict__ | {"faults": dict(self.faults), "breaches": dict(self.breaches)}

    def breach(self, what: str) -> None:
        """Count one."""
        self.first = self.first or f"tick {self.ticks}: {what}"
        self.breaches[what] += 1


def hostile_ticks(
    bundle: Bundle, form: Form, ticks: int, seed: int, progress: Callable[[int], None] = lambda done: None,
    policy: Callable[[np.ndarray], np.ndarray] | None = None,
) -> HostileTally:
    """Play ticks of a wild policy in a world that lies.

    Args:
        bundle, form: of the runtime.
        ticks: how many.
        seed: of policy, noise and lies.
        progress: told of every thousandth tick.
        policy: in place of the wild one.
    """
    rng, m = np.random.default_rng(seed), bundle.manifest
    info = ArmInfo(m.robot.name, tuple(joint.name for joint in m.joints), m.gripper.joints, FORMS, RATE)
    runtime = Runtime(bundle, info, form, policy or wild_policy(rng))
    arm, checker, tally = SimulatedArm(bundle, rng), Checker(bundle, form), HostileTally(form)
    now, alive, latched, held, deck = 0.0, False, False, 0, list[str]()
    while tally.ticks < ticks:
        now += runtime.period
        if not alive:
            arm.begin(now)
            checker.begin()
            fault = runtime.begin(arm.state, now)
            if fault is not None:
                tally.breach(f"a good start is refused: {fault.kind}")
                return tally
            alive, latched, held = True, False, 0
            tally.episodes += 1
        injected = ""
        if rng.random() < HARMED:
            deck = deck or list(rng.permutation(FAULTS))
            injected = str(rng.choice(FAULTS)) if latched else str(deck.pop())  # every lie comes to an arm that still moves
            tally.lies += 1
        tick = runtime.tick(arm.read(now, injected), now, late=injected == "late")
        for what in (*checker.breaches(tick.command, arm.state.joints), *_wrong(tick, injected, latched)):
            tally.breach(what)
        if tick.fault is not None:
            tally.faults[tick.fault.kind] += 1
            latched, held = latched or tick.fault.kind not in PASSING, held + 1
        else:
            held = 0
        if (tick.stop is not None) != (held > m.watch.hold_ticks):
            tally.breach(f"after {held} held ticks the arm is {'not stopped' if tick.stop is None else 'stopped'}")
        alive = tick.stop is None
        arm.obey(tick.command)
        tally.ticks += 1
        if tally.ticks % 1000 == 0:
            progress(tally.ticks)
    return tally


def _wrong(tick: Tick, injected: str, latched: bool) -> Iterator[str]:
    if injected not in ("", "late") and tick.fault is None:
        yield f"{injected} went unnoticed"
    if tick.fault is None and not np.isfinite(tick.action).all():
        yield "a command without an action"
    if tick.command.hold != (tick.fault is not None):
        yield "held without a fault, or not held with one"
    if tick.fault is None and latched:
        yield "the arm went on after a fault that does not pass"

"""Where a policy holds: the unmodified robosuite robot, played under the conditions of a laboratory.

Nothing is trained here. A condition is one number (a mass, a delay, a noise) that is changed while all else stays as it was in
training; each is tried alone at several values, and then several together, in random pairs within the ranges found. The range of a
condition is the interval around its nominal value in which at least ``GOOD`` of the episodes succeed.
"""

import json
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from robots.robot import Robot
from tasks.pick import START_POSITION, START_ROTATION, PickTask, observe
from toolkit.bundle.reading import load_bundle
from toolkit.errors import ToolkitError
from toolkit.io.claims import open_claimed
from toolkit.learning.policy import GaussianPolicy
from toolkit.morphology.native_scene import NativeScene
from toolkit.quiet import start_worker
from toolkit.runs.seeds import EVALUATION_SEEDS
from toolkit.simulation.native import NativeRobot

GOOD = 0.9
"""Success rate from which on a condition counts as borne."""
PAIR_SEED = 22
"""Of the random pairs, and of what conditions draw per episode."""
GRAVITY = 9.81
"""[m/s^2]"""


@dataclass(frozen=True)
class Condition:
    """One number of a laboratory.

    Attributes:
        name, unit, meaning: for tables and the manifest.
        nominal: its value in training.
        values: that are tried, rising, the nominal one not among them.
    """

    name: str
    unit: str
    meaning: str
    nominal: float
    values: tuple[float, ...]


CONDITIONS: dict[str, Condition] = {
    condition.name: condition
    for condition in (
        Condition("object_mass", "1", "mass of the object, of its own", 1.0, (0.25, 0.5, 2.0, 3.0, 5.0)),
        Condition("object_friction", "1", "sliding friction of the object alone, of its own", 1.0, (0.25, 0.5, 1.5, 2.0)),
        Condition("friction", "1", "sliding friction of everything, of its own", 1.0, (0.25, 0.5, 0.75, 1.5, 2.0)),
        Condition("object_size", "1", "size of the object, of its own", 1.0, (0.8, 0.9, 1.1, 1.2)),
        Condition("pose_noise", "m", "standard deviation of the seen position of the object, anew in every step", 0.0,
                  (0.002, 0.005, 0.01, 0.02)),
        Condition("pose_bias", "m", "distance by which the object is seen beside its place, in a direction drawn per episode", 0.0,
                  (0.005, 0.01, 0.015, 0.02)),
        Condition("yaw_error", "rad", "angle by which the object is seen turned", 0.0, (-0.35, -0.17, 0.17, 0.35)),
        Condition("delay", "steps", "policy steps by which all that is seen is late", 0.0, (1.0, 2.0, 3.0, 4.0)),
        Condition("start_posture", "rad", "half width of the uniform error of each arm joint at the start", 0.0, (0.02, 0.035, 0.07)),
        Condition("table_height", "m", "of the table with object and goal, from what it was", 0.0, (-0.03, -0.02, -0.01, 0.01, 0.02, 0.03)),
        Condition("goal_shift", "m", "distance of the goal from where it was, in a horizontal direction drawn per episode", 0.0,
                  (0.02, 0.05, 0.1)),
        Condition("controller_gain", "1", "stiffness of the controller, of its own; critically damped", 1.0, (0.5, 0.75, 1.5, 2.0)),
        Condition("control_rate", "1", "rate of the policy, of its own", 1.0, (0.5, 0.75, 1.25, 1.5)),
        Condition("payload", "kg", "weight on the hand that the controller does not know", 0.0, (0.2, 0.5, 1.0)),
        Condition("gravity_error", "1", "share of gravity that the controller's compensation misses; negative: gives too much", 0.0,
                  (-0.1, -0.05, 0.05, 0.1)),
    )
}


class StressedRobot(NativeRobot):
    """An unmodified robosuite robot under other conditions, which each ``begin`` sets anew.

    Args:
        robot, task: as for NativeRobot.

    Attributes:
        conditions: name -> value; what is not named is nominal.
    """

    def __init__(self, robot: Robot, task: PickTask) -> None:
        super().__init__(robot, task)
        self.conditions: dict[str, float] = {}
        model = self.model
        self._object = int(self.env.object_body)
        self._geoms = [g for g in range(model.ngeom) if model.geom_bodyid[g] == self._object]
        scene = NativeScene(model)
        self._arm_qpos, self._arm_dofs, self._hand = scene.arm_qpos, scene.arm_dofs, scene.hand
        self._table = model.body("table").id
        self._nominal = {name: np.array(getattr(model, name)) for name in ("body_mass", "body_inertia", "body_pos", "geom_friction",
                                                                           "geom_size", "geom_rbound", "geom_aabb")}
        self._rng = np.random.default_rng(0)
        self._seen: deque[np.ndarray] = deque()

    def value(self, name: str) -> float:
        """Of a condition."""
        return self.conditions.get(name, CONDITIONS[name].nominal)

    def begin(self, seed: int) -> np.ndarray:
        """Reset to the start of a seed under the conditions; returns the observation (n_obs,)."""
        model, value = self.model, self.value
        for name, nominal in self._nominal.items():
            getattr(model, name)[:] = nominal
        size = value("object_size")
        model.body_mass[self._object] *= value("object_mass")
        model.body_inertia[self._object] *= value("object_mass") * size**2
        model.geom_friction[:, 0] *= value("friction")
        for geom in self._geoms:
            model.geom_friction[geom, 0] *= value("object_friction")
            model.geom_size[geom] *= size
            model.geom_rbound[geom] *= size
            model.geom_aabb[geom] *= size
        lift = value("table_height")
        model.body_pos[self._table, 2] += lift
        mujoco.mj_setConst(model, self.data)
        self.env.control_timestep = 1.0 / (self.task.control_frequency * value("control_rate"))
        self._rng = np.random.default_rng([seed, PAIR_SEED])
        self._bias = value("pose_bias") * self._direction(3)
        self._seen.clear()
        super().begin(seed)
        qpos = self.data.qpos
        at = int(model.jnt_qposadr[model.body_jntadr[self._object]])
        qpos[at + 2] += lift + (size - 1.0) * self.task.object.half_height
        qpos[self._arm_qpos] += value("start_posture") * self._rng.uniform(-1, 1, len(self._arm_qpos))
        self.env.goal = self.env.goal + np.append(value("goal_shift") * self._direction(2), lift)
        controller = self.env.robots[0].part_controllers["right"]
        controller.kp = np.array(controller.kp) * value("controller_gain")
        controller.kd = np.array(controller.kd) * np.sqrt(value("controller_gain"))
        self.env.sim.forward()
        controller.update(force=True)
        controller.reset_goal()
        self._seen.clear()
        return self.observe()

    def _direction(self, size: int) -> np.ndarray:
        """A random unit vector."""
        vector = self._rng.normal(size=size)
        return vector / np.linalg.norm(vector)

    def apply(self, native: np.ndarray) -> np.ndarray:
        """See NativeRobot, with the forces that the controller does not know of."""
        data = self.data
        data.xfrc_applied[self._hand, 2] = -GRAVITY * self.value("payload")
        dofs = self._arm_dofs
        data.qfrc_applied[dofs] = -self.value("gravity_error") * data.qfrc_bias[dofs]
        return super().apply(native)

    def observe(self) -> np.ndarray:
        """The observation record (n_obs,), as seen: noisy, biased, turned and late."""
        data, env = self.data, self.env
        noise = self.value("pose_noise")
        seen = env.object_position + self._bias + (noise * self._rng.normal(size=3) if noise else 0.0)
        turn, angle = np.eye(3), self.value("yaw_error")
        turn[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
        fingers = np.array([sign * (data.qpos[q] - start) if q >= 0 else 0.0 for q, sign, start in self._fingers])
        found = observe(
            fingers, self.law.progress(self.command), data.site_xpos[self._site], data.site_xmat[self._site].reshape(3, 3),
            seen, turn @ env.object_rotation, env.goal, START_POSITION, START_ROTATION,
        )
        self._seen.append(found)
        while len(self._seen) > int(self.value("delay")) + 1:
            self._seen.popleft()
        return self._seen[0]


# ---- what is tried ---------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Tried:
    """Success under one set of conditions.

    Attributes:
        conditions: name -> value; empty: all nominal.
        episodes, successes: counts.
    """

    conditions: Mapping[str, float]
    episodes: int
    successes: int

    @property
    def rate(self) -> float:
        """Share of successful episodes."""
        return self.successes / self.episodes


def single_trials(names: Sequence[str]) -> list[dict[str, float]]:
    """The nominal conditions, and every value of every named one alone.

    Raises:
        ToolkitError: no such condition.
    """
    odd = [name for name in names if name not in CONDITIONS]
    if odd:
        raise ToolkitError(f"no condition is named {odd[0]!r}; there are: {', '.join(CONDITIONS)}")
    return [{}, *({name: value} for name in names for value in CONDITIONS[name].values)]


def pair_trials(ranges: Mapping[str, tuple[float, float]], count: int) -> list[dict[str, float]]:
    """``count`` random pairs of conditions, each at a random value within its range; conditions that bear nothing are left out."""
    rng, names, out = np.random.default_rng(PAIR_SEED), [name for name, (low, high) in ranges.items() if low < high], []
    for _ in range(count if len(names) > 1 else 0):
        chosen = sorted(rng.choice(names, 2, replace=False))
        drawn = {str(name): round(float(rng.uniform(*ranges[name])), 4) for name in chosen}
        out.append({name: float(round(value)) if name == "delay" else value for name, value in drawn.items()})
    return out


def ranges_of(tried: Sequence[Tried]) -> dict[str, tuple[float, float]]:
    """Condition -> the interval of tried values around the nominal one in which success is at least GOOD.

    Both ends are the nominal value where its neighbours are not borne, or where the nominal conditions themselves are not.
    """
    out: dict[str, tuple[float, float]] = {}
    nominal = next((t for t in tried if not t.conditions), None)
    alone = [t for t in tried if len(t.conditions) == 1]
    for name in dict.fromkeys(name for t in alone for name in t.conditions):
        middle = CONDITIONS[name].nominal
        found = {t.conditions[name]: t.rate >= GOOD for t in alone if name in t.conditions}
        ends = [middle, middle]
        if nominal is None or nominal.rate >= GOOD:
            for side, values in enumerate((sorted((v for v in found if v < middle), reverse=True), sorted(v for v in found if v > middle))):
                for value in values:
                    if not found[value]:
                        break
                    ends[side] = value
        out[name] = (ends[0], ends[1])
    return out


# ---- playing ---------------------------------------------------------------------------------------------------------


class _Player:
    """Plays a policy on a stressed robot, which is loaded anew once its simulation has blown up.

    Args:
        robot, task, policy: as for ``stress``.
    """

    def __init__(self, robot: Robot, task: PickTask, policy: GaussianPolicy | Path) -> None:
        self._load = partial(StressedRobot, robot, task)
        self._stressed: StressedRobot | None = None
        self._native = isinstance(policy, Path)
        self._act = load_bundle(policy) if isinstance(policy, Path) else policy.mean

    def play(self, conditions: Mapping[str, float], seed: int) -> bool:
        """Whether the episode of a seed succeeds under conditions."""
        self._stressed = self._stressed or self._load()
        self._stressed.conditions = dict(conditions)
        try:
            return self._stressed.play(self._act, seed, native=self._native)
        except (ArithmeticError, ValueError, mujoco.FatalError):  # a simulation that blew up is no success
            self._stressed = None
            return False


_own_player: _Player | None = None
"""A worker process's, which lives for one stress test: of one robot, task and policy."""


def _play_in_worker(
    robot: Robot, task: PickTask, policy: GaussianPolicy | Path, conditions: Mapping[str, float], seed: int
) -> bool:
    global _own_player
    if _own_player is None:
        _own_player = _Player(robot, task, policy)
    return _own_player.play(conditions, seed)


def _key(conditions: Mapping[str, float], seed: int) -> str:
    return json.dumps([dict(sorted(conditions.items())), seed])


class Ledger:
    """Episodes played so far, one JSON line each, so that a stress test goes on where it was stopped.

    Args:
        path: file; None: nothing is kept.
        about: what is played; a file of something else is refused.

    Raises:
        ToolkitError: the file cannot be written, or belongs to another test.
    """

    def __init__(self, path: Path | None, about: dict[str, Any]) -> None:
        self.known: dict[str, bool] = {}
        self._file = None
        if path is None:
            return
        try:
            self._file = open_claimed(path, "a+", "--out")
            self._file.seek(0)
            lines = self._file.read().splitlines()
        except OSError as error:
            raise ToolkitError(f"{path} cannot be written ({error.strerror}); choose another --out") from None
        if not lines:
            self._write(about)
            return
        rows = []
        for line in lines:
            try:
                rows.append(json.loads(line))
            except ValueError:  # the last line of a test that was killed
                continue
        if not rows or rows[0] != about:
            raise ToolkitError(f"{path} is of another stress test ({str(rows[0] if rows else '')[:200]}); choose another --out")
        self.known = {_key(row["conditions"], row["seed"]): bool(row["success"]) for row in rows[1:] if isinstance(row, dict)}
        self._file.write("\n" if not lines[-1].endswith("}") else "")

    def add(self, conditions: Mapping[str, float], seed: int, success: bool) -> None:
        """Remember an episode."""
        self.known[_key(conditions, seed)] = success
        self._write({"conditions": dict(conditions), "seed": seed, "success": success})

    def _write(self, row: dict[str, Any]) -> None:
        if self._file is not None:
            self._file.write(json.dumps(row) + "\n")
            self._file.flush()

    def close(self) -> None:
        """Finish the file."""
        if self._file is not None:
            self._file.close()


def stress(
    policy: GaussianPolicy | Path,
    robot: Robot,
    task: PickTask,
    trials: Sequence[Mapping[str, float]],
    episodes: int,
    ledger: Ledger,
    workers: int,
    progress: Callable[[int, int, str], None] = lambda done, total, what: None,
) -> list[Tried]:
    """Play every trial on the same seeds, those of evaluate.

    Args:
        policy: or the path of a bundle, whose ONNX graph then plays alone.
        robot, task: the unmodified robot, and what it does.
        trials: conditions by name.
        episodes: of each.
        ledger: of what was played before.
        workers: processes.
        progress: told of episodes done, of how many, and the last trial.

    Raises:
        ToolkitError: a process was killed.
    """
    seeds = [EVALUATION_SEEDS + i for i in range(episodes)]
    todo = [(trial, seed) for trial in trials for seed in seeds if _key(trial, seed) not in ledger.known]
    total = len(trials) * episodes
    done = total - len(todo)
    for (trial, seed), success in _played((robot, task, policy), todo, workers):
        ledger.add(trial, seed, success)
        done += 1
        progress(done, total, told_of(trial))
    return [Tried(dict(trial), episodes, sum(ledger.known[_key(trial, seed)] for seed in seeds)) for trial in trials]


Todo = tuple[Mapping[str, float], int]
"""Conditions by name, and a seed."""


def _played(
    who: tuple[Robot, PickTask, GaussianPolicy | Path], todo: Sequence[Todo], workers: int
) -> Iterator[tuple[Todo, bool]]:
    """What was to be done with its success, as it comes."""
    if workers == 1 or len(todo) < 2:
        player = _Player(*who)
        yield from ((what, player.play(*what)) for what in todo)
        return
    try:
        with ProcessPoolExecutor(workers, mp_context=get_context("spawn"), initializer=start_worker) as pool:
            futures = {pool.submit(_play_in_worker, *who, *what): what for what in todo}
            try:
                for future in as_completed(futures):
                    yield futures[future], future.result()
            finally:
                pool.shutdown(wait=True, cancel_futures=True)
    except BrokenProcessPool:
        raise ToolkitError(f"one of {workers} processes was killed, perhaps for want of memory; free memory, and go on with the same "
                           "command") from None


def told_of(conditions: Mapping[str, float]) -> str:
    """Conditions in a few words."""
    return ", ".join(f"{name} {value:g} {CONDITIONS[name].unit}".removesuffix(" 1") for name, value in conditions.items()) or "nominal"

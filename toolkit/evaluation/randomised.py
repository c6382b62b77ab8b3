"""Training where a laboratory is: the unmodified robot under conditions that every episode draws anew.

The conditions are those that ``meta-evolve stress`` names and measures; here they disturb the fast engine's robot, so that a path's last
hop can be trained under them (domain randomisation, Tobin et al. 2017).
"""

import itertools
from collections import deque
from collections.abc import Mapping
from pathlib import Path

import mujoco
import numpy as np

from tasks.task import Task
from toolkit.errors import ToolkitError
from toolkit.evaluation.stress import CONDITIONS
from toolkit.evaluation.success import Evaluation
from toolkit.io.jsonfiles import read_object
from toolkit.learning.policy import GaussianPolicy, MeanActor
from toolkit.morphology.lab import System
from toolkit.morphology.native_scene import NativeScene
from toolkit.runs.seeds import EVALUATION_SEEDS
from toolkit.simulation.plant import Plant
from toolkit.simulation.rollout import NativeEngine

TRAINABLE = ("object_mass", "object_friction", "friction", "pose_noise", "pose_bias", "yaw_error", "delay", "start_posture", "goal_shift")
"""Conditions that the fast engine's robot can be put under; the others change its controller, its table or what it weighs."""
POSITIVE = ("object_mass", "object_friction", "friction")
DRAWS = 29
"""Of the generator of what an episode draws, beside its seed."""
DISTURBED = ("body_mass", "body_inertia", "geom_friction")
"""Fields of the model that a condition changes."""

Ranges = Mapping[str, tuple[float, float]]
"""Condition -> from, to; each episode draws its value uniformly between, a delay in whole steps."""


def read_ranges(file: Path) -> dict[str, tuple[float, float]]:
    """Conditions from a JSON file: {"pose_noise": [0, 0.02], "delay": [0, 4]}.

    Raises:
        ToolkitError: it cannot be read, or a condition is unknown, or its range is none.
    """
    mend = 'give conditions with their ranges, such as {"pose_noise": [0, 0.02], "delay": [0, 4]}'
    out: dict[str, tuple[float, float]] = {}
    for name, pair in read_object(file, mend).items():
        if name not in TRAINABLE:
            raise ToolkitError(f"{file} names {name[:40]!r}, under which nothing can be trained; there are: {', '.join(TRAINABLE)}")
        numbers = isinstance(pair, list) and len(pair) == 2 and all(type(value) in (int, float) for value in pair)
        if not numbers or not np.isfinite(pair).all() or not pair[0] <= pair[1]:
            raise ToolkitError(f"{file} gives {name} the range {str(pair)[:40]}; {mend}")
        low, high = map(float, pair)
        if name != "yaw_error" and (low < 0.0 or (name in POSITIVE and low == 0.0)):
            raise ToolkitError(f"{file} gives {name} the value {low:g}; it cannot be {'negative' if low < 0 else 'zero'}")
        if name == "delay" and not (low.is_integer() and high.is_integer()):
            raise ToolkitError(f"{file} gives delay the range {low:g} to {high:g}; it counts whole policy steps")
        out[name] = low, high
    if not out:
        raise ToolkitError(f"{file} names no condition; {mend}")
    return out


class RandomisedRobot:
    """An unmodified robot of the fast engine under conditions that each ``begin`` draws by its seed; a Drivable.

    Args:
        robot: undisturbed; in a task that picks an object up.
        ranges: of the conditions.

    Attributes:
        drawn: condition -> its value in this episode.
    """

    def __init__(self, robot: Plant, ranges: Ranges) -> None:
        self._robot, self._ranges = robot, dict(ranges)
        self.model, self.data, self.task, self.before, self.substeps = robot.model, robot.data, robot.task, robot.before, robot.substeps
        self.law, self.object_body = robot.law, robot.object_body
        ends = dict(zip(robot.task.observation, itertools.accumulate(robot.task.observation.values()), strict=True))
        self._entry = {name: slice(ends[name] - size, ends[name]) for name, size in robot.task.observation.items()}
        self._nominal = {name: np.array(getattr(self.model, name)) for name in DISTURBED}
        self._arm = NativeScene(self.model).arm_qpos
        self.drawn: dict[str, float] = {}
        self._seen: deque[np.ndarray] = deque()

    @property
    def command(self) -> np.ndarray:
        """See Drivable."""
        return self._robot.command

    @command.setter
    def command(self, value: np.ndarray) -> None:
        self._robot.command = value

    @property
    def goal(self) -> np.ndarray:
        """See Drivable."""
        return self._robot.goal

    @goal.setter
    def goal(self, value: np.ndarray) -> None:
        self._robot.goal = value

    @property
    def at_goal(self) -> bool:
        """See Drivable."""
        return self._robot.at_goal

    @property
    def lost(self) -> bool:
        """See Drivable."""
        return self._robot.lost

    @property
    def diverged(self) -> bool:
        """See Drivable."""
        return self._robot.diverged

    @property
    def torque_share(self) -> float:
        """See Drivable."""
        return self._robot.torque_share

    @property
    def grasp_position(self) -> np.ndarray:
        """See Plant."""
        return self._robot.grasp_position

    @property
    def object_position(self) -> np.ndarray:
        """See Plant: where it is, not where it is seen."""
        return self._robot.object_position

    def aim(self, action: np.ndarray) -> np.ndarray:
        """See Plant."""
        return self._robot.aim(action)

    def begin(self, seed: int) -> np.ndarray:
        """Reset to the start of a seed, under the conditions that it draws; returns the observation (n_obs,)."""
        model, rng = self.model, np.random.default_rng((seed, DRAWS))
        self.drawn = {name: self._draw(name, rng) for name in self._ranges}
        value = lambda name: self.drawn.get(name, CONDITIONS[name].nominal)  # noqa: E731
        for name, nominal in self._nominal.items():
            getattr(model, name)[:] = nominal
        item = self._robot.object_body
        model.body_mass[item] *= value("object_mass")
        model.body_inertia[item] *= value("object_mass")
        model.geom_friction[:, 0] *= value("friction")
        model.geom_friction[model.geom_bodyid == item, 0] *= value("object_friction")
        mujoco.mj_setConst(model, self.data)
        self._robot.begin(seed)
        self.data.qpos[self._arm] += value("start_posture") * rng.uniform(-1.0, 1.0, len(self._arm))
        mujoco.mj_forward(model, self.data)
        self._robot.goal = self._robot.goal + np.append(value("goal_shift") * _direction(rng, 2), 0.0)
        self._bias, self._noise, self._yaw = value("pose_bias") * _direction(rng, 3), value("pose_noise"), value("yaw_error")
        self._rng, self._seen = rng, deque(maxlen=int(value("delay")) + 1)
        return self.observe()

    def _draw(self, name: str, rng: np.random.Generator) -> float:
        low, high = self._ranges[name]
        return float(rng.integers(int(low), int(high) + 1)) if name == "delay" else float(rng.uniform(low, high))

    def step(self, action: np.ndarray) -> np.ndarray:
        """See Drivable."""
        self._robot.step(action)
        return self.observe()

    def set_command(self, action: np.ndarray) -> None:
        """See Drivable."""
        self._robot.set_command(action)

    def play_substeps(self, action: np.ndarray, count: int, sets_goal: bool) -> None:
        """See Drivable."""
        self._robot.play_substeps(action, count, sets_goal)

    def observe(self) -> np.ndarray:
        """The observation record (n_obs,), as seen: beside its place, noisy, turned and late. Once per policy step."""
        row = np.array(self._robot.observe())
        shift = self._bias + (self._noise * self._rng.normal(size=3) if self._noise else 0.0)
        row[self._entry["object_from_grasp"]] += shift
        row[self._entry["goal_from_object"]] -= shift
        if self._yaw:
            turn = np.eye(3)
            turn[:2, :2] = [[np.cos(self._yaw), -np.sin(self._yaw)], [np.sin(self._yaw), np.cos(self._yaw)]]
            seen = turn @ self.data.xmat[self._robot.object_body].reshape(3, 3)
            row[self._entry["object_rotation"]] = 0.5 * (seen - seen.T)[[2, 0, 1], [1, 2, 0]]  # axis times sine of the angle
        self._seen.append(row)
        return self._seen[0]


def _direction(rng: np.random.Generator, size: int) -> np.ndarray:
    """A random unit vector."""
    vector = rng.normal(size=size)
    return vector / np.linalg.norm(vector)


class RandomisedEngine(NativeEngine):
    """Plays episodes on an unmodified robot under conditions that every episode draws by its seed.

    Args:
        robot, task, threads, dump: as for NativeEngine.
        ranges: of the conditions.
    """

    def __init__(self, robot: System, task: Task, ranges: Ranges, threads: int | None = None, dump: Path | None = None) -> None:
        super().__init__(robot, task, threads, dump)
        plain = [self._idle.get() for _ in range(self.threads)]
        for plant in plain:
            self._idle.put(RandomisedRobot(plant, ranges))


def evaluate_randomised(policy: GaussianPolicy, robot: System, task: Task, ranges: Ranges, episodes: int) -> Evaluation:
    """As ``evaluate_compiled``, on the same seeds, under conditions that each episode draws."""
    seeds = [EVALUATION_SEEDS + i for i in range(episodes)]
    engine = RandomisedEngine(robot, task, ranges)
    played = engine.play(MeanActor(policy), [np.zeros(1)] * episodes, seeds)
    engine.close()
    successes, diverged = (sum(getattr(e, key) for e in played) for key in ("success", "diverged"))
    return Evaluation(robot.name, "native-compiled", episodes, successes, diverged, seeds[0])

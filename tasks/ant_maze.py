"""An ant finds its way out of a maze: the paper's second experiment, on a maze of our own, as its is not public.

A U of five cells of 3 m around a wall, whose last cell is open to the outside (x to the east, y to the north, the centre at 0):

    +-----------+
    | start ->  |
    +-----+     |
    |#####|  |  |
    +-----+  v  |
    <- out <-   |
    ------------+

The way is 12.5 m, so that an episode of 10 s, as long as the paper's, asks for a mean speed of 1.25 m/s from rest: ants run twice as fast,
but heavier ones have to be able to leave it as well.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import mujoco
import numpy as np

from robots.ant import ANTS, gymnasium_ant
from robots.model_robot import ModelRobot
from tasks.ant_symmetry import eastwards, given_back
from tasks.record import Entry, Record
from tasks.task import PractisedTask

if TYPE_CHECKING:
    import gymnasium

CELL = 3.0
"""Width [m] of the corridors; an ant's feet stand 2 m apart."""
WALL_HEIGHT, WALL_WIDTH = 1.0, 0.3
"""Of the walls [m]; that in the middle is a cell wide."""
EAST, NORTH = CELL, 1.5 * CELL
"""Distances [m] of the outer walls' inner faces from the centre."""
OUT_EAST, OUT_NORTH = EAST + WALL_WIDTH, NORTH + WALL_WIDTH
"""Distances [m] of their outer faces."""
WALLS: dict[str, tuple[float, float, float, float]] = {
    "north": (-OUT_EAST, OUT_EAST, NORTH, OUT_NORTH),
    "east": (EAST, OUT_EAST, -NORTH, NORTH),
    "south": (-OUT_EAST, OUT_EAST, -OUT_NORTH, -NORTH),
    "west": (-OUT_EAST, -EAST, -CELL / 2, NORTH),
    "middle": (-EAST, 0.0, -CELL / 2, CELL / 2),
}
"""Least and greatest x, least and greatest y [m] of each wall."""
START = (-CELL / 2, CELL)
"""Centre of the first cell [m]."""
START_SHIFT, START_YAW = 0.15, 0.1
"""Half widths of the uniform noise on where the ant starts [m] and how it is turned [rad]: its legs are straight there, and those of the
longest and widest one nearly reach the walls."""
ALONG = 0.5
"""Half width [m] of the uniform noise about the centre line, where an ant starts anywhere along it to learn."""
SCATTERED = 0.75
"""Share of the episodes to learn from that start there."""
LOOK_AHEAD = 1.2
"""How far ahead on the centre line [m] an ant heads that is guided along it."""
FLOOR_YAW = 0.8
"""Half width [rad] of the uniform yaw from which an ant learns to run east; by symmetry it never needs more than an eighth of a turn."""
RESET_NOISE = 0.1
"""Half width of the uniform noise on every number of the start's configuration, and standard deviation of its speeds, as in Ant-v5."""

_JOINTS = [f"{joint}_{leg}" for leg in range(1, 5) for joint in ("hip", "ankle")]
# Thicker legs and wider mounts shift the angles and the height at which an ant trots, and where it believes to be decides where it turns.
OBSERVATION = Record({
    "height": Entry(1, "m", "world", "of the torso", scale=0.1, explored=0.03),
    "orientation": Entry(4, "1", "world", "of the torso, quaternion, w first", scale=0.2),
    **{name: Entry(1, "rad", "joint", "angle", scale=0.3, explored=0.05) for name in _JOINTS},
    "velocity": Entry(3, "m/s", "world", "of the torso", scale=1.0, explored=0.3),
    "angular_velocity": Entry(3, "rad/s", "torso", "of the torso", scale=1.0),
    **{f"{name}_speed": Entry(1, "rad/s", "joint", "speed", scale=5.0) for name in _JOINTS},
    "place": Entry(2, "cells", "world", "x and y of the torso", scale=0.2, explored=0.1),
})
"""The observation record: Ant-v5's without contact forces, and where the ant is."""
ACTION = Record({
    f"{joint}_{leg}": Entry(1, "1", "joint", "share of the joint's greatest torque", explored=0.05)
    for leg in (4, 1, 2, 3) for joint in ("hip", "ankle")
})
"""The action record, in the order of ant.xml's motors."""


@dataclass(frozen=True)
class AntMaze(PractisedTask):
    """Leave the maze by its opening.

    Attributes:
        horizon: policy steps of an episode (paper, appendix, hyperparameters: 200).
        along: share of episodes that start anywhere along the centre line, to learn from; 0: the task itself.
    """

    horizon: int = 200
    along: float = 0.0

    name = "ant-maze"
    observation = OBSERVATION
    action = ACTION
    family = ANTS.name
    control_frequency = 20.0
    substeps = 5
    hold_steps = 1

    def spec(self, robot: ModelRobot) -> mujoco.MjSpec:
        """The ant at the start's centre in the maze."""
        spec = _ant_at_the_start(robot)
        for name, (west, east, south, north) in WALLS.items():
            spec.worldbody.add_geom(
                name=name, type=mujoco.mjtGeom.mjGEOM_BOX, conaffinity=1, rgba=[0.55, 0.6, 0.65, 1.0],
                pos=[(west + east) / 2, (south + north) / 2, WALL_HEIGHT / 2],
                size=[(east - west) / 2, (north - south) / 2, WALL_HEIGHT / 2],
            )
        return spec

    def scene(self, model: mujoco.MjModel, data: mujoco.MjData) -> "AntInMaze":
        """The ant in the maze."""
        return AntInMaze(model, data, self.along)

    def progress(self, observations: np.ndarray) -> np.ndarray:
        """How far along the centre line (N,) [m] the ant is in each observation (N, 29); at the first cell's centre 0, see ``distance``."""
        return distance(*(observations[:, -2:].T * CELL))

    def miss(self, observation: np.ndarray) -> float:
        """Way to the opening that is left [m]."""
        return LENGTH - float(self.progress(observation[None])[0])

    def practice(self) -> "AntFloor":
        """To run, where nothing is in the way."""
        return AntFloor()

    def scattered(self) -> "AntMaze":
        """Most episodes start anywhere along the centre line."""
        return replace(self, along=SCATTERED)

    def gains(self, observations: np.ndarray) -> np.ndarray:
        """Progress (T,) [m]."""
        return np.diff(self.progress(observations))

    def guided(self, act: Callable[[np.ndarray], np.ndarray]) -> Callable[[np.ndarray], np.ndarray]:
        """Who runs east heads for a point of the centre line ahead, and its legs change parts when the ant has turned too far from it."""

        def guided(observations: np.ndarray) -> np.ndarray:
            places = observations[:, -2:] * CELL
            ahead = np.array([centre_line(along + LOOK_AHEAD) for along in distance(*places.T)])
            seen, quarters = eastwards(observations[:, :-2], np.arctan2(*(ahead - places).T[::-1]))
            return given_back(act(np.column_stack([seen, np.zeros_like(places)])), quarters)

        return guided

    def environment(self, robot: ModelRobot) -> "gymnasium.Env":
        """The same scene, stepped by gymnasium's AntEnv."""
        from tasks.ant_maze_env import AntMazeEnv

        return AntMazeEnv(self, robot)


@dataclass(frozen=True)
class AntFloor(AntMaze):
    """Run east on an open floor, from any yaw within an eighth of a turn. Nothing ends it but a fall; the place is not to be seen."""

    horizon: int = 100

    def spec(self, robot: ModelRobot) -> mujoco.MjSpec:
        """The ant, and no wall."""
        return _ant_at_the_start(robot)

    def scene(self, model: mujoco.MjModel, data: mujoco.MjData) -> "AntOnFloor":
        """The ant on the floor."""
        return AntOnFloor(model, data)

    def gains(self, observations: np.ndarray) -> np.ndarray:
        """Way to the east (T,) [m], from the speeds before and after each step."""
        east = observations[:, 13]
        return (east[:-1] + east[1:]) / 2 / self.control_frequency


def _ant_at_the_start(robot: ModelRobot) -> mujoco.MjSpec:
    spec = gymnasium_ant()
    spec.body("torso").pos[:2] = START
    robot.change(spec)
    return spec


CARDS: dict[str, AntMaze] = {AntMaze.name: AntMaze()}


# -- the centre line: straight through cells, round corners about those of the wall in the middle ------------------------------------

_BEND = CELL / 2
"""Radius [m] of the centre line's bends."""
_QUARTER = np.pi / 2 * _BEND
_STRAIGHTS = (-START[0], CELL, OUT_EAST)
"""Lengths [m] of the centre line's straight parts, the last to the outer face of the opening."""
LENGTH = sum(_STRAIGHTS) + 2 * _QUARTER
"""Of the centre line [m], from the first cell's centre to outside."""


def distance(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Arc length [m] of the centre line from the first cell's centre to the point of it that is nearest to (x, y) [m], arrays alike."""
    first, second, _ = _STRAIGHTS
    eastwards, westwards = first + x, first + second + 2 * _QUARTER - x
    turn = first + _BEND * np.arctan2(x, y - _BEND)
    southwards = first + _QUARTER + _BEND - y
    again = first + _QUARTER + second + _BEND * np.arctan2(-(y + _BEND), x)
    east = np.where(y > _BEND, turn, np.where(y >= -_BEND, southwards, again))
    return np.where(x < 0, np.where(y > 0, eastwards, westwards), east)


def centre_line(along: float) -> np.ndarray:
    """Point (2,) [m] of the centre line at an arc length [m] from the first cell's centre."""
    first, second, _ = _STRAIGHTS
    parts = (
        (first, lambda s: (s - first, CELL)),
        (_QUARTER, lambda s: (_BEND * np.sin(s / _BEND), _BEND + _BEND * np.cos(s / _BEND))),
        (second, lambda s: (_BEND, _BEND - s)),
        (_QUARTER, lambda s: (_BEND * np.cos(s / _BEND), -_BEND - _BEND * np.sin(s / _BEND))),
        (np.inf, lambda s: (-s, -CELL)),
    )
    for length, at in parts:
        if along < length:
            return np.array(at(along))
        along -= length
    raise AssertionError("the last part has no end")


class AntInMaze:
    """The scene. Its root joint is the model's first; everything is read from positions and speeds, which are of now after mj_step.

    Args:
        model, data: compiled from AntMaze.spec, or a robot in between.
        along: AntMaze's.
    """

    yaw = START_YAW

    def __init__(self, model: mujoco.MjModel, data: mujoco.MjData, along: float = 0.0) -> None:
        self._model, self._data, self._along = model, data, along
        self._qpos, self._qvel = data.qpos, data.qvel  # views: a property of mjData costs as much as a short function

    def begin(self, rng: np.random.Generator) -> None:
        """Place the ant in the first cell, as Ant-v5 does at the origin, shifted and turned besides."""
        qpos, qvel = self._qpos, self._qvel
        qpos += rng.uniform(-RESET_NOISE, RESET_NOISE, qpos.size)
        qvel += RESET_NOISE * rng.standard_normal(qvel.size)
        qpos[:2] = np.array(START) + rng.uniform(-START_SHIFT, START_SHIFT, 2)
        if rng.random() < self._along:
            qpos[:2] = centre_line(rng.uniform(0.0, LENGTH - CELL / 2)) + rng.uniform(-ALONG, ALONG, 2)
        yaw, turned = rng.uniform(-self.yaw, self.yaw), np.empty(4)
        mujoco.mju_mulQuat(turned, np.array([np.cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2)]), qpos[3:7])
        qpos[3:7] = turned / np.linalg.norm(turned)
        mujoco.mj_forward(self._model, self._data)

    def observe(self) -> np.ndarray:
        """The observation record as a vector (29,)."""
        qpos = self._qpos
        return np.concatenate([qpos[2:], self._qvel, qpos[:2] / CELL])

    @property
    def place(self) -> tuple[float, float]:
        """x and y of the torso [m]."""
        return float(self._qpos[0]), float(self._qpos[1])

    def at_goal(self) -> bool:
        """Whether the torso is beyond the outer face of the west wall, where that is open."""
        x, y = self.place
        return x < -OUT_EAST and abs(y + CELL) < CELL / 2

    def lost(self) -> bool:
        """Whether the ant lies on its back, or got over a wall."""
        x, y = self.place
        return self.on_its_back() or ((abs(x) > OUT_EAST or abs(y) > OUT_NORTH) and not self.at_goal())

    def on_its_back(self) -> bool:
        """Whether the torso's upper side points below the horizon."""
        _, i, j, _ = self._qpos[3:7].tolist()
        return i * i + j * j > 0.5


class AntOnFloor(AntInMaze):
    """The scene without walls, where the place is neither seen nor judged."""

    yaw = FLOOR_YAW

    def observe(self) -> np.ndarray:
        """The observation record, its place 0."""
        out = super().observe()
        out[-2:] = 0.0
        return out

    def at_goal(self) -> bool:
        """Never."""
        return False

    def lost(self) -> bool:
        """Whether the ant lies on its back."""
        return self.on_its_back()

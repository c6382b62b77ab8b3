"""An ant finds its way out of a maze (tasks/maze.py): the paper's second experiment."""

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import mujoco
import numpy as np

from robots.ant import ANTS, gymnasium_ant
from robots.model_robot import ModelRobot
from tasks.maze import CELL, OUT_EAST, OUT_NORTH, START, WALL_HEIGHT, WALLS, Way, WayEast, WayOut
from tasks.record import Entry, Record
from tasks.task import PractisedTask

if TYPE_CHECKING:
    import gymnasium

START_SHIFT = 0.1
"""Half width of the uniform noise on where the ant starts [m]: its legs are straight there, and those of the longest and widest one reach
the walls if they stand further aside."""
RESET_NOISE = 0.1
"""Half width of the uniform noise on every number of the start's configuration, and standard deviation of its speeds, as in Ant-v5: it
turns the ant by 0.2 rad at most."""
LOOK_AHEAD = 1.2
"""The way's direction is that to its point so far ahead [m]: whoever keeps to it comes back to the centre line, and turns into bends."""
SCATTERED, BESIDE, TURNED = 0.75, 0.5, 3.1
"""Where an ant starts to learn: share of the episodes that begin anywhere along the way, half width of the uniform noise about its centre
line [m], and of the yaw from its direction [rad]."""
FLOOR_YAW = 0.9
"""Half width [rad] of the uniform yaw from which an ant learns to run on the floor: as much as a bend leaves it with, if it does not turn
until halfway."""
FACING = 0.4
"""How much way [m] it is worth to an ant that learns to turn to where it goes from having its back to it. What is lost by turning away is
what is won by turning back, so that it leads nowhere but along the way (Ng, Harada and Russell, "Policy Invariance under Reward
Transformations", ICML 1999). Five times as much hid what a step gained behind the torso's swaying."""

_JOINTS = [f"{joint}_{leg}" for leg in range(1, 5) for joint in ("hip", "ankle")]
# Thicker legs and wider mounts shift the angles and the height at which an ant trots, and where it believes to be decides where it turns.
OBSERVATION = Record({
    "height": Entry(1, "m", "world", "of the torso", scale=0.2, explored=0.03),
    "orientation": Entry(4, "1", "way", "of the torso, quaternion, w first and not negative", scale=0.4),
    **{name: Entry(1, "rad", "joint", "angle", scale=0.5, explored=0.05) for name in _JOINTS},
    "velocity": Entry(3, "m/s", "way", "of the torso", scale=2.0, explored=0.3),
    "angular_velocity": Entry(3, "rad/s", "torso", "of the torso", scale=2.0),
    **{f"{name}_speed": Entry(1, "rad/s", "joint", "speed", scale=5.0) for name in _JOINTS},
    "aside": Entry(1, "cells", "way", "place of the torso to the left of the centre line", scale=0.2, explored=0.1),
    "left": Entry(1, "cells", "way", "of the way, to the opening", scale=1.0),
})
"""The observation record: Ant-v5's without contact forces, and where the ant is, in the frame of the way: its x leads to a point of the
centre line ahead, its z up. Turned so, the same run is good in every corridor."""
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
        scattered_starts: share of episodes that start anywhere along the way, and turned, to learn from; 0: the task itself.
        integrator: of the physics; ant.xml's own, or Euler's, which is a third of the work, to learn from.
    """

    horizon: int = 200
    scattered_starts: float = 0.0
    integrator: mujoco.mjtIntegrator = mujoco.mjtIntegrator.mjINT_RK4

    name = "ant-maze"
    observation = OBSERVATION
    action = ACTION
    family = ANTS.name
    control_frequency = 20.0
    substeps = 5
    hold_steps = 1

    def spec(self, robot: ModelRobot) -> mujoco.MjSpec:
        """The ant at its start in the maze."""
        spec = self._open(robot)
        for name, (west, east, south, north) in WALLS.items():
            spec.worldbody.add_geom(
                name=name, type=mujoco.mjtGeom.mjGEOM_BOX, conaffinity=1, rgba=[0.55, 0.6, 0.65, 1.0],
                pos=[(west + east) / 2, (south + north) / 2, WALL_HEIGHT / 2],
                size=[(east - west) / 2, (north - south) / 2, WALL_HEIGHT / 2],
            )
        return spec

    def _open(self, robot: ModelRobot) -> mujoco.MjSpec:
        """Without walls."""
        spec = gymnasium_ant()
        spec.option.integrator = self.integrator
        spec.body("torso").pos[:2] = START
        robot.change(spec)
        return spec

    def scene(self, model: mujoco.MjModel, data: mujoco.MjData) -> "AntInMaze":
        """The ant in the maze."""
        return AntInMaze(model, data, self.scattered_starts)

    def miss(self, observation: np.ndarray) -> float:
        """Way to the opening that is left [m]."""
        return CELL * float(observation[-1])

    def practice(self) -> "AntFloor":
        """To run, where nothing is in the way."""
        return AntFloor(integrator=mujoco.mjtIntegrator.mjINT_EULER)

    def scattered(self) -> "AntMaze":
        """Most episodes start anywhere along the way."""
        return replace(self, scattered_starts=SCATTERED, integrator=mujoco.mjtIntegrator.mjINT_EULER)

    def gains(self, observations: np.ndarray) -> np.ndarray:
        """Progress along the way (T,) [m], and what turning to it is worth."""
        w, x, y, z = observations[:, 1:5].T
        ahead = np.cos(np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)))
        return np.diff(0.5 * FACING * ahead - CELL * observations[:, -1])

    def environment(self, robot: ModelRobot) -> "gymnasium.Env":
        """The same scene, stepped by gymnasium's AntEnv."""
        from tasks.ant_maze_env import AntMazeEnv

        return AntMazeEnv(self, robot)


@dataclass(frozen=True)
class AntFloor(AntMaze):
    """Run east on an open floor, turned however. Nothing ends it but a fall."""

    horizon: int = 100

    def spec(self, robot: ModelRobot) -> mujoco.MjSpec:
        """The ant, and no wall."""
        return self._open(robot)

    def scene(self, model: mujoco.MjModel, data: mujoco.MjData) -> "AntOnFloor":
        """The ant on the floor."""
        return AntOnFloor(model, data, scattered=1.0)


CARDS: dict[str, AntMaze] = {AntMaze.name: AntMaze()}


class AntInMaze:
    """The scene. Its root joint is the model's first; everything is read from positions and speeds, which are of now after mj_step.

    Args:
        model, data: compiled from AntMaze.spec, or a robot in between.
        scattered: share of episodes that start anywhere along the way.
    """

    way: Way = WayOut()
    turned = TURNED

    def __init__(self, model: mujoco.MjModel, data: mujoco.MjData, scattered: float = 0.0) -> None:
        self._model, self._data, self._scattered = model, data, scattered
        self._qpos, self._qvel = data.qpos, data.qvel  # views: a property of mjData costs as much as a short function

    def begin(self, rng: np.random.Generator) -> None:
        """Place the ant in the first cell, as Ant-v5 does at the origin, shifted and turned besides."""
        qpos, qvel = self._qpos, self._qvel
        qpos += rng.uniform(-RESET_NOISE, RESET_NOISE, qpos.size)
        qvel += RESET_NOISE * rng.standard_normal(qvel.size)
        qpos[:2] = np.array(START) + rng.uniform(-START_SHIFT, START_SHIFT, 2)
        yaw = 0.0
        if rng.random() < self._scattered:
            along = rng.uniform(0.0, self.way.length - CELL / 2)
            qpos[:2] = self.way.point(along) + rng.uniform(-BESIDE, BESIDE, 2)
            yaw = self.way.direction(along) + rng.uniform(-self.turned, self.turned)
        qpos[3:7] = _about_z(yaw, qpos[3:7] / np.linalg.norm(qpos[3:7]))
        mujoco.mj_forward(self._model, self._data)

    def observe(self) -> np.ndarray:
        """The observation record as a vector (29,)."""
        x, y, height, *orientation = self._qpos[:7].tolist()
        along, aside = self.way.coordinates(x, y)
        ahead_x, ahead_y = self.way.point(along + LOOK_AHEAD)
        heading = math.atan2(ahead_y - y, ahead_x - x)
        c, s = math.cos(heading), math.sin(heading)
        out = np.empty(OBSERVATION.size)
        out[0], out[1:5], out[5:13] = height, _about_z(-heading, orientation), self._qpos[7:]
        out[13:27] = self._qvel
        out[13], out[14] = c * out[13] + s * out[14], c * out[14] - s * out[13]
        out[27], out[28] = aside / CELL, (self.way.length - along) / CELL
        return out

    def at_goal(self) -> bool:
        """Whether the torso is beyond the outer face of the west wall, where that is open."""
        x, y = self._qpos[:2].tolist()
        return x < -OUT_EAST and abs(y + CELL) < CELL / 2

    def lost(self) -> bool:
        """Whether the ant lies on its back, or got over a wall."""
        x, y = self._qpos[:2].tolist()
        return self.on_its_back() or ((abs(x) > OUT_EAST or abs(y) > OUT_NORTH) and not self.at_goal())

    def on_its_back(self) -> bool:
        """Whether the torso's upper side points below the horizon."""
        i, j = self._qpos[4:6].tolist()
        return i * i + j * j > 0.5


class AntOnFloor(AntInMaze):
    """The scene without walls."""

    way = WayEast()
    turned = FLOOR_YAW

    def at_goal(self) -> bool:
        """Never."""
        return False

    def lost(self) -> bool:
        """Whether the ant lies on its back."""
        return self.on_its_back()


def _about_z(angle: float, quaternion: "np.ndarray | list[float]") -> tuple[float, float, float, float]:
    """A rotation, turned about z by an angle [rad] besides: quaternion (4,), w first and not negative."""
    c, s = math.cos(angle / 2), math.sin(angle / 2)
    w, x, y, z = quaternion
    w, x, y, z = c * w - s * z, c * x - s * y, c * y + s * x, c * z + s * w
    return (w, x, y, z) if w >= 0.0 else (-w, -x, -y, -z)

"""The unmodified robosuite robot in its task as a Gymnasium environment, with the named observation and action records."""

from typing import Any

import gymnasium
import mujoco
import numpy as np

from robots.robot import Robot
from tasks.pick import PickTask
from toolkit.errors import ToolkitError
from toolkit.simulation.native import NativeRobot

CAMERA, PICTURE = "frontview", (480, 640)
"""robosuite's camera of the table, and height and width [pixels] of a picture of it."""


class NativeEnv(gymnasium.Env[np.ndarray, np.ndarray]):
    """An unmodified robosuite robot in its task.

    Observations (n_obs,) and actions (n_act,), in [-1, 1], are those of ``task.observation`` and ``task.action``, as policies of the
    toolkit take and give them; ``named`` tells the entries apart. The reward is 1 on the step on which the task succeeds, which ends the
    episode, and 0 on every other. An object off the table and a simulation that blew up end it, too; the task's horizon truncates it.
    ``reset(seed=s)`` is the start that every episode of the toolkit has from seed s.

    Args:
        robot, task: who does what.
        render_mode: "rgb_array", for pictures (480, 640, 3) uint8 off screen, or None.
    """

    def __init__(self, robot: Robot, task: PickTask, render_mode: str | None = None) -> None:
        if render_mode not in (None, "rgb_array"):
            raise ToolkitError(f"render_mode is {render_mode!r}; give 'rgb_array' or None")
        self.robot, self.task, self.render_mode = NativeRobot(robot, task), task, render_mode
        self.metadata = {"render_modes": ["rgb_array"], "render_fps": round(task.control_frequency)}
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (sum(task.observation.values()),), np.float64)
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (sum(task.action.values()),), np.float64)
        self._renderer: mujoco.Renderer | None = None
        self._steps = 0

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict[str, Any]]:
        """Begin an episode; returns the observation, and an info with the ``seed`` of its start.

        Args:
            seed: of the start; None: the next of the environment's own generator.
            options: there are none.
        """
        super().reset(seed=seed)
        start = int(self.np_random.integers(2**31)) if seed is None else seed
        self._steps = 0
        return self.robot.begin(start), {"seed": start}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """One policy step; the info says whether the task has ``success``, the object is ``lost``, the simulation ``diverged``."""
        observation = np.nan_to_num(self.robot.step(np.asarray(action, float)), nan=0.0, posinf=0.0, neginf=0.0)
        self._steps += 1
        diverged, lost = bool(self.robot.diverged), bool(self.robot.env.lost)
        success = bool(self.robot.env.succeeded) and not diverged
        told = {"success": success, "lost": lost, "diverged": diverged}
        return observation, float(success), success or lost or diverged, self._steps >= self.task.horizon, told

    def named(self, observation: np.ndarray) -> dict[str, np.ndarray]:
        """The entries (size,) of an observation (n_obs,) by name, in the task's units; views."""
        ends = np.cumsum(list(self.task.observation.values()))[:-1]
        return dict(zip(self.task.observation, np.split(observation, ends), strict=True))

    def render(self) -> np.ndarray | None:
        """A picture of the scene as it stands, where ``render_mode`` asks for it."""
        if self.render_mode is None:
            return None
        if self._renderer is None:
            self._renderer = mujoco.Renderer(self.robot.model, *PICTURE)
        self._renderer.update_scene(self.robot.data, camera=CAMERA)
        return self._renderer.render()

    def close(self) -> None:
        """Free the simulation and its pictures."""
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None
        self.robot.env.close()

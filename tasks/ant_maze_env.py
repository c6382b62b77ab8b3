"""The ant's maze as a gymnasium environment: AntEnv's own step on the scene, played by any robot of the family, unmodified."""

from typing import Any

import mujoco
import numpy as np
from gymnasium.envs.mujoco.ant_v5 import AntEnv

from robots.model_robot import ModelRobot
from tasks.task import ModelTask


class AntMazeEnv(AntEnv):
    """An ant in its maze; ``step`` is AntEnv's, reward 1 for leaving the maze, else 0.

    Args:
        task: the maze.
        robot: who plays.
        options: any further argument of AntEnv.

    Attributes:
        scene: where the ant is (tasks/task.py, Scene).
    """

    def __init__(self, task: ModelTask, robot: ModelRobot, **options: Any) -> None:
        self.task, self.robot = task, robot
        super().__init__(
            frame_skip=task.substeps,
            exclude_current_positions_from_observation=False,  # the place is observed, in other units
            include_cfrc_ext_in_observation=False,
            **options,
        )

    def _initialize_simulation(self) -> tuple[mujoco.MjModel, mujoco.MjData]:
        model = self.task.spec(self.robot).compile()
        model.vis.global_.offwidth = max(model.vis.global_.offwidth, self.width)
        model.vis.global_.offheight = max(model.vis.global_.offheight, self.height)
        data = mujoco.MjData(model)
        self.scene = self.task.scene(model, data)
        return model, data

    def reset_model(self) -> np.ndarray:
        """Place the ant; returns the observation (29,)."""
        self.scene.begin(self.np_random)
        return self.scene.observe()

    def _get_obs(self) -> np.ndarray:
        return self.scene.observe()

    @property
    def is_healthy(self) -> bool:
        """Whether the episode goes on: the state is finite, and the ant neither lost nor outside."""
        return bool(np.isfinite(self.state_vector()).all()) and not self.scene.lost() and not self.scene.at_goal()

    def _get_rew(self, x_velocity: float, action: np.ndarray) -> tuple[float, dict[str, float]]:
        return float(self.scene.at_goal()), {}

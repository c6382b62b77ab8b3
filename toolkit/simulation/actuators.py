"""Robots driven through their own actuators: an action in [-1, 1] spans each actuator's control range, whatever it makes of its control.

That is how gymnasium's environments drive ADROIT (position actuators) and Ant (motors): control = middle + half range * clip(action).
"""

from collections.abc import Callable
from typing import Any

import mujoco
import numpy as np

from robots.model_robot import ModelRobot
from tasks.task import ModelTask
from toolkit.errors import ToolkitError
from toolkit.morphology.family import MergedModel
from toolkit.simulation.osc import STATE
from toolkit.simulation.plant import blew_up
from toolkit.simulation.watching import Watcher


class ModelPlant:
    """A robot of a family in its task, ready to be reset and stepped.

    Args:
        model, data: the compiled scene.
        task: the task.

    Attributes:
        before: (n_state,) STATE before the last policy step.
        substeps: of physics per policy step.
        command: (0,), as no closing command is integrated; goal: (3,) zeros, as the scene holds its goal.
    """

    def __init__(self, model: mujoco.MjModel, data: mujoco.MjData, task: ModelTask) -> None:
        if not model.actuator_ctrllimited.all():
            free = model.actuator(int(np.flatnonzero(model.actuator_ctrllimited == 0)[0])).name
            raise ToolkitError(f"actuator {free!r} has no control range, so an action in [-1, 1] says nothing to it; give it a ctrlrange")
        self.model, self.data, self.task = model, data, task
        self.scene = task.scene(model, data)
        self.substeps = task.substeps
        self.command, self.goal = np.zeros(0), np.zeros(3)
        self.before = np.empty(mujoco.mj_stateSize(model, STATE))
        low, high = model.actuator_ctrlrange.T
        self._middle, self._half = 0.5 * (low + high), 0.5 * (high - low)

    def begin(self, seed: int) -> np.ndarray:
        """Reset to the start that the seed determines; returns the observation (n_obs,)."""
        mujoco.mj_resetData(self.model, self.data)
        self.scene.begin(np.random.default_rng(seed))
        return self.observe()

    def step(self, action: np.ndarray) -> np.ndarray:
        """Play one policy action (n_act,); returns the next observation (n_obs,)."""
        self.play_substeps(action, self.substeps, sets_goal=True)
        mujoco.mj_rnePostConstraint(self.model, self.data)  # contact forces, as gymnasium computes them
        return self.observe()

    def set_command(self, action: np.ndarray) -> None:
        """Nothing is integrated."""

    def play_substeps(self, action: np.ndarray, count: int, sets_goal: bool) -> None:
        """``count`` steps of physics under an action (n_act,), the first of a policy step or not."""
        if sets_goal:
            mujoco.mj_getState(self.model, self.data, self.before, STATE)
            self.data.ctrl[:] = self._middle + self._half * np.clip(action, -1.0, 1.0)
        mujoco.mj_step(self.model, self.data, count)

    def observe(self) -> np.ndarray:
        """The observation (n_obs,)."""
        return self.scene.observe()

    @property
    def at_goal(self) -> bool:
        """Whether the goal is met now."""
        return self.scene.at_goal()

    @property
    def lost(self) -> bool:
        """Whether success has become impossible."""
        return self.scene.lost()

    @property
    def torque_share(self) -> float:
        """Largest share of its limit that an actuator's force takes now; NaN if one is no number, 0 where there are no limits."""
        limits = self.model.actuator_forcerange[:, 1]
        shares = np.abs(self.data.actuator_force) / np.where(self.model.actuator_forcelimited, limits, np.inf)
        return float(np.max(shares, initial=0.0))

    @property
    def diverged(self) -> bool:
        """Whether MuJoCo warned of a bad state, or a joint moves impossibly fast."""
        return blew_up(self.data)


def merged_model_plant(merged: MergedModel, alpha: np.ndarray, model: mujoco.MjModel, data: mujoco.MjData) -> ModelPlant:
    """F(alpha) as a plant; patches ``model`` in place (see MergedModel.become)."""
    merged.become(alpha, model, data)
    return ModelPlant(model, data, merged.task)


def native_model_plant(robot: ModelRobot, task: ModelTask) -> ModelPlant:
    """The unmodified robot as a plant for the fast engine."""
    model = task.spec(robot).compile()
    return ModelPlant(model, mujoco.MjData(model), task)


class GymnasiumRobot:
    """The unmodified robot in its own gymnasium environment: what a policy's success is claimed on.

    The start of a seed is the engine's, written into the environment's own model and data; every step is the environment's.

    Args:
        robot: which.
        task: what it does.

    Attributes:
        diverged: whether the simulation of the episode last played blew up; such an episode has failed.
    """

    def __init__(self, robot: ModelRobot, task: ModelTask) -> None:
        self.robot, self.task, self.diverged = robot, task, False
        self.env: Any = task.environment(robot)
        self.env.reset(seed=0)
        self.model: mujoco.MjModel = self.env.unwrapped.model
        self.data: mujoco.MjData = self.env.unwrapped.data
        self.scene = task.scene(self.model, self.data)

    def begin(self, seed: int) -> np.ndarray:
        """Reset to the start of a seed; returns the observation (n_obs,)."""
        self.diverged = False
        self.env.reset(seed=0)
        mujoco.mj_resetData(self.model, self.data)
        self.scene.begin(np.random.default_rng(seed))
        return self.scene.observe()

    def play(
        self, act: Callable[[np.ndarray], np.ndarray], seed: int, watcher: Watcher | None = None, native: bool = False
    ) -> bool:
        """One episode with a deterministic policy; returns whether the task succeeded.

        Args:
            act: observation (n_obs,) -> action (n_act,).
            seed: of the start.
            watcher: told of every step.
            native: there is no other action than the environment's own.
        """
        observation, judge, told = self.begin(seed), self.task.judge(), watcher or Watcher()
        succeeded = False
        told.begun(self)
        for _ in range(self.task.horizon):
            action = np.asarray(act(observation))
            if not np.isfinite(action).all():
                self.diverged = True
                break
            told.acting(self, action)
            _, _, terminated, truncated, _ = self.env.step(action)
            told.acted(self)
            observation = self.scene.observe()
            self.diverged = blew_up(self.data) or not np.isfinite(observation).all()
            if self.diverged:
                break
            succeeded = judge.tell(self.scene.at_goal())
            if succeeded or self.scene.lost() or terminated or truncated:
                break
        told.ended(self, self.diverged)
        return succeeded and not self.diverged

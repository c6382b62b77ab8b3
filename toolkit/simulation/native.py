"""The unmodified robosuite robot in its own environment, behind the named records: what a policy's success is claimed on."""

from collections.abc import Callable

import mujoco
import numpy as np

from grippers.gripper import COMMANDED_ROLES
from robots.robot import Robot
from tasks.env import Pick
from tasks.pick import START_POSITION, START_ROTATION, PickTask, observe
from toolkit.morphology.native_scene import NativeScene, role_actuators
from toolkit.morphology.posture import native_env
from toolkit.simulation.osc import silence_warnings
from toolkit.simulation.plant import CLOSING, blew_up, command_law, finger_map
from toolkit.simulation.watching import Watcher


class NativeRobot:
    """An unmodified robosuite robot in its own environment, with the named observation and action records around it.

    Args:
        robot: which.
        task: what it does.

    Attributes:
        diverged: whether the simulation of the episode last played blew up; such an episode has failed.
    """

    def __init__(self, robot: Robot, task: PickTask) -> None:
        silence_warnings()
        self.robot, self.task = robot, task
        self.env: Pick = native_env(robot, task)
        self.env.begin(0)
        self.diverged = False
        self.model: mujoco.MjModel = self.env.sim.model._model
        self.data: mujoco.MjData = self.env.sim.data._data
        self.law = command_law(robot)
        mujoco.mj_forward(self.model, self.data)
        self._fingers = finger_map(robot, self.model, self.data)
        self.command = np.full(len(COMMANDED_ROLES), self.law.preshape)
        self._site = NativeScene(self.model).grip_site
        actuators = role_actuators(self.model, robot)
        driven = [actuators[role] for role in robot.gripper.targets]
        own = [int(a) for a in self.env.robots[0]._ref_joint_gripper_actuator_indexes["right"]]
        self._order = [driven.index(a) for a in own]
        low, high = self.model.actuator_ctrlrange[own].T
        self._middle, self._half = 0.5 * (high + low), 0.5 * (high - low)

    def begin(self, seed: int) -> np.ndarray:
        """Reset to the start of a seed; returns the observation (n_obs,)."""
        self.env.begin(seed)
        self.diverged = False
        self.command = np.full(len(COMMANDED_ROLES), self.law.preshape)
        return self.observe()

    def robosuite_action(self, action: np.ndarray) -> np.ndarray:
        """robosuite's own action for an action of the record (n_act,): 6 OSC deltas, then the gripper's entries.

        A gripper takes the mean closing action and integrates its sign; a hand takes its position targets.
        """
        if self.robot.gripper.rate is not None:
            return np.append(np.clip(action[:6], -1, 1), np.clip(action[6:][CLOSING].mean(), -1, 1))
        targets = self.law.targets(self.law.advance(self.command, action[6:]))[self._order]
        return np.concatenate([np.clip(action[:6], -1, 1), (targets - self._middle) / self._half])

    def step(self, action: np.ndarray) -> np.ndarray:
        """One robosuite step with an action of the record (n_act,); returns the next observation (n_obs,)."""
        native = self.robosuite_action(action)
        if self.robot.gripper.rate is None:
            self.command = self.law.advance(self.command, action[6:])
        return self.apply(native)

    def apply(self, native: np.ndarray) -> np.ndarray:
        """One robosuite step with robosuite's own action; returns the next observation (n_obs,)."""
        self.env.step(native)
        if self.robot.gripper.rate is not None:  # what robosuite's gripper has integrated
            self.command = np.clip(self.command + self.law.rate * np.sign(native[6]), -1.0, 1.0)
        observation = self.observe()
        self.diverged = self.diverged or blew_up(self.data) or not np.isfinite(observation).all()
        return observation

    def observe(self) -> np.ndarray:
        """The observation record (n_obs,), from robosuite's simulation."""
        data = self.data
        fingers = np.array([sign * (data.qpos[q] - start) if q >= 0 else 0.0 for q, sign, start in self._fingers])
        return observe(
            fingers, self.law.progress(self.command), data.site_xpos[self._site], data.site_xmat[self._site].reshape(3, 3),
            self.env.object_position, self.env.object_rotation, self.env.goal, START_POSITION, START_ROTATION,
        )

    def play(
        self, act: Callable[[np.ndarray], np.ndarray], seed: int, watcher: Watcher | None = None, native: bool = False
    ) -> bool:
        """One episode with a deterministic policy; returns whether the task succeeded.

        Args:
            act: observation (n_obs,) -> action of the record (n_act,), or robosuite's own action if ``native``.
            seed: of the start.
            watcher: told of every step.
            native: see ``act``.
        """
        step, told = self.apply if native else self.step, watcher or Watcher()
        observation = self.begin(seed)
        told.begun(self)
        for _ in range(self.task.horizon):
            action = np.asarray(act(observation))
            if not np.isfinite(action).all():  # robosuite would hand it to its controller, which cannot solve with it
                self.diverged = True
                break
            told.acting(self, action)
            observation = step(action)
            told.acted(self)
            if self.diverged or self.env.succeeded or self.env.lost:
                break
        told.ended(self, self.diverged)
        return bool(self.env.succeeded) and not self.diverged

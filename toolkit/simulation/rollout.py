"""Rollouts: a policy plays a task on many robots F(alpha), on all cores, the same whatever the number of threads."""

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from queue import SimpleQueue

import mujoco
import numpy as np

from robots.robot import Robot
from tasks.pick import PickTask, at_goal, is_lost
from toolkit.learning.episode import Episode
from toolkit.morphology.build import MergedRobot
from toolkit.simulation.plant import Plant, merged_plant, native_plant

Actor = Callable[[np.ndarray, np.random.Generator], np.ndarray]
"""(observation (n_obs,), rng) -> action (n_act,)."""


@dataclass
class Trace:
    """What an episode looked like, for the viewer: the model as it was, and qpos (T + 1, nq) at every policy step."""

    model: mujoco.MjModel
    qpos: np.ndarray
    goal: np.ndarray
    success: bool


def play(plant: Plant, actor: Actor, seed: int, alpha: np.ndarray, trace: list[np.ndarray] | None = None) -> Episode:
    """One episode.

    The seed fixes the start (object pose, goal) and the actor's noise. It ends with success (the object held at the goal
    for the task's hold_steps; reward 1 on that step, 0 on every other), with the object off the table, with a diverged
    simulation (a failure, never rewarded), or at the horizon.

    Args:
        plant: the robot.
        actor: the policy.
        seed: non-negative.
        alpha: (D,) recorded with the episode.
        trace: if given, qpos (nq,) is appended before every step and at the end.
    """
    task = plant.task
    rng = np.random.default_rng((seed, 1))
    observation = plant.begin(seed)
    observations, actions, rewards = [], [], []
    held, success, terminated, diverged = 0, False, False, False
    while len(rewards) < task.horizon and not terminated:
        action = actor(observation, rng)
        observations.append(observation)
        actions.append(action)
        if trace is not None:
            trace.append(np.array(plant.data.qpos))
        observation = plant.step(action)
        diverged = plant.diverged or not (np.isfinite(action).all() and np.isfinite(observation).all())
        held = held + 1 if not diverged and at_goal(plant.object_position, plant.goal, task.goal_tolerance) else 0
        success = held >= task.hold_steps
        terminated = success or diverged or is_lost(plant.object_position)
        rewards.append(float(success))
    if trace is not None:
        trace.append(np.array(plant.data.qpos))
    if diverged:
        observation = np.nan_to_num(observation, nan=0.0, posinf=0.0, neginf=0.0)
    return Episode(
        observations=np.array(observations), actions=np.array(actions), rewards=np.array(rewards), success=success,
        diverged=diverged, terminated=terminated, last_observation=observation, alpha=alpha, seed=seed,
    )  # fmt: skip


class _Engine:
    """Plays batches of episodes with workers that each borrow what they need from ``_idle``.

    Attributes:
        threads: workers.
        episodes_played: since the start.
    """

    def __init__(self, threads: int | None) -> None:
        self.threads = threads or len(os.sched_getaffinity(0))
        self._pool = ThreadPoolExecutor(self.threads)
        self._idle: SimpleQueue = SimpleQueue()
        self.episodes_played = 0

    def _one(self, actor: Actor, alpha: np.ndarray, seed: int) -> Episode:
        raise NotImplementedError

    def play(self, actor: Actor, alphas: Sequence[np.ndarray], seeds: Sequence[int]) -> list[Episode]:
        """One episode per (alpha (D,), seed), in order."""
        episodes = list(self._pool.map(lambda pair: self._one(actor, *pair), zip(alphas, seeds, strict=True)))
        self.episodes_played += len(episodes)
        return episodes

    def close(self) -> None:
        """Stop the workers."""
        self._pool.shutdown()


class RolloutEngine(_Engine):
    """Plays batches of episodes on a merged robot.

    Every episode runs whole on one thread, from its own seed and on its own copy of the model, so results do not depend
    on the number of threads.

    Args:
        merged: the merged robot in its task.
        threads: workers; default: the machine's cores.
    """

    def __init__(self, merged: MergedRobot, threads: int | None = None) -> None:
        super().__init__(threads)
        self.merged = merged
        for _ in range(self.threads):
            self._idle.put(merged.new())

    def _one(self, actor: Actor, alpha: np.ndarray, seed: int) -> Episode:
        model, data = self._idle.get()
        try:
            return play(merged_plant(self.merged, alpha, model, data), actor, seed, alpha)
        finally:
            self._idle.put((model, data))

    def trace(self, actor: Actor, alpha: np.ndarray, seed: int) -> Trace:
        """One episode with what the viewer needs, on a model of its own; not counted."""
        model, data = self.merged.new()
        plant = merged_plant(self.merged, alpha, model, data)
        qpos: list[np.ndarray] = []
        episode = play(plant, actor, seed, alpha, qpos)
        return Trace(model, np.array(qpos), plant.goal, episode.success)


class NativeEngine(_Engine):
    """Plays episodes on an unmodified robosuite robot with the compiled control step (not robosuite's own step).

    Its robot is the only one it has: the alphas of ``play`` are recorded, nothing more.
    """

    def __init__(self, robot: Robot, task: PickTask, threads: int | None = None) -> None:
        super().__init__(threads)
        for _ in range(self.threads):
            self._idle.put(native_plant(robot, task))

    def _one(self, actor: Actor, alpha: np.ndarray, seed: int) -> Episode:
        plant = self._idle.get()
        try:
            return play(plant, actor, seed, alpha)
        finally:
            self._idle.put(plant)

"""Rollouts: a policy plays a task on many robots F(alpha), on all cores, the same whatever the number of threads."""

import os
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from queue import SimpleQueue
from threading import Event
from typing import Any

import mujoco
import numpy as np

from robots.model_robot import ModelRobot
from robots.robot import Robot
from tasks.pick import PickTask
from tasks.task import ModelTask, Task
from toolkit.errors import ToolkitError
from toolkit.learning.episode import Episode
from toolkit.morphology.build import MergedRobot
from toolkit.morphology.family import MergedModel
from toolkit.simulation.divergence import Divergence
from toolkit.simulation.laws import Drivable, merged_plant, native_plant
from toolkit.simulation.osc import silence_warnings
from toolkit.simulation.plant import all_finite
from toolkit.simulation.watching import Watcher

Actor = Callable[[np.ndarray, np.random.Generator], np.ndarray]
"""(observation (n_obs,), rng) -> action (n_act,)."""


class LastStep(Watcher):
    """Keeps what a simulation that blew up can be played again from.

    Attributes:
        broken: (state, command) before the policy step that blew up; see Divergence. None: it did not.
    """

    def __init__(self) -> None:
        self.broken: tuple[np.ndarray, np.ndarray] | None = None
        self._command = np.zeros(0)

    def acting(self, plant: Drivable, action: np.ndarray) -> None:
        """See Watcher."""
        self._command = plant.command

    def ended(self, plant: Drivable, diverged: bool) -> None:
        """See Watcher."""
        self.broken = (plant.before.copy(), self._command) if diverged else None


def play(plant: Drivable, actor: Actor, seed: int, alpha: np.ndarray, watcher: Watcher | None = None) -> Episode:
    """One episode.

    The seed fixes the start and the actor's noise. It ends with success (the goal met for the task's hold_steps), where success has become
    impossible, with a diverged simulation (a failure, whose last step is not rewarded), or at the horizon. Rewards are the task's.

    Args:
        plant: the robot.
        actor: the policy.
        seed: non-negative.
        alpha: (D,) recorded with the episode.
        watcher: told of every step.
    """
    played = play_on(plant, actor, np.random.default_rng((seed, 1)), plant.begin(seed), plant.task.horizon, watcher)
    observation = np.nan_to_num(played.observation, nan=0.0, posinf=0.0, neginf=0.0) if played.diverged else played.observation
    return Episode(
        observations=np.array(played.observations), actions=np.array(played.actions), rewards=np.array(played.rewards),
        success=played.success, diverged=played.diverged, terminated=played.terminated, last_observation=observation,
        alpha=alpha, seed=seed,
    )


@dataclass
class Stretch:
    """A part of an episode: where it ended, lists of T observations (n_obs,), actions (n_act,) and rewards, and how it ended."""

    observation: np.ndarray
    observations: list[np.ndarray] = field(default_factory=list)
    actions: list[np.ndarray] = field(default_factory=list)
    rewards: list[float] = field(default_factory=list)
    success: bool = False
    diverged: bool = False
    terminated: bool = False


def play_on(
    plant: Drivable, actor: Actor, rng: np.random.Generator, observation: np.ndarray, steps: int, watcher: Watcher | None = None
) -> Stretch:
    """Play from where the plant stands: at most ``steps`` policy steps, ending as an episode does; see ``play``."""
    judge, told, out = plant.task.judge(), watcher or Watcher(), Stretch(observation)
    told.begun(plant)
    while len(out.rewards) < steps and not out.terminated:
        action = np.asarray(actor(observation, rng), float)
        out.observations.append(observation)
        out.actions.append(action)
        told.acting(plant, action)
        observation = plant.step(action)
        told.acted(plant)
        out.diverged = plant.diverged or not all_finite(action, observation)
        out.success = not out.diverged and judge.tell(plant.at_goal)
        out.terminated = out.success or out.diverged or plant.lost
        left = steps - len(out.rewards) - 1
        out.rewards.append(0.0 if out.diverged else plant.task.reward(plant.data, out.success, left))
    out.observation = observation
    told.ended(plant, out.diverged)
    return out


class Engine:
    """Plays batches of episodes with workers that each borrow what they need.

    MuJoCo's own printed warnings fall silent: a diverged simulation is counted, and the first leaves a dump.

    Attributes:
        task: what is played.
        threads: workers.
        episodes_played: since the start.
        play_seconds: wall time spent playing, since the start [s].
        stopped: set once what it plays is no longer wanted; see ``stop``.
        trouble: why the dump could not be written; empty if it could, or was not needed.
    """

    task: Task

    def __init__(self, threads: int | None, dump: Path | None) -> None:
        silence_warnings()
        self.threads = threads or len(os.sched_getaffinity(0))
        self._dump = dump
        self._pool = ThreadPoolExecutor(self.threads)
        self._idle: SimpleQueue = SimpleQueue()
        self.episodes_played, self.play_seconds = 0, 0.0
        self.stopped, self.trouble = Event(), ""

    def _plant(self, borrowed: Any, alpha: np.ndarray) -> Drivable:
        raise NotImplementedError

    def _scene(self) -> dict[str, Any]:
        """What a dump says of the robot: ``robots``, ``native`` and ``task``."""
        raise NotImplementedError

    def at(self, task: Task) -> "Engine":
        """An engine that plays another task on the same robots."""
        raise NotImplementedError

    def one(self, actor: Actor, alpha: np.ndarray, seed: int) -> tuple[Episode, Divergence | None]:
        """One episode, and how its simulation blew up if it did: a function of what is given, wherever and whenever it is played."""
        borrowed = self._idle.get()
        try:
            plant, last = self._plant(borrowed, alpha), LastStep()
            episode = play(plant, actor, seed, alpha, last)
            return episode, self._divergence(episode, plant, last)
        finally:
            self._idle.put(borrowed)

    def _divergence(self, episode: Episode, plant: Drivable, last: LastStep) -> Divergence | None:
        if last.broken is None:
            return None
        state, command = last.broken
        return Divergence(seed=episode.seed, alpha=episode.alpha, state=state, command=command, goal=plant.goal,
                          actions=episode.actions, **self._scene())

    def play(self, actor: Actor | Sequence[Actor], alphas: Sequence[np.ndarray], seeds: Sequence[int]) -> list[Episode]:
        """One episode per (alpha (D,), seed), in order, of one actor or of one actor each.

        The first episode that diverges is dumped, if the engine has none yet.
        """
        began = time.perf_counter()
        actors = actor if isinstance(actor, Sequence) else [actor] * len(seeds)
        played = list(self._pool.map(lambda job: self._wanted(*job), zip(actors, alphas, seeds, strict=True)))
        self.episodes_played += len(played)
        self.play_seconds += time.perf_counter() - began
        first = next((divergence for _, divergence in played if divergence is not None), None)
        if first is not None and self._dump is not None and not self._dump.exists():
            try:
                first.save(self._dump)
            except OSError as error:  # it only helps to see what happened; the episode is counted all the same
                self.trouble = f"{self._dump} cannot be written ({error.strerror})"
                self._dump = None
        return [episode for episode, _ in played]

    def _wanted(self, actor: Actor, alpha: np.ndarray, seed: int) -> tuple[Episode, Divergence | None]:
        if self.stopped.is_set():
            raise ToolkitError(f"the episode of seed {seed} was not played: its engine was stopped; begin another engine")
        return self.one(actor, alpha, seed)

    def stop(self) -> None:
        """Play no episode any more that has not begun; whoever waits for one gets a ToolkitError."""
        self.stopped.set()

    def close(self) -> None:
        """Stop, and wait for what is being played."""
        self.stop()
        self._pool.shutdown()


def at_task(merged: MergedRobot | MergedModel, task: Task) -> MergedRobot | MergedModel:
    """The same merged robot at another task.

    Raises:
        ToolkitError: a task for other robots.
    """
    if isinstance(merged, MergedRobot) and isinstance(task, PickTask):
        return MergedRobot(merged.space, task)
    if isinstance(merged, MergedModel) and isinstance(task, ModelTask):
        return MergedModel(merged.space, task)
    raise ToolkitError(f"task {task.name!r} is not for the robots that {merged.task.name!r} is for; name one of the same kind")


class RolloutEngine(Engine):
    """Plays batches of episodes on a merged robot.

    Every episode runs whole on one thread, from its own seed and on its own copy of the model, so results do not depend
    on the number of threads.

    Args:
        merged: the merged robot in its task.
        threads: workers; default: the machine's cores.
        dump: file for the first simulation that blows up; one that exists is left alone.
    """

    def __init__(self, merged: MergedRobot | MergedModel, threads: int | None = None, dump: Path | None = None) -> None:
        super().__init__(threads, dump)
        self.merged, self.task = merged, merged.task
        for _ in range(self.threads):
            self._idle.put(merged.new())

    def at(self, task: Task) -> "RolloutEngine":
        """See Engine."""
        return RolloutEngine(at_task(self.merged, task), self.threads)

    def _plant(self, borrowed: tuple[mujoco.MjModel, mujoco.MjData], alpha: np.ndarray) -> Drivable:
        return merged_plant(self.merged, alpha, *borrowed)

    def _scene(self) -> dict[str, Any]:
        return {"robots": self.merged.space.names, "native": False, "task": self.merged.task.name}


class NativeEngine(Engine):
    """Plays episodes on an unmodified robot with the compiled control step (not its environment's own step).

    Its robot is the only one it has: the alphas of ``play`` are recorded, nothing more.

    Args:
        robot, task: who plays what.
        threads: workers; default: the machine's cores.
        dump: as for RolloutEngine.
    """

    def __init__(self, robot: Robot | ModelRobot, task: Task, threads: int | None = None, dump: Path | None = None) -> None:
        super().__init__(threads, dump)
        self.robot, self.task = robot, task
        for _ in range(self.threads):
            self._idle.put(native_plant(robot, task))

    def at(self, task: Task) -> "NativeEngine":
        """See Engine."""
        return NativeEngine(self.robot, task, self.threads)

    def _plant(self, borrowed: Drivable, alpha: np.ndarray) -> Drivable:
        return borrowed

    def _scene(self) -> dict[str, Any]:
        return {"robots": (self.robot.name,), "native": True, "task": self.task.name}

"""Success where it is claimed: on F(beta), and on the unmodified robosuite robot through robosuite's own env.step."""

import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Literal

import numpy as np
from scipy.stats import binomtest

from tasks.task import Task
from toolkit.bundle.reading import Bundle, load_bundle
from toolkit.errors import ToolkitError
from toolkit.learning.policy import GaussianPolicy, MeanActor
from toolkit.morphology.lab import System
from toolkit.morphology.native_scene import model_sha256
from toolkit.quiet import start_worker
from toolkit.runs.seeds import EVALUATION_SEEDS
from toolkit.simulation.cluster import Cluster, ClusterEngine
from toolkit.simulation.laws import Playable, native_robot
from toolkit.simulation.rollout import NativeEngine, RolloutEngine


@dataclass(frozen=True)
class Evaluation:
    """Success of a policy on one robot.

    Attributes:
        target: robot.  env: "native" (robosuite's own robot and step), "native-compiled" (its own robot, the compiled control
            step) or "merged" (F(beta)).
        successes, episodes, diverged: counts.
        seed: of the first episode; the others follow.
    """

    target: str
    env: Literal["native", "native-compiled", "merged"]
    episodes: int
    successes: int
    diverged: int
    seed: int

    @property
    def success_rate(self) -> float:
        """Share of successful episodes."""
        return self.successes / self.episodes

    @property
    def ci95(self) -> tuple[float, float]:
        """95 % Wilson interval of the success rate (Wilson 1927)."""
        interval = binomtest(self.successes, self.episodes).proportion_ci(0.95, method="wilson")
        return float(interval.low), float(interval.high)

    def to_json(self) -> dict:
        """The contract of ``meta-evolve evaluate --json``."""
        return {
            "target": self.target, "env": self.env, "episodes": self.episodes, "successes": self.successes,
            "success_rate": self.success_rate, "ci95": list(self.ci95), "diverged": self.diverged, "seed": self.seed,
        }


def evaluate_merged(policy: GaussianPolicy, engine: RolloutEngine | ClusterEngine, target: str, episodes: int, seed: int = 0) -> Evaluation:
    """Success of the policy's mean action on F(beta) of ``target``, on seeds that training never saw."""
    beta = engine.merged.space.beta(target)
    seeds = [EVALUATION_SEEDS + seed * 10**6 + i for i in range(episodes)]
    played = engine.play(MeanActor(policy), [beta] * episodes, seeds)
    return Evaluation(target, "merged", episodes, sum(e.success for e in played), sum(e.diverged for e in played), seeds[0])


def evaluate_compiled(
    policy: GaussianPolicy, robot: System, task: Task, episodes: int, seed: int = 0, cluster: Cluster | None = None
) -> Evaluation:
    """As ``evaluate_native``, on the same seeds, with the compiled control step in place of robosuite's: some ten times faster."""
    seeds = [EVALUATION_SEEDS + seed * 10**6 + i for i in range(episodes)]
    engine = NativeEngine(robot, task) if cluster is None else cluster.native(robot, task)
    played = engine.play(MeanActor(policy), [np.zeros(1)] * episodes, seeds)
    engine.close()
    successes, diverged = (sum(getattr(e, key) for e in played) for key in ("success", "diverged"))
    return Evaluation(robot.name, "native-compiled", episodes, successes, diverged, seeds[0])


Outcome = tuple[bool, bool]
"""Whether an episode succeeded, and whether its simulation diverged."""


def _player(robot: System, task: Task, policy: GaussianPolicy | Path) -> Callable[[int], Outcome]:
    """Plays the episode of a seed on the unmodified robot, which is loaded once."""
    native = native_robot(robot, task)
    if not isinstance(policy, Path):
        return lambda seed: (native.play(policy.mean, seed), native.diverged)
    bundle = load_bundle(policy)
    _same_model(bundle, native)
    return lambda seed: (native.play(bundle, seed, native=True), native.diverged)


_own_player: Callable[[int], Outcome] | None = None
"""A worker process's, which lives for one evaluation: of one robot, task and policy."""


def _play_in_worker(robot: System, task: Task, policy: GaussianPolicy | Path, seed: int) -> Outcome:
    global _own_player
    if _own_player is None:
        _own_player = _player(robot, task, policy)
    return _own_player(seed)


def _same_model(bundle: Bundle, native: Playable) -> None:
    """Refuse a bundle whose robot is not the one that robosuite has here."""
    wanted, found = bundle.manifest.robot.model_sha256, model_sha256(native.model)
    if wanted != found:
        versions = bundle.manifest.versions
        raise ToolkitError(
            f"robot {native.robot.name!r} is not the model that bundle {bundle.path} was made on (digest {found[:12]}..., not "
            f"{wanted[:12]}...); it was made with robosuite {versions.get('robosuite')} and mujoco {versions.get('mujoco')}"
        )


def evaluate_native(
    policy: GaussianPolicy | Path,
    robot: System,
    task: Task,
    episodes: int,
    seed: int = 0,
    processes: int | None = None,
    progress: Callable[[int, int], None] = lambda done, successes: None,
    cluster: Cluster | None = None,
) -> Evaluation:
    """Success of the policy's mean action on the unmodified robosuite robot, through env.step.

    Args:
        policy: the policy, or the path of a bundle whose ONNX graph then plays alone.
        robot, task: what is evaluated.
        episodes: how many.
        seed: shifts the seeds.
        processes: default: the machine's cores (robosuite's step is Python, so threads would not help).
        progress: called with episodes done and successes so far.
        cluster: plays the episodes of a policy, with the same outcomes; a bundle is always played here.
    """
    seeds = [EVALUATION_SEEDS + seed * 10**6 + i for i in range(episodes)]
    workers = processes or len(os.sched_getaffinity(0))
    successes, diverged = 0, 0
    if cluster is None or isinstance(policy, Path):
        outcomes = _outcomes(robot, task, policy, seeds, workers)
    else:
        outcomes = cluster.judged(robot, task, policy.mean, seeds)
    for done, (success, blew_up) in enumerate(outcomes, start=1):
        successes, diverged = successes + success, diverged + blew_up
        progress(done, successes)
    return Evaluation(robot.name, "native", episodes, successes, diverged, seeds[0])


def _outcomes(
    robot: System, task: Task, policy: GaussianPolicy | Path, seeds: Sequence[int], workers: int
) -> Iterator[Outcome]:
    if workers == 1 or len(seeds) < 4:
        yield from map(_player(robot, task, policy), seeds)
        return
    try:
        with ProcessPoolExecutor(workers, mp_context=get_context("spawn"), initializer=start_worker) as pool:
            yield from pool.map(partial(_play_in_worker, robot, task, policy), seeds, chunksize=2)
    except BrokenProcessPool:
        raise ToolkitError(
            f"one of {workers} processes that evaluate was killed, perhaps for want of memory, and its episodes are not known; free "
            "memory and evaluate again"
        ) from None

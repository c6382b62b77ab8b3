"""Success where it is claimed: on F(beta), and on the unmodified robosuite robot through robosuite's own env.step."""

import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import Literal

import mujoco
import numpy as np
from scipy.stats import binomtest

from grippers.gripper import COMMANDED_ROLES
from robots.robot import Robot
from tasks.env import Pick
from tasks.pick import START_POSITION, START_ROTATION, PickTask, observe
from toolkit.bundle.reading import Bundle, load_bundle
from toolkit.datasheet import model_sha256
from toolkit.errors import ToolkitError
from toolkit.evolution import EvolutionTree
from toolkit.learning.policy import GaussianPolicy
from toolkit.morphology.posture import GRIP_SITE, native_env, role_actuators
from toolkit.quiet import start_worker
from toolkit.simulation.plant import CLOSING, command_law, finger_map
from toolkit.simulation.rollout import NativeEngine, RolloutEngine

EVALUATION_SEEDS = 10**9
"""First seed of evaluations; training and the schedule's own checks stay far below."""


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
        }  # fmt: skip


def evaluate_merged(policy: GaussianPolicy, engine: RolloutEngine, target: str, episodes: int, seed: int = 0) -> Evaluation:
    """Success of the policy's mean action on F(beta) of ``target``, on seeds that training never saw."""
    beta = engine.merged.space.beta(target)
    seeds = [EVALUATION_SEEDS + seed * 10**6 + i for i in range(episodes)]
    played = engine.play(lambda observation, rng: policy.mean(observation), [beta] * episodes, seeds)
    return Evaluation(target, "merged", episodes, sum(e.success for e in played), sum(e.diverged for e in played), seeds[0])


@dataclass(frozen=True)
class Waypoint:
    """Success of one policy, untrained for it, on a robot of an edge of the evolution tree.

    Attributes:
        start, end: names of the edge's nodes.
        share: of the edge that lies behind, 0 to 1.
        episodes, successes, diverged: counts.
    """

    start: str
    end: str
    share: float
    episodes: int
    successes: int
    diverged: int


def walk(
    policy: GaussianPolicy, engine: RolloutEngine, tree: EvolutionTree, steps: int, episodes: int
) -> Iterator[Waypoint]:
    """Walk every edge of a tree with a policy that is not trained on the way: where does it break?

    Args:
        policy: plays its mean action.
        engine: of the merged robot in which the tree lies.
        tree: whose edges to walk.
        steps: parts of each edge; its ends are measured too.
        episodes: per robot, on evaluation's seeds.
    """
    seeds = [EVALUATION_SEEDS + i for i in range(episodes)]
    for edge in tree.edges:
        start, end = tree.nodes[edge.start], tree.nodes[edge.end]
        for share in np.linspace(0.0, 1.0, steps + 1):
            alpha = start.alpha + share * (end.alpha - start.alpha)
            played = engine.play(lambda observation, rng: policy.mean(observation), [alpha] * episodes, seeds)
            yield Waypoint(start.name, end.name, float(share), episodes, sum(e.success for e in played),
                           sum(e.diverged for e in played))  # fmt: skip


def evaluate_compiled(policy: GaussianPolicy, robot: Robot, task: PickTask, episodes: int, seed: int = 0) -> Evaluation:
    """As ``evaluate_native``, on the same seeds, with the compiled control step in place of robosuite's: some ten times faster."""
    seeds = [EVALUATION_SEEDS + seed * 10**6 + i for i in range(episodes)]
    engine = NativeEngine(robot, task)
    played = engine.play(lambda observation, rng: policy.mean(observation), [np.zeros(1)] * episodes, seeds)
    engine.close()
    successes, diverged = (sum(getattr(e, key) for e in played) for key in ("success", "diverged"))
    return Evaluation(robot.name, "native-compiled", episodes, successes, diverged, seeds[0])


class NativeRobot:
    """An unmodified robosuite robot in its own environment, with the named observation and action records around it.

    Args:
        robot: which.
        task: what it does.
    """

    def __init__(self, robot: Robot, task: PickTask) -> None:
        self.robot, self.task = robot, task
        self.env: Pick = native_env(robot, task)
        self.env.begin(0)
        self.model: mujoco.MjModel = self.env.sim.model._model
        self.data: mujoco.MjData = self.env.sim.data._data
        self.law = command_law(robot)
        mujoco.mj_forward(self.model, self.data)
        self._fingers = finger_map(robot, self.model, self.data)
        self.command = np.full(len(COMMANDED_ROLES), self.law.preshape)
        self._site = self.model.site(GRIP_SITE).id
        actuators = role_actuators(self.model, robot)
        driven = [actuators[role] for role in robot.gripper.targets]
        own = [int(a) for a in self.env.robots[0]._ref_joint_gripper_actuator_indexes["right"]]
        self._order = [driven.index(a) for a in own]
        low, high = self.model.actuator_ctrlrange[own].T
        self._middle, self._half = 0.5 * (high + low), 0.5 * (high - low)

    def begin(self, seed: int) -> np.ndarray:
        """Reset to the start of a seed; returns the observation (n_obs,)."""
        self.env.begin(seed)
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
        return self.observe()

    def observe(self) -> np.ndarray:
        """The observation record (n_obs,), from robosuite's simulation."""
        data = self.data
        fingers = np.array([sign * (data.qpos[q] - start) if q >= 0 else 0.0 for q, sign, start in self._fingers])
        return observe(
            fingers, self.law.progress(self.command), data.site_xpos[self._site], data.site_xmat[self._site].reshape(3, 3),
            self.env.object_position, self.env.object_rotation, self.env.goal, START_POSITION, START_ROTATION,
        )  # fmt: skip

    def play(
        self, act: Callable[[np.ndarray], np.ndarray], seed: int, trace: list | None = None, native: bool = False
    ) -> bool:
        """One episode with a deterministic policy; returns whether the task succeeded.

        Args:
            act: observation (n_obs,) -> action of the record (n_act,), or robosuite's own action if ``native``.
            seed: of the start.
            trace: if given, qpos (nq,) is appended at every step.
            native: see ``act``.
        """
        step = self.apply if native else self.step
        observation = self.begin(seed)
        for _ in range(self.task.horizon):
            if trace is not None:
                trace.append(np.array(self.data.qpos))
            observation = step(act(observation))
            if not np.isfinite(observation).all():
                return False
            if self.env.succeeded or self.env.lost:
                break
        if trace is not None:
            trace.append(np.array(self.data.qpos))
        return bool(self.env.succeeded)


_robots: dict[tuple[str, str], NativeRobot] = {}


_bundles: dict[Path, Bundle] = {}


def _play_natively(job: tuple[Robot, PickTask, GaussianPolicy | Path, int]) -> bool:
    robot, task, policy, seed = job
    key = (robot.name, task.name)
    if key not in _robots:
        _robots[key] = NativeRobot(robot, task)
    if isinstance(policy, Path):
        if policy not in _bundles:
            _bundles[policy] = load_bundle(policy)
            _same_model(_bundles[policy], _robots[key])
        return _robots[key].play(_bundles[policy], seed, native=True)
    return _robots[key].play(policy.mean, seed)


def _same_model(bundle: Bundle, native: NativeRobot) -> None:
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
    robot: Robot,
    task: PickTask,
    episodes: int,
    seed: int = 0,
    processes: int | None = None,
    progress: Callable[[int, int], None] = lambda done, successes: None,
) -> Evaluation:
    """Success of the policy's mean action on the unmodified robosuite robot, through env.step.

    Args:
        policy: the policy, or the path of a bundle whose ONNX graph then plays alone.
        robot, task: what is evaluated.
        episodes: how many.
        seed: shifts the seeds.
        processes: default: the machine's cores (robosuite's step is Python, so threads would not help).
        progress: called with episodes done and successes so far.
    """
    seeds = [EVALUATION_SEEDS + seed * 10**6 + i for i in range(episodes)]
    jobs = [(robot, task, policy, s) for s in seeds]
    workers = processes or len(os.sched_getaffinity(0))
    successes = 0
    for done, success in enumerate(_outcomes(jobs, workers), start=1):
        successes += success
        progress(done, successes)
    return Evaluation(robot.name, "native", episodes, successes, 0, seeds[0])


def _outcomes(jobs: Sequence[tuple], workers: int) -> Iterator[bool]:
    if workers == 1 or len(jobs) < 4:
        yield from map(_play_natively, jobs)
        return
    try:
        with ProcessPoolExecutor(workers, mp_context=get_context("spawn"), initializer=start_worker) as pool:
            yield from pool.map(_play_natively, jobs, chunksize=2)
    except BrokenProcessPool:
        raise ToolkitError(
            f"one of {workers} processes that evaluate was killed, perhaps for want of memory, and its episodes are not known; free "
            "memory and evaluate again"
        ) from None

"""A weighted metric, as the paper's discussion hopes for: how much each evolution parameter changes what the policy lives in.

Measured by finite differences of short rollouts: the expert plays the same seed on F(alpha) and on F(alpha + h e_d), and the two
courses of observations are compared in the policy's own units. A weight of a dimension is that difference per alpha. `judge` says
whether a metric foretells what it should: how much of the policy's success a robot's distance costs.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
from scipy.stats import bootstrap, spearmanr

from tasks.sight import Sight
from toolkit.capability.bench import Bench
from toolkit.evolution import Terminal, evolution_tree
from toolkit.expert.training import arms_of
from toolkit.learning.policy import GaussianPolicy, MeanActor
from toolkit.morphology.build import MergedRobot
from toolkit.runs.seeds import SENSITIVITY_SEEDS
from toolkit.simulation.laws import merged_plant
from toolkit.simulation.rollout import RolloutEngine, play_on

REACH = 0.1
"""h: far enough for contact to answer, near enough to be local [alpha]."""
STEPS = 30
"""Policy steps of a short rollout: approach and closing."""
RESAMPLED = 1000
"""Draws of the bootstrap by which two metrics are told apart."""


def sensitivities(
    merged: MergedRobot, policy: GaussianPolicy, alpha: np.ndarray, sight: Callable[[np.ndarray], Sight], seeds: int = 1
) -> Iterator[float]:
    """For each dimension in turn, the root mean square change of the observations per alpha, in the policy's units.

    Args:
        alpha: (D,) where to measure; each dimension is moved towards the farther end of its range.
        sight: alpha (D,) -> how the policy sees that robot, as a transfer has it.
        seeds: starts to average over.
    """
    model, data = merged.new()
    scale = np.asarray(policy.layers().scale)
    courses = [_course(merged, policy.through(sight(alpha)), alpha, seed, model, data) for seed in range(seeds)]
    for d in range(alpha.size):
        moved = alpha.copy()
        moved[d] += REACH if alpha[d] <= 0.5 else -REACH
        changes = []
        for seed, course in enumerate(courses):
            other = _course(merged, policy.through(sight(moved)), moved, seed, model, data)
            steps = min(len(course), len(other))
            changes.append(((other[:steps] - course[:steps]) / scale) ** 2)
        yield float(np.sqrt(np.mean(np.concatenate(changes)))) / REACH


def _course(
    merged: MergedRobot, policy: GaussianPolicy, alpha: np.ndarray, seed: int, model: mujoco.MjModel, data: mujoco.MjData
) -> np.ndarray:
    """Observations (T, n_obs) of the mean action on F(alpha)."""
    plant = merged_plant(merged, alpha, model, data)
    first = plant.begin(SENSITIVITY_SEEDS + seed)
    played = play_on(plant, MeanActor(policy), np.random.default_rng(0), first, STEPS)
    return np.nan_to_num(np.array([*played.observations, played.observation]))


def capability_weights(merged: MergedRobot, alphas: Sequence[np.ndarray], progress: Callable[[int, int], None]) -> np.ndarray:
    """For each dimension (D,), how much of what a robot can do it changes per alpha, mean over the robots ``alphas``; no policy is asked.

    A change of 10 N of grip, of half of its balance, of 10 mm of its height or of 30 mm of opening count as one.
    """
    bench = Bench(merged)
    scale = {"grip_n": 10.0, "balance": 0.5, "height_mm": 10.0, "opening_mm": 30.0}

    def able(alpha: np.ndarray) -> np.ndarray:
        found = bench.measure(alpha, detail="closed")
        return np.array([getattr(found, name) / size for name, size in scale.items()])

    weights, total = np.zeros(merged.space.size), len(alphas) * merged.space.size
    for i, alpha in enumerate(alphas):
        here = able(alpha)
        for d in range(alpha.size):
            moved = alpha.copy()
            moved[d] += REACH if alpha[d] <= 0.5 else -REACH
            weights[d] += float(np.linalg.norm(able(moved) - here)) / REACH / len(alphas)
            progress(i * alpha.size + d + 1, total)
    return weights


def weighted(terminals: Sequence[Terminal], weights: np.ndarray) -> list[Terminal]:
    """Terminals in coordinates whose plain L1 distance is the weighted one; weights (D,) are scaled to a mean of 1."""
    scale = weights / weights.mean()
    return [Terminal(terminal.name, terminal.alpha * scale) for terminal in terminals]


@dataclass(frozen=True)
class Judgement:
    """Robots at random places on the way, and how the untrained expert does on them.

    Attributes:
        alphas: (N, D).
        success: (N,) rate.
    """

    alphas: np.ndarray
    success: np.ndarray

    def rank_correlation(self, source: np.ndarray, weights: np.ndarray, order: int = 1) -> float:
        """Spearman's correlation of distance from the source with failure: 1 if the metric foretells it perfectly."""
        return float(spearmanr(self._away(source, weights, order), -self.success).statistic)

    def ahead(self, source: np.ndarray, weights: np.ndarray) -> float:
        """Share of bootstrap samples of the robots (Efron 1979) on which weighted L1 foretells failure better than plain L1."""
        samples = (self._away(source, weights), self._away(source, np.ones_like(weights)), -self.success)
        lead = lambda weighed, plain, failure: spearmanr(weighed, failure).statistic - spearmanr(plain, failure).statistic  # noqa: E731
        drawn = bootstrap(samples, lead, paired=True, vectorized=False, n_resamples=RESAMPLED, method="percentile", rng=0)
        return float(np.mean(drawn.bootstrap_distribution > 0.0))

    def _away(self, source: np.ndarray, weights: np.ndarray, order: int = 1) -> np.ndarray:
        """(N,) distances of the robots from the source."""
        return np.linalg.norm((self.alphas - source) * weights, order, axis=1)


def judge(
    engine: RolloutEngine, policy: GaussianPolicy, source: Terminal, targets: Sequence[Terminal],
    sight: Callable[[np.ndarray], Sight], robots: int, episodes: int, seed: int,
) -> Judgement:
    """Play the expert on random robots between source and targets.

    Each robot takes every dimension from a random share of the way to a random target, and each target's share is its own: what
    differs between robots is which dimensions have moved, not only how far.
    """
    rng = np.random.default_rng(seed)
    alphas, success = [], []
    seeds = [SENSITIVITY_SEEDS + 1000 + i for i in range(episodes)]
    for _ in range(robots):
        goal = targets[int(rng.integers(len(targets)))].alpha
        moved = rng.random(goal.size) < rng.random()
        alpha = np.where(moved, source.alpha + rng.random() * (goal - source.alpha), source.alpha)
        played = engine.play(MeanActor(policy.through(sight(alpha))), [alpha] * episodes, seeds)
        alphas.append(alpha)
        success.append(np.mean([episode.success for episode in played]))
    return Judgement(np.array(alphas), np.array(success))


@dataclass(frozen=True)
class MetricResult:
    """One way to measure distance: how well it foretells failure, and what its tree costs in its own unit.

    Attributes:
        name: of the metric.
        correlation: Spearman's, of distance from the source with failure.
        ahead: share of bootstrap samples of the robots on which it foretells failure better than plain L1.
        length, independent_length, ratio: of the shortest tree.
        metas: L1 distance of the first meta robot from the source, unweighted [alpha].
    """

    name: str
    correlation: float
    ahead: float
    length: float
    independent_length: float
    ratio: float
    metas: float


@dataclass(frozen=True)
class Comparison:
    """Weights (D,) of the dimensions, relative to their mean; the expert's mean success; and each metric's result."""

    weights: list[float]
    success: float
    metrics: list[MetricResult]


def compare_metrics(
    engine: RolloutEngine, policy: GaussianPolicy, source: Terminal, targets: Sequence[Terminal],
    sight: Callable[[np.ndarray], Sight], robots: int, episodes: int, seed: int,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> Comparison:
    """Measure weights, by rollouts at the source and by capability at every robot, judge the expert on random robots, and compare."""
    merged, weights = arms_of(engine), np.empty(source.alpha.size)
    for d, weight in enumerate(sensitivities(merged, policy, source.alpha, sight)):
        weights[d] = weight
        progress(d + 1, weights.size)
    weights /= weights.mean()
    able = capability_weights(merged, [source.alpha, *(target.alpha for target in targets)], progress)
    able = 0.5 + 0.5 * able / able.mean()  # the arm counts too, though no finger feels it
    judged = judge(engine, policy, source, targets, sight, robots, episodes, seed)
    results = []
    for name, scale in (
        ("L1", np.ones_like(weights)), ("weighted L1", weights), ("L1, root of weights", np.sqrt(weights)), ("L1 by capability", able),
    ):
        start, *goals = weighted([source, *targets], scale)
        tree = evolution_tree(start, goals)
        first = tree.next_meta().meta_alpha / np.maximum(scale / scale.mean(), 1e-12)
        away = float(np.abs(np.where(scale > 0, first - source.alpha, 0.0)).sum())
        correlation, ahead = judged.rank_correlation(source.alpha, scale), judged.ahead(source.alpha, scale)
        results.append(MetricResult(name, correlation, ahead, tree.length, tree.independent_length, tree.ratio, away))
    return Comparison(weights.tolist(), float(judged.success.mean()), results)

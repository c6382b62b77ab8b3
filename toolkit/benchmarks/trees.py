"""How long the shortest trees take, and how far their proofs reach, on random points: what `bench tree` measures."""

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from toolkit.evolution.solve import evolution_tree
from toolkit.evolution.tree import Metric, Terminal

REPEATS = 3
"""The least of so many times counts: what a busy machine adds is not the solver's."""


@dataclass(frozen=True)
class Timing:
    """One tree.

    Attributes:
        terminals: source and targets.
        metric: "l1" or "l2".
        seconds: wall time of one replan, compiled before [s].
        cpu_seconds: of its one thread; less than seconds where others use the core [s].
        length: of the tree found [alpha].
        lower_bound: no tree is shorter [alpha].
        gap: 1 - lower_bound / length; 0 if proven.
        optimal: proven.
        best_known: length of the tree that the longer search found; None if there was none.
        excess: length / best_known - 1.
    """

    terminals: int
    metric: Metric
    seconds: float
    cpu_seconds: float
    length: float
    lower_bound: float
    gap: float
    optimal: bool
    best_known: float | None
    excess: float | None


def random_robots(terminals: int, dimensions: int, seed: int) -> tuple[Terminal, list[Terminal]]:
    """Source and targets, uniform in the unit box: the hardest points for a proof, since all are about equally far apart."""
    points = np.random.default_rng(seed).random((terminals, dimensions))
    robots = [Terminal("source" if i == 0 else f"target-{i}", point) for i, point in enumerate(points)]
    return robots[0], robots[1:]


def time_trees(
    terminals: Sequence[int], dimensions: int, metrics: Sequence[Metric], seed: int = 0, longer: float = 0.0
) -> Iterator[Timing]:
    """Time the shortest tree over each number of terminals, in each metric.

    Args:
        longer: effort of a second search, in multiples of the first, whose length is the best known; 0: none.
    """
    for metric in metrics:
        evolution_tree(*random_robots(13, 3, 0), metric)  # compiles
        evolution_tree(*random_robots(6, 3, 0), metric)
        for count in terminals:
            source, targets = random_robots(count, dimensions, seed)
            times = []
            for _ in range(REPEATS):
                began = time.perf_counter(), time.thread_time()
                tree = evolution_tree(source, targets, metric)
                times.append((time.perf_counter() - began[0], time.thread_time() - began[1]))
            best = None
            if longer:
                best = tree.length if tree.optimal else min(tree.length, evolution_tree(source, targets, metric, effort=longer).length)
            seconds, cpu_seconds = (min(column) for column in zip(*times, strict=True))
            yield Timing(
                count, metric, seconds, cpu_seconds, tree.length, tree.lower_bound,
                max(0.0, 1 - tree.lower_bound / tree.length), tree.optimal, best, None if best is None else tree.length / best - 1,
            )

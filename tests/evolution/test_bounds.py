"""What no tree undercuts: a bound on tours, against all tours and against trees proven shortest."""

import itertools

import numpy as np
import pytest
from toy_trees import mst, tree_of

from toolkit.evolution import METRICS
from toolkit.evolution.bounds import tour_bound


@pytest.mark.parametrize("metric", METRICS)
def test_the_tour_bound_is_a_bound_and_beats_half_a_spanning_tree(metric):
    for seed in range(5):
        points = np.random.default_rng(seed).random((7, 8))
        bound, best = tour_bound(points, metric), tree_of(points, metric).length
        assert mst(points, metric) / 2 < bound <= best
    chain = np.linspace(0, 1, 6)[:, None] * np.ones(3)
    short = 1 - tour_bound(chain, metric) / tree_of(chain, metric).length
    assert 0 <= short + 1e-12 < 0.01, f"a chain's tour is its double, but the bound is {short:.2%} short of it"


@pytest.mark.parametrize("metric, p", [("l1", 1), ("l2", 2)])
def test_the_bound_is_a_little_less_than_half_of_the_shortest_of_all_tours(metric, p):
    for seed in range(4):
        points = np.random.default_rng(seed).random((7, 3))
        gaps = np.linalg.norm(points[:, None] - points, p, axis=2)
        tours = ([0, *way, 0] for way in itertools.permutations(range(1, 7)))
        shortest = min(gaps[tour[:-1], tour[1:]].sum() for tour in tours)
        assert 0.97 * shortest <= 2 * tour_bound(points, metric) <= shortest + 1e-12, f"seed {seed}"

"""What `bench tree` measures: random robots that a seed repeats, and trees as short as all topologies allow."""

import numpy as np
import pytest
from toy_trees import euclidean_length, hanan_length, topologies

from toolkit.benchmarks import trees
from toolkit.benchmarks.trees import random_robots, time_trees


def test_a_seed_gives_the_same_robots_in_the_unit_box():
    source, targets = random_robots(5, 40, 7)
    again, others = random_robots(5, 40, 7), random_robots(5, 40, 8)
    points = np.array([robot.alpha for robot in (source, *targets)])
    assert [robot.name for robot in (source, *targets)] == ["source", "target-1", "target-2", "target-3", "target-4"]
    np.testing.assert_array_equal(points, [robot.alpha for robot in (again[0], *again[1])])
    assert not np.array_equal(points[0], others[0].alpha)
    assert points.min() >= 0 and points.max() <= 1 and points.std() == pytest.approx(12**-0.5, rel=0.1), "uniform"


@pytest.mark.slow
def test_what_is_timed_is_the_shortest_tree(monkeypatch):
    """Over five robots in three dimensions, in both metrics, against every topology."""
    monkeypatch.setattr(trees, "REPEATS", 1)
    timed = {timing.metric: timing for timing in time_trees((5,), 3, ("l1", "l2"), seed=3, longer=1.0)}
    source, targets = random_robots(5, 3, 3)
    points, rng = np.array([robot.alpha for robot in (source, *targets)]), np.random.default_rng(0)
    lengths = {"l1": min(hanan_length(edges, points) for edges in topologies(5)),
               "l2": min(euclidean_length(edges, points, rng) for edges in topologies(5))}
    for metric, timing in timed.items():
        assert timing.length == pytest.approx(lengths[metric], rel=1e-4) and timing.optimal and timing.terminals == 5
        assert timing.best_known == timing.length and timing.excess == 0
        assert timing.gap == pytest.approx(max(0, 1 - timing.lower_bound / timing.length)) and timing.seconds > 0

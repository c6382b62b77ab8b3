"""The tree of one meta robot: no point near the median is better."""

import numpy as np
import pytest
from toy_trees import degrees, metas, tree_of


@pytest.mark.parametrize("metric, p", [("l1", 1), ("l2", 2)])
def test_geometric_median_is_a_minimum(metric, p):
    rng = np.random.default_rng(12)
    for count in (3, 4, 5):
        points = rng.random((count, 4))
        tree = tree_of(points, metric, "geometric-median")
        (meta,) = metas(tree)
        here = np.linalg.norm(points - meta.alpha, p, axis=1).sum()
        assert tree.length == pytest.approx(here)
        for step in 1e-4 * rng.standard_normal((50, 4)):
            assert np.linalg.norm(points - meta.alpha - step, p, axis=1).sum() >= here - 1e-12


def test_geometric_median_at_a_terminal_needs_no_meta_robot():
    tree = tree_of([[0.5, 0.5], [0, 0.5], [1, 0.5], [0.5, 0], [0.5, 1]], "l2", "geometric-median")
    assert not metas(tree) and degrees(tree)[0] == 4


def test_an_even_median_keeps_the_source_value():
    tree = tree_of([[0.4], [0.0], [0.3], [1.0]], "l1", "geometric-median")
    median = [node for i, node in enumerate(tree.nodes) if degrees(tree)[i] == 3]
    assert median[0].alpha == pytest.approx([0.4])

"""The Euclidean length of one topology: Smith's bounds and Newton's last digits, against scipy's minimiser."""

import numpy as np
import pytest
from toy_trees import euclidean_length

from toolkit.evolution.parsimony import stepwise_addition
from toolkit.evolution.smith import polish, smith


def topology(points, rng):
    """A random topology over points (n, d), its Steiner points somewhere among them: places (2n-2, d), parent, kids."""
    n = len(points)
    parent, kids = stepwise_addition(points, 1 + rng.permutation(n - 1))
    places = np.vstack([points, points.mean(axis=0) + 0.1 * rng.standard_normal((n - 2, points.shape[1]))])
    return places, parent, kids


@pytest.mark.parametrize("n, d, seed", [(4, 2, 0), (5, 3, 1), (6, 2, 2), (7, 5, 3)])
def test_bounds_enclose_and_the_polish_meets_the_length_that_scipy_finds(n, d, seed):
    rng = np.random.default_rng(seed)
    points = rng.random((n, d))
    places, parent, kids = topology(points, rng)
    edges = [(node, int(parent[node])) for node in range(1, 2 * n - 2)]
    found = euclidean_length(edges, points, rng)
    lower, upper = smith(places, parent, kids, 0, 5, np.inf, 0.0)
    assert lower <= found + 1e-9 and found <= upper + 1e-5
    polish(places, parent, kids)
    length = sum(np.linalg.norm(places[start] - places[end]) for start, end in edges)
    assert length <= found + 1e-9 and length == pytest.approx(found, abs=1e-4)
    assert smith(places.copy(), parent, kids, 0, 2, np.inf, 0.0)[0] == pytest.approx(length, rel=1e-5), "the springs' forces are the proof"

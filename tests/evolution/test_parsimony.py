"""The local search over topologies, against what the proof finds."""

import numpy as np
import pytest
from toy_trees import tree_of

from toolkit.evolution.parsimony import search


def test_the_local_search_alone_finds_what_the_proof_finds():
    """Ten random instances of nine robots, each proven; the search knows nothing of the proof, nor the proof's order of it."""
    for seed in range(10):
        points = np.random.default_rng(seed).random((9, 30))
        proven = tree_of(points)
        assert proven.optimal
        _, _, found = search(points, 2000, seed)
        assert found == pytest.approx(proven.length, rel=1e-10), f"seed {seed}: {found / proven.length - 1:.2%} too long"

"""Topologies as arrays: surgery keeps a tree a tree."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from toy_trees import hanan_length

from toolkit.evolution.parsimony import stepwise_addition, tree_length
from toolkit.evolution.topology import graft, postorder, prune, reroot


@settings(max_examples=40)
@given(st.integers(3, 9), st.integers(0, 10_000))
def test_surgery_keeps_a_tree_a_tree(n, seed):
    """Grafts, prunes and reroots in random order: every node keeps its one parent, and the length does not depend on the root."""
    rng = np.random.default_rng(seed)
    points = rng.random((n, 4))
    parent, kids = stepwise_addition(points, 1 + rng.permutation(n - 1))
    for _ in range(5):
        node = int(rng.choice([v for v in range(1, 2 * n - 2) if parent[v] != 0]))
        hub, place = parent[node], prune(parent, kids, node)
        graft(parent, kids, node, hub, place)
        length, root = tree_length(points, parent, kids), int(rng.integers(n))
        reroot(parent, kids, 0, root)
        assert parent[root] == -1 and kids[root, 1] == -1
        reroot(parent, kids, root, 0)
        assert tree_length(points, parent, kids) == pytest.approx(length)
    order = np.empty(n, np.int64)
    assert postorder(kids, 0, order) == n - 2 and parent[0] == -1
    for node in range(1, 2 * n - 2):
        assert node in kids[parent[node]] and (kids[node] >= 0).all() == (node >= n)
    edges = [(node, int(parent[node])) for node in range(1, 2 * n - 2)]
    assert tree_length(points, parent, kids) == pytest.approx(hanan_length(edges, points))

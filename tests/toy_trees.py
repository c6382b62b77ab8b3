"""Robots as bare points, their shortest tree, what every such tree is, and all topologies with their L1 length by dynamic programming."""

import numpy as np
import pytest
from hypothesis import strategies as st
from scipy.optimize import minimize
from scipy.sparse.csgraph import minimum_spanning_tree
from scipy.spatial.distance import cdist

from toolkit.evolution import Terminal, evolution_tree


def robots(points):
    points = np.asarray(points, dtype=float)
    return Terminal("source", points[0]), [Terminal(f"t{i}", p) for i, p in enumerate(points[1:], 1)]


def tree_of(points, metric="l1", kind="steiner"):
    return evolution_tree(*robots(points), metric, kind)


def hanan_length(edges, points):
    """L1 length of one topology: dynamic programming over the terminals' coordinates, dimension by dimension."""
    neighbours = {}
    for a, b in edges:
        neighbours.setdefault(a, []).append(b)
        neighbours.setdefault(b, []).append(a)

    def cost(node, parent, values):
        own = np.where(values == values[node], 0.0, np.inf) if node < len(values) else np.zeros(len(values))
        for child in neighbours[node]:
            if child != parent:
                own = own + (cost(child, node, values) + np.abs(values[:, None] - values)).min(axis=1)
        return own

    return sum(cost(0, None, column).min() for column in points.T)


SCIPY = {"l1": "cityblock", "l2": "euclidean"}


def metas(tree):
    return [node for node in tree.nodes if node.kind == "meta"]


def degrees(tree):
    ends = [end for edge in tree.edges for end in (edge.start, edge.end)]
    return np.bincount(ends, minlength=len(tree.nodes))


def mst(points, metric):
    points = np.unique(points, axis=0)  # scipy takes a distance of zero for no edge
    return minimum_spanning_tree(cdist(points, points, SCIPY[metric])).sum()


def check_tree(tree):
    """It is a tree over all nodes, directed from the source, and its numbers agree with each other."""
    above = {edge.end: edge.start for edge in tree.edges}
    assert len(above) == len(tree.edges) == len(tree.nodes) - 1 and 0 not in above
    seen = {0}
    for edge in tree.edges:
        assert edge.start in seen, "edges are not ordered from the source"
        seen.add(edge.end)
        gap = tree.nodes[edge.start].alpha - tree.nodes[edge.end].alpha
        assert edge.length == pytest.approx(np.linalg.norm(gap, 1 if tree.metric == "l1" else 2), abs=1e-12)
    assert tree.lower_bound <= tree.length
    assert all(degrees(tree)[i] >= 3 for i, n in enumerate(tree.nodes) if n.kind == "meta") or tree.kind != "steiner"


def topologies(n):
    """All (2n-5)!! unrooted binary trees over leaves 0 .. n-1, as edge lists."""
    trees = [[(0, n), (1, n), (2, n)]]
    for leaf in range(3, n):
        hub = n + leaf - 2
        trees = [
            [*tree[:i], *tree[i + 1 :], (tree[i][0], hub), (hub, tree[i][1]), (leaf, hub)]
            for tree in trees
            for i in range(len(tree))
        ]
    return trees


clouds = st.integers(2, 7).flatmap(
    lambda n: st.integers(1, 4).flatmap(
        lambda d: st.lists(st.lists(st.integers(0, 8), min_size=d, max_size=d), min_size=n, max_size=n)
    )
)


def euclidean_length(edges, points, rng):
    n, d = points.shape
    ends = np.array(edges)

    def length(flat):
        nodes = np.vstack([points, flat.reshape(-1, d)])
        return np.sqrt((np.diff(nodes[ends], axis=1)[:, 0] ** 2).sum(axis=1) + 1e-12).sum()

    start = points.mean(axis=0) + 0.1 * rng.standard_normal((n - 2, d))
    return minimize(length, start.ravel(), method="BFGS").fun

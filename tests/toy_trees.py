"""Robots as bare points, their shortest tree, and the L1 length of a topology by dynamic programming."""

import numpy as np

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

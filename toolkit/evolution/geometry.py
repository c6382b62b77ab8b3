"""Distances between points, and which points are one."""

import numpy as np
from scipy.spatial.distance import cdist

TIE = 1e-10
"""Trees whose lengths differ by less than this fraction are equally short; points this close, by their extent, are one."""


def distances(a: np.ndarray, b: np.ndarray, metric: str) -> np.ndarray:
    """(n, D), (m, D) -> (n, m) distances."""
    return cdist(a, b, "cityblock" if metric == "l1" else "euclidean")


def extent(points: np.ndarray) -> float:
    """The longest side of the points' box: the yardstick of every tolerance."""
    return float(np.ptp(points, axis=0).max())


def distinct_points(points: np.ndarray) -> tuple[list[int], list[int]]:
    """Indices of points that differ, and for every point the index of the one it equals."""
    near = cdist(points, points, "chebyshev") <= TIE * extent(points)
    distinct: list[int] = []
    twin = []
    for index, row in enumerate(near):
        twin.append(next((other for other in distinct if row[other]), index))
        if twin[-1] == index:
            distinct.append(index)
    return distinct, twin

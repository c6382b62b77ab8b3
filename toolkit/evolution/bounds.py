"""Lengths that no tree undercuts, whatever its topology, from the distances between terminals alone."""

import numpy as np
from numba import njit

from toolkit.evolution.geometry import distances

ROUNDS = 300
"""Subgradient steps of the Held-Karp ascent."""


def tour_bound(points: np.ndarray, metric: str) -> float:
    """Half of a lower bound on the shortest tour through points (n, D).

    Walking around a tree that joins all points passes every edge twice and visits every point, so no tree is shorter than
    half a tour. The tour is bounded by Held and Karp's Lagrangian ("The traveling-salesman problem and minimum spanning trees",
    Operations Research 1970): the shortest 1-tree after a price per point that no tour's length depends on.
    """
    gaps = distances(points, points, metric)
    return 0.5 * _held_karp(gaps, ROUNDS) if len(points) > 2 else float(gaps.max(initial=0.0))


@njit(cache=True)
def _held_karp(gaps: np.ndarray, rounds: int) -> float:
    """Largest 1-tree bound that a subgradient ascent reaches on (n, n) distances."""
    n = len(gaps)
    price, best = np.zeros(n), 0.0
    step = 0.0
    for r in range(rounds):
        length, degree = _one_tree(gaps, price)
        value = length - 2 * price.sum()
        best = max(best, value)
        if r == 0:
            step = value / (2.0 * n)
        for j in range(n):
            price[j] += step * (degree[j] - 2)
        step *= 0.985
    return best


@njit(cache=True)
def _one_tree(gaps: np.ndarray, price: np.ndarray) -> tuple[float, np.ndarray]:
    """Shortest spanning tree of points 1 .. n-1 (Prim 1957) plus the two shortest edges at point 0; length and degrees (n,)."""
    n = len(gaps)
    degree, length = np.zeros(n, np.int64), 0.0
    nearest, link, outside = np.full(n, np.inf), np.zeros(n, np.int64), np.ones(n, np.bool_)
    here = 1
    outside[0] = outside[1] = False
    for _ in range(n - 2):
        for j in range(2, n):
            cost = gaps[here, j] + price[here] + price[j]
            if outside[j] and cost < nearest[j]:
                nearest[j], link[j] = cost, here
        new, least = -1, np.inf
        for j in range(2, n):
            if outside[j] and nearest[j] < least:
                new, least = j, nearest[j]
        length += least
        degree[new] += 1
        degree[link[new]] += 1
        outside[new], here = False, new
    taken = 0
    for _ in range(2):
        new, least = 0, np.inf
        for j in range(1, n):
            cost = gaps[0, j] + price[0] + price[j]
            if j != taken and cost < least:
                new, least = j, cost
        length, taken = length + least, new
        degree[new] += 1
        degree[0] += 1
    return length, degree

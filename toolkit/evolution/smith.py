"""L2 length of a topology: Smith's iteration, its dual bound, and Newton's method to the last digit.

With the topology fixed the length is convex in the Steiner points. Smith ("How to find Steiner minimal trees in Euclidean
d-space", Algorithmica 1992) solves a tree of springs whose stiffnesses are the inverses of the last edge lengths, again and
again; on a tree that takes one pass up and one down. The forces in the springs balance at every Steiner node, so, scaled to at
most one, they are a dual solution: no tree of this topology is shorter than the work they do.
"""

import numpy as np
from numba import njit

from toolkit.evolution.topology import postorder

STIFFEST = 1e-10
"""Springs shorter than this get no stiffer, so that forces keep six digits; points are scaled to extent 1."""


@njit(cache=True, fastmath={"reassoc", "contract", "nsz"})
def edge_length(a: np.ndarray, b: np.ndarray) -> float:
    """Euclidean distance of two points (d,)."""
    total = 0.0
    for i in range(a.size):
        total += (a[i] - b[i]) ** 2
    return np.sqrt(total)


@njit(cache=True)
def smith(
    places: np.ndarray, parent: np.ndarray, kids: np.ndarray, root: int, sweeps: int, cutoff: float, close: float
) -> tuple[float, float]:
    """Improve the Steiner points of one topology in place.

    Args:
        places: (2n-2, d) all nodes, points first; Steiner points are where the iteration starts.
        sweeps: at most so many.
        cutoff: stop once no tree of this topology is shorter than this.
        close: stop once the bounds differ by less than this fraction.

    Returns:
        A length that no tree of this topology undercuts, and the least length found.
    """
    nodes, d = places.shape
    order = np.empty(nodes, np.int64)
    count, top = postorder(kids, root, order), kids[root, 0]
    stiffness, share, lower, upper = np.empty(nodes), np.empty(nodes), 0.0, np.inf
    rest = np.empty((nodes, d))
    for i in range(count):
        for side in range(2):
            kid = kids[order[i], side]
            stiffness[kid] = 1.0 / max(edge_length(places[kid], places[order[i]]), STIFFEST)
    stiffness[top] = 1.0 / max(edge_length(places[top], places[root]), STIFFEST)
    for _ in range(sweeps):
        for i in range(count):  # up: each node as a share of its parent's place plus a rest
            node = order[i]
            total = stiffness[node]
            for j in range(d):
                rest[node, j] = 0.0
            for side in range(2):
                kid = kids[node, side]
                if kids[kid, 1] >= 0:
                    total += stiffness[kid] * (1.0 - share[kid])
                    for j in range(d):
                        rest[node, j] += stiffness[kid] * rest[kid, j]
                else:
                    total += stiffness[kid]
                    for j in range(d):
                        rest[node, j] += stiffness[kid] * places[kid, j]
            share[node] = stiffness[node] / total
            for j in range(d):
                rest[node, j] /= total
        length, work, strongest = 0.0, 0.0, 0.0
        for i in range(count - 1, -1, -1):  # down
            node = order[i]
            above = parent[node]
            for j in range(d):
                places[node, j] = share[node] * places[above, j] + rest[node, j]
        for i in range(count + 1):  # measure: the edges below each Steiner node, and the root's
            node = order[i] if i < count else root
            for side in range(2 if i < count else 1):
                kid = kids[node, side]
                now = edge_length(places[kid], places[node])
                length += now
                work += stiffness[kid] * now * now
                strongest = max(strongest, stiffness[kid] * now)
                stiffness[kid] = 1.0 / max(now, STIFFEST)
        upper = min(upper, length)
        if strongest > 0.0:
            lower = max(lower, work / strongest)
        if lower > cutoff or upper - lower < close * upper:
            break
    return lower, upper


@njit(cache=True)
def _smoothed_length(places: np.ndarray, parent: np.ndarray, smooth: float) -> float:
    """Sum of sqrt(l^2 + smooth^2) over all edges."""
    total = 0.0
    for node in range(len(parent)):
        if parent[node] >= 0:
            total += np.sqrt(edge_length(places[node], places[parent[node]]) ** 2 + smooth * smooth)
    return total


@njit(cache=True)
def _solve(matrix: np.ndarray, right: np.ndarray) -> None:
    """Solve matrix (d, d) x = right (d, m) in place by Cholesky; the matrix, symmetric and positive definite, is overwritten."""
    d, m = right.shape
    for i in range(d):
        for j in range(i + 1):
            total = matrix[i, j]
            for k in range(j):
                total -= matrix[i, k] * matrix[j, k]
            matrix[i, j] = np.sqrt(max(total, 1e-300)) if i == j else total / matrix[j, j]
    for c in range(m):
        for i in range(d):
            for k in range(i):
                right[i, c] -= matrix[i, k] * right[k, c]
            right[i, c] /= matrix[i, i]
        for i in range(d - 1, -1, -1):
            for k in range(i + 1, d):
                right[i, c] -= matrix[k, i] * right[k, c]
            right[i, c] /= matrix[i, i]


@njit(cache=True)
def _newton_step(
    places: np.ndarray, parent: np.ndarray, kids: np.ndarray, order: np.ndarray, count: int, smooth: float, step: np.ndarray
) -> float:
    """Newton's step (2n-2, d) of the smoothed length, eliminated along the tree; returns how fast the length falls along it.

    Row v of the system is A_v y_v - sum over kids B_c y_c - B_v y_parent = g_v, with B_e the second derivative of edge e's length.
    """
    nodes, d = places.shape
    bend, schur = np.zeros((nodes, d, d)), np.zeros((nodes, d, d))
    gradient, work, slope = np.zeros((nodes, d)), np.empty((d, d + 1)), 0.0
    for node in range(nodes):
        above = parent[node]
        if above < 0:
            continue
        length = np.sqrt(edge_length(places[node], places[above]) ** 2 + smooth * smooth)
        for i in range(d):
            away = (places[node, i] - places[above, i]) / length
            gradient[node, i] += away
            gradient[above, i] -= away
            for j in range(d):
                bend[node, i, j] = -away * (places[node, j] - places[above, j]) / (length * length)
            bend[node, i, i] += 1.0 / length
    for i in range(count):
        node = order[i]
        for a in range(d):
            step[node, a] = gradient[node, a]
            for b in range(d):
                schur[node, a, b] = bend[node, a, b] + bend[kids[node, 0], a, b] + bend[kids[node, 1], a, b]
            schur[node, a, a] *= 1.0 + 1e-13
        for side in range(2):
            kid = kids[node, side]
            if kids[kid, 1] < 0:
                continue
            # schur[kid] holds its inverse, step[kid] the solved right side: see below
            for a in range(d):
                for k in range(d):
                    step[node, a] += bend[kid, a, k] * step[kid, k]
                for b in range(d):
                    total = 0.0
                    for k in range(d):
                        total += bend[kid, a, k] * schur[kid, k, b]
                    work[a, b] = total
            for a in range(d):
                for b in range(d):
                    total = 0.0
                    for k in range(d):
                        total += work[a, k] * bend[kid, k, b]
                    schur[node, a, b] -= total
        for a in range(d):
            for b in range(d):
                work[a, b] = 1.0 if a == b else 0.0
            work[a, d] = step[node, a]
        _solve(schur[node], work)
        for a in range(d):
            step[node, a] = work[a, d]
            for b in range(d):
                schur[node, a, b] = work[a, b]
    for i in range(count - 1, -1, -1):
        node = order[i]
        above = parent[node]
        if kids[above, 1] >= 0:
            for a in range(d):
                work[a, 0] = 0.0
                for k in range(d):
                    work[a, 0] += bend[node, a, k] * step[above, k]
            for a in range(d):
                for k in range(d):
                    step[node, a] += schur[node, a, k] * work[k, 0]
        for a in range(d):
            slope += gradient[node, a] * step[node, a]
    return slope


@njit(cache=True)
def polish(places: np.ndarray, parent: np.ndarray, kids: np.ndarray) -> None:
    """Best Steiner points of one topology rooted at leaf 0, in place, by Newton's method.

    Each length l is smoothed to sqrt(l^2 + e^2), with e shrinking to 1e-11: smooth and strictly convex, also where an edge
    vanishes. The smoothed optimum exceeds the true one by at most e per edge.
    """
    nodes, d = places.shape
    order = np.empty(nodes, np.int64)
    count = postorder(kids, np.int64(0), order)
    step, trial = np.zeros((nodes, d)), places.copy()
    smooth = 1e-2
    while smooth > 0.5e-11:
        for _ in range(40):
            slope = _newton_step(places, parent, kids, order, count, smooth, step)
            now, size = _smoothed_length(places, parent, smooth), 1.0
            while size > 1e-6:
                for i in range(count):
                    for j in range(d):
                        trial[order[i], j] = places[order[i], j] - size * step[order[i], j]
                if _smoothed_length(trial, parent, smooth) <= now - 1e-4 * size * slope:
                    break
                size /= 2
            if size <= 1e-6:
                break
            for i in range(count):
                for j in range(d):
                    places[order[i], j] = trial[order[i], j]
            if slope <= 1e-14:
                break
        smooth /= 10.0

"""The shortest L1 tree: branch and bound over topologies, exact with proof while the bound allows.

In one dimension, n sorted values are n - 1 gaps; each gap splits the terminals in two, and the best Steiner values cut a gap as
often as Fitch's parsimony ("Toward defining the course of evolution", Systematic Zoology 1971) changes state on that split. Many
dimensions thus collapse onto at most 2^(n-1) - 1 weighted splits, of which 64 fit in one machine word: D hardly matters.

The search grows trees leaf by leaf (Hendy and Penny, "Branch and bound algorithms to determine minimal evolutionary trees",
Mathematical Biosciences 1982). A leaf on an edge costs the weight of the splits whose best states there exclude the leaf's own.
The next leaf is the one whose cheapest place is dearest, so that bounds grow early.
"""

from dataclasses import dataclass

import numpy as np
from numba import njit

from toolkit.evolution import parsimony
from toolkit.evolution.bounds import tour_bound
from toolkit.evolution.geometry import TIE
from toolkit.evolution.topology import clades, graft, postorder, seed_tree

EXACT_BEYOND = 12
"""With more terminals no proof is attempted."""
SEARCH_BEYOND = 9
"""With more terminals the proof starts from what the local search found."""
PROOF_WORK = 28_000_000
"""Partial trees, times their edges, times words per edge, that a proof may look at; more than all of them for 10 terminals."""
SEARCH_WORK = 80_000_000
"""Trees, times their edges, times dimensions (and the cost of about PER_EDGE more), that the local search may price."""
PER_EDGE = 60
"""What an edge costs beside its dimensions, in dimensions."""


@dataclass(frozen=True, eq=False)
class Splits:
    """Terminals as weighted splits.

    Attributes:
        bits: (n, W) uint64, on which side of each split a terminal lies; the source lies on side 0.
        table: (8 W, 256) summed weight of each byte's bits [alpha].
        constant: weight of splits that part one terminal from all others: every tree cuts them exactly once.
    """

    bits: np.ndarray
    table: np.ndarray
    constant: float

    @classmethod
    def of(cls, points: np.ndarray) -> "Splits":
        """Splits of points (n, D), n at most 62."""
        n = len(points)
        rank = points.argsort(axis=0, kind="stable")
        gap = np.diff(np.take_along_axis(points, rank, axis=0), axis=0).ravel()
        upper = np.cumsum((1 << rank)[::-1], axis=0)[::-1][1:].ravel()
        upper = np.where(upper & 1, ((1 << n) - 1) ^ upper, upper)[gap > 0]
        code, inverse = np.unique(upper, return_inverse=True)
        weight = np.bincount(inverse, gap[gap > 0], len(code))
        side = (code >> np.arange(n)[:, None] & 1).astype(bool)
        size = side.sum(axis=0)
        inner = (size > 1) & (size < n - 1)
        padded = np.zeros((n + 1, max(1, -(-int(inner.sum()) // 64)) * 64))
        padded[:n, : inner.sum()], padded[n, : inner.sum()] = side[:, inner], weight[inner]
        bits = np.packbits(padded[:n].astype(bool), axis=1, bitorder="little").view(np.uint64)
        byte = np.unpackbits(np.arange(256, dtype=np.uint8)[:, None], axis=1, bitorder="little")
        table = padded[n].reshape(-1, 8) @ byte.T
        return cls(bits, table, float(weight[~inner].sum()))


@njit(cache=True)
def _weigh(word: np.uint64, w: int, table: np.ndarray) -> float:
    """Summed weight of the bits set in the w-th word."""
    total = 0.0
    for byte in range(8):
        total += table[8 * w + byte, np.int64((word >> np.uint64(8 * byte)) & np.uint64(255))]
    return total


@njit(cache=True)
def _join(a: np.ndarray, b: np.ndarray, out: np.ndarray) -> None:
    """Fitch's rule on (2, W) sets of states: what both allow, else what either allows."""
    for w in range(a.shape[1]):
        both0, both1 = a[0, w] & b[0, w], a[1, w] & b[1, w]
        neither = ~(both0 | both1)
        out[0, w] = both0 | (neither & (a[0, w] | b[0, w]))
        out[1, w] = both1 | (neither & (a[1, w] | b[1, w]))


@njit(cache=True)
def _fill_states(
    kids: np.ndarray, below: np.ndarray, above: np.ndarray, middle: np.ndarray, order: np.ndarray
) -> int:
    """Best states of every edge's lower side, upper side and middle, (2n-2, 2, W) each, leaves' ``below`` given."""
    count, top = postorder(kids, 0, order), kids[0, 0]
    for i in range(count):
        _join(below[kids[order[i], 0]], below[kids[order[i], 1]], below[order[i]])
    for w in range(below.shape[2]):
        above[top, 0, w], above[top, 1, w] = below[0, 0, w], below[0, 1, w]
    _join(below[top], above[top], middle[top])
    for i in range(count - 1, -1, -1):
        node = order[i]
        for side in range(2):
            a, b = kids[node, side], kids[node, 1 - side]
            _join(above[node], below[b], above[a])
            _join(below[a], above[a], middle[a])
    return count


@njit(cache=True)
def _price_leaf(leaf: np.ndarray, middle: np.ndarray, edges: np.ndarray, number: int, table: np.ndarray, cost: np.ndarray) -> float:
    """What a leaf (W,) costs on each of the first ``number`` edges, into ``cost``; returns the least of it."""
    least = np.inf
    for i in range(number):
        cost[i] = 0.0
        for w in range(leaf.size):
            cost[i] += _weigh((leaf[w] & ~middle[edges[i], 1, w]) | (~leaf[w] & ~middle[edges[i], 0, w]), w, table)
        least = min(least, cost[i])
    return least


@njit(cache=True)
def _shared_stretch(kids: np.ndarray, below: np.ndarray, order: np.ndarray, table: np.ndarray) -> float:
    """Weight of the changes on the edge at the root: how far all targets share the way. ``order`` is filled."""
    count, top, total = postorder(kids, 0, order), kids[0, 0], 0.0
    for i in range(count):
        _join(below[kids[order[i], 0]], below[kids[order[i], 1]], below[order[i]])
    for w in range(below.shape[2]):
        total += _weigh(~((below[0, 0, w] & below[top, 0, w]) | (below[0, 1, w] & below[top, 1, w])), w, table)
    return total


@njit(cache=True)
def _unseen(seen: np.ndarray, leaf: np.ndarray, table: np.ndarray) -> float:
    """Weight of the splits (W,) that have the seen leaves and one more on the source's side: each is still to be cut once."""
    total = 0.0
    for w in range(seen.size):
        total += _weigh(~(seen[w] | leaf[w]), w, table)
    return total


@njit(cache=True)
def _sort(keys: np.ndarray, names: np.ndarray, number: int) -> None:
    """Sort the first keys in place, names alike; equal keys keep their order."""
    for i in range(1, number):
        key, name, j = keys[i], names[i], i
        while j > 0 and keys[j - 1] > key:
            keys[j], names[j] = keys[j - 1], names[j - 1]
            j -= 1
        keys[j], names[j] = key, name


@njit(cache=True)
def _earlier(a: np.ndarray, b: np.ndarray, number: int) -> bool:
    """Whether a comes before b in the lexicographic order of their first numbers."""
    for i in range(number):
        if a[i] != b[i]:
            return a[i] < b[i]
    return False


@njit(cache=True)
def _branch_and_bound(
    bits: np.ndarray, table: np.ndarray, upper: float, slack: float, budget: int
) -> tuple[np.ndarray, np.ndarray, float, bool, bool]:
    """Depth-first search over all topologies of n leaves with splits ``bits`` (n, W).

    Args:
        upper: length of a known tree; nothing longer is kept.
        slack: trees that exceed the shortest by no more than this tie with it.
        budget: partial trees to look at. The last eighth of it is spent without the ties.

    Returns:
        parent and kids of the tree, the least length, whether any tree was found, and whether the search was complete.
    """
    n, words = bits.shape
    nodes = 2 * n - 2
    below, final = np.empty((nodes, 2, words), np.uint64), np.empty((nodes, 2, words), np.uint64)
    above, middle = np.empty((nodes, 2, words), np.uint64), np.empty((nodes, 2, words), np.uint64)
    for x in range(n):
        for w in range(words):
            below[x, 0, w] = final[x, 0, w] = ~bits[x, w]
            below[x, 1, w] = final[x, 1, w] = bits[x, w]
    order, edges, cost = np.empty(n, np.int64), np.empty(2 * n, np.int64), np.empty(2 * n)
    mask, code = np.empty(nodes, np.int64), np.empty(n, np.int64)
    # what is known at each depth, by the number of leaves in the tree
    parents, kids = np.empty((n + 1, nodes), np.int64), np.empty((n + 1, nodes, 2), np.int64)
    inside, seen = np.zeros((n + 1, n), np.bool_), np.zeros((n + 1, words), np.uint64)
    length, leaf = np.zeros(n + 1), np.zeros(n + 1, np.int64)
    edge, bound = np.empty((n + 1, 2 * n), np.int64), np.empty((n + 1, 2 * n))
    waiting, at = np.zeros(n + 1, np.int64), np.zeros(n + 1, np.int64)
    best_parent, best_kids = seed_tree(n, np.int64(1))
    best_code, best_stretch, found = np.zeros(n, np.int64), -1.0, False
    first, least_unseen = 1, np.inf
    for x in range(1, n):
        if _unseen(seen[0], bits[x], table) < least_unseen:
            first, least_unseen = x, _unseen(seen[0], bits[x], table)
    two_parent, two_kids = seed_tree(n, first)
    for node in range(nodes):
        parents[2, node], kids[2, node, 0], kids[2, node, 1] = two_parent[node], two_kids[node, 0], two_kids[node, 1]
    inside[2, 0] = inside[2, first] = True
    for w in range(words):
        seen[2, w] = bits[first, w]
    length[2] = _unseen(seen[0], seen[0], table) - least_unseen
    k, fresh, looked = 2, True, 0
    while k >= 2:
        if fresh:
            fresh, looked = False, looked + 1
            if looked > budget:
                return best_parent, best_kids, upper, found, False
            if looked == budget - budget // 8:
                slack = -slack
            _fill_states(kids[k], below, above, middle, order)
            number = 0
            for node in range(1, nodes):
                if parents[k, node] >= 0:
                    edges[number] = node
                    number += 1
            dearest, waiting[k], at[k] = -1.0, 0, 0
            for x in range(1, n):
                if inside[k, x] or dearest > upper + slack:
                    continue
                known = length[k] + _unseen(seen[k], bits[x], table)
                least = known + _price_leaf(bits[x], middle, edges, number, table, cost)
                if least > dearest:
                    dearest, leaf[k], waiting[k] = least, x, number
                    for i in range(number):
                        edge[k, i], bound[k, i] = edges[i], known + cost[i]
            _sort(bound[k], edge[k], waiting[k])
        if at[k] == waiting[k] or bound[k, at[k]] > upper + slack:
            k -= 1
            continue
        i, x = at[k], leaf[k]
        at[k] += 1
        for node in range(nodes):
            parents[k + 1, node], kids[k + 1, node, 0], kids[k + 1, node, 1] = parents[k, node], kids[k, node, 0], kids[k, node, 1]
        for y in range(n):
            inside[k + 1, y] = inside[k, y] or y == x
        for w in range(words):
            seen[k + 1, w] = seen[k, w] | bits[x, w]
        length[k + 1] = bound[k, i] - _unseen(seen[k + 1], bits[x], table)
        graft(parents[k + 1], kids[k + 1], x, n + k - 2, edge[k, i])
        if k + 1 < n:
            k, fresh = k + 1, True
            continue
        stretch = _shared_stretch(kids[n], final, order, table)
        clades(kids[n], n, order, n - 2, mask, code)
        shorter = not found or bound[k, i] < upper - abs(slack)
        tied = stretch > best_stretch + abs(slack) or (stretch > best_stretch - abs(slack) and _earlier(code, best_code, n - 2))
        upper = min(upper, bound[k, i])
        if shorter or tied:
            best_stretch, found = stretch, True
            for i in range(n - 2):
                best_code[i] = code[i]
            for node in range(nodes):
                best_parent[node], best_kids[node, 0], best_kids[node, 1] = parents[n, node], kids[n, node, 0], kids[n, node, 1]
    return best_parent, best_kids, upper, found, True


def shortest_l1(points: np.ndarray, effort: float = 1.0) -> tuple[np.ndarray, np.ndarray, float]:
    """The shortest tree over n distinct points (n, D), rooted at the first; ``effort`` scales what proof and search may cost.

    Among equally short trees it is the one that shares the first stretch longest, and among those the one whose topology comes
    first in lexicographic order: a choice that does not change while the first point moves along that stretch.

    Returns:
        (2n-2, D) nodes, the points first; (2n-2,) the node above each, -1 for the first; and a length that no tree undercuts.
    """
    n = len(points)
    if n < 3:
        return points, np.array([-1, 0][:n]), np.inf
    varied = np.ascontiguousarray(points[:, np.ptp(points, axis=0) > 0])
    parent, kids, length = np.empty(0), np.empty(0), np.inf
    if n > SEARCH_BEYOND:  # a short tree to start from; with fewer terminals the proof finds its own as fast
        trees = int(effort * SEARCH_WORK) // (2 * n * (varied.shape[1] + PER_EDGE))
        parent, kids, length = parsimony.search(varied, trees // 20 if n <= EXACT_BEYOND else trees, 0)
    if n > EXACT_BEYOND:
        return parsimony.embed(points, parent, kids), parent, tour_bound(points, "l1")
    splits = Splits.of(varied)
    budget = max(4 * n, int(effort * PROOF_WORK) // (2 * n * splits.bits.shape[1]))  # 4 n reach a whole tree
    slack = TIE * float(np.ptp(varied, axis=0).sum())  # of a length that no tree undercuts
    *proven, least, found, complete = _branch_and_bound(splits.bits, splits.table, length - splits.constant, slack, budget)
    if found:
        parent, kids = proven
    bound = least + splits.constant if complete else tour_bound(points, "l1")
    return parsimony.embed(points, parent, kids), parent, bound

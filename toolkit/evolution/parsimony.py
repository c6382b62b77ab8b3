"""L1 length of a topology by Wagner parsimony, and a local search for the topology where it is least.

The L1 length of a tree is a sum over dimensions, and in one dimension the best Steiner values follow from an interval pass up
and a clamping pass down (Farris, "Methods for computing Wagner trees", Systematic Zoology 1970). Passing intervals down as
well gives, for every edge, the interval of values that a node put onto it may take at no cost. Its gap to the interval of a
subtree is exactly what grafting that subtree there costs: the cost around the interval has slope 1, so no other place of the
joint is better. One up-and-down pass thus prices all places of a subtree.

The search is stepwise addition in random order, then subtree pruning and regrafting (SPR, of which nearest-neighbour interchange
is the shortest move) down to a local minimum, then Nixon's ratchet ("The parsimony ratchet", Cladistics 1999): double the weight
of some dimensions, walk downhill, restore the weights, walk downhill again.
"""

import numpy as np
from numba import njit

from toolkit.evolution.topology import graft, postorder, prune, reroot, seed_tree

FAST = {"nnan", "ninf", "nsz", "reassoc", "contract"}
"""Sums may be reordered, so that they use the processor's vectors; numbers are finite."""

RATCHET = 0.25
"""Share of dimensions whose weight a ratchet step doubles (Nixon 1999 takes 5 to 25 %)."""
PATIENCE = 12
"""Ratchet steps without gain before a new start from stepwise addition."""


@njit(cache=True, fastmath=FAST)
def join(low_a: np.ndarray, high_a: np.ndarray, low_b: np.ndarray, high_b: np.ndarray, low: np.ndarray, high: np.ndarray) -> float:
    """The values (D,) that are best between two intervals: where they meet, else the gap between them. Returns the gap's length."""
    gap = 0.0
    for d in range(low.size):
        inner, outer = max(low_a[d], low_b[d]), min(high_a[d], high_b[d])
        low[d], high[d] = min(inner, outer), max(inner, outer)
        gap += max(inner - outer, 0.0)
    return gap


@njit(cache=True, fastmath=FAST)
def gap_between(low_a: np.ndarray, high_a: np.ndarray, low_b: np.ndarray, high_b: np.ndarray) -> float:
    """L1 distance between two boxes (D,)."""
    gap = 0.0
    for d in range(low_a.size):
        gap += max(max(low_a[d], low_b[d]) - min(high_a[d], high_b[d]), 0.0)
    return gap


@njit(cache=True)
def _join_kids(kids: np.ndarray, node: int, below: np.ndarray) -> float:
    """Best values of a Steiner node from those of the two below it; returns what it adds to the length."""
    a, b = kids[node, 0], kids[node, 1]
    return join(below[a, 0], below[a, 1], below[b, 0], below[b, 1], below[node, 0], below[node, 1])


@njit(cache=True)
def price_edges(
    kids: np.ndarray, root: int | np.integer, below: np.ndarray, above: np.ndarray, middle: np.ndarray, order: np.ndarray
) -> int:
    """Best values of every edge's lower side, upper side and middle: (2n-2, 2, D) low and high, leaves' ``below`` given.

    Returns:
        how many Steiner nodes hang below the root; their postorder is in ``order``.
    """
    count, top = postorder(kids, root, order), kids[root, 0]
    for i in range(count):
        _join_kids(kids, order[i], below)
    for d in range(below.shape[2]):
        above[top, 0, d], above[top, 1, d] = below[root, 0, d], below[root, 1, d]
    join(below[top, 0], below[top, 1], above[top, 0], above[top, 1], middle[top, 0], middle[top, 1])
    for i in range(count - 1, -1, -1):
        node = order[i]
        for side in range(2):
            a, b = kids[node, side], kids[node, 1 - side]
            join(above[node, 0], above[node, 1], below[b, 0], below[b, 1], above[a, 0], above[a, 1])
            join(below[a, 0], below[a, 1], above[a, 0], above[a, 1], middle[a, 0], middle[a, 1])
    return count


@njit(cache=True)
def cheapest_edge(
    kids: np.ndarray, root: int | np.integer, count: int, order: np.ndarray, middle: np.ndarray, low: np.ndarray, high: np.ndarray
) -> tuple[int, float]:
    """The edge of the tree below ``root`` onto which a subtree with best values [low, high] (D,) is grafted at the least cost."""
    best = kids[root, 0]
    least = gap_between(low, high, middle[best, 0], middle[best, 1])
    for i in range(count):
        for side in range(2):
            edge = kids[order[i], side]
            cost = gap_between(low, high, middle[edge, 0], middle[edge, 1])
            if cost < least:
                best, least = edge, cost
    return best, least


@njit(cache=True)
def _workspace(points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """below, above, middle and order for trees over points (n, D), with the leaves' values in place."""
    n, d = points.shape
    below, above, middle = np.empty((2 * n - 2, 2, d)), np.empty((2 * n - 2, 2, d)), np.empty((2 * n - 2, 2, d))
    for leaf in range(n):
        for i in range(d):
            below[leaf, 0, i] = below[leaf, 1, i] = points[leaf, i]
    return below, above, middle, np.empty(n, np.int64)


@njit(cache=True)
def stepwise_addition(points: np.ndarray, leaves: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A tree over points (n, D), rooted at 0, that takes the leaves in the given order (n-1,), each where it costs least."""
    n = len(points)
    parent, kids = seed_tree(n, leaves[0])
    below, above, middle, order = _workspace(points)
    root = np.int64(0)  # a literal 0 would be compiled anew
    for i in range(1, n - 1):
        count, leaf = price_edges(kids, root, below, above, middle, order), leaves[i]
        edge, _ = cheapest_edge(kids, root, count, order, middle, below[leaf, 0], below[leaf, 1])
        graft(parent, kids, leaf, n + i - 1, edge)
    return parent, kids


@njit(cache=True)
def descend(points: np.ndarray, parent: np.ndarray, kids: np.ndarray, root: int) -> int:
    """Move subtrees, each to where it costs least, until no move shortens the tree over points (n, D), hung from leaf ``root``.

    Returns:
        how many trees were priced.
    """
    nodes = len(parent)
    below, above, middle, order = _workspace(points)
    price_edges(kids, root, below, above, middle, order)
    quiet, node, priced = 0, root, 0
    while quiet < nodes:
        node, quiet = (node + 1) % nodes, quiet + 1
        if node == root or parent[node] == root:
            continue
        hub, place = parent[node], prune(parent, kids, node)
        count, priced = price_edges(kids, root, below, above, middle, order), priced + 1
        now = gap_between(below[node, 0], below[node, 1], middle[place, 0], middle[place, 1])
        edge, least = cheapest_edge(kids, root, count, order, middle, below[node, 0], below[node, 1])
        if least < now * (1 - 1e-9) - 1e-12:
            place, quiet = edge, 0
        graft(parent, kids, node, hub, place)
        while kids[hub, 1] >= 0:  # what hangs below the next nodes is read before they are pruned
            _join_kids(kids, hub, below)
            hub = parent[hub]
    return priced


def search(points: np.ndarray, trees: int, seed: int) -> tuple[np.ndarray, np.ndarray, float]:
    """The shortest tree that a ratchet finds.

    Args:
        points: (n, D), n at least 4; the source is the first.
        trees: how many trees may be priced, after the first descent.
        seed: of orders, roots and weights. Same seed, same tree.

    Returns:
        parent, kids and length of the best tree, rooted at leaf 0.
    """
    n, d = points.shape
    rng = np.random.default_rng(seed)
    current = stepwise_addition(points, 1 + rng.permutation(n - 1))
    descend(points, *current, 0)
    length = best = tree_length(points, *current)
    answer, idle, priced = current, 0, 0
    while priced < trees:
        if idle < PATIENCE:
            parent, kids = current[0].copy(), current[1].copy()
            priced += descend(points * np.where(rng.random(d) < RATCHET, 2.0, 1.0), parent, kids, 0)
        else:
            parent, kids = stepwise_addition(points, 1 + rng.permutation(n - 1))
            priced, length, idle = priced + n, np.inf, 0
        root = int(rng.integers(n))  # a subtree is pruned below an edge: another root prunes its other side
        reroot(parent, kids, 0, root)
        priced += descend(points, parent, kids, root)
        reroot(parent, kids, root, 0)
        found = tree_length(points, parent, kids)
        idle = 0 if found < length * (1 - 1e-12) else idle + 1
        if found <= length:
            current, length = (parent, kids), found
        if found < best * (1 - 1e-12):
            answer, best = (parent, kids), found
    return *answer, best


def tree_length(points: np.ndarray, parent: np.ndarray, kids: np.ndarray) -> float:
    """L1 length of a topology rooted at leaf 0 over points (n, D)."""
    return float(np.abs(np.diff(embed(points, parent, kids)[edge_ends(parent)], axis=1)).sum())


def edge_ends(parent: np.ndarray) -> np.ndarray:
    """(2n-3, 2) lower and upper node of every edge of a complete tree."""
    return np.stack([np.arange(1, len(parent)), parent[1:]], axis=1)


def embed(points: np.ndarray, parent: np.ndarray, kids: np.ndarray) -> np.ndarray:
    """Best places (2n-2, D) of all nodes of a tree over points (n, D) rooted at leaf 0.

    Where several values are equally good, a node takes the one nearest to its parent's: less of the robot has to change.
    """
    below, _, _, order = _workspace(points)
    order = order[: postorder(kids, 0, order)]
    for node in order:
        _join_kids(kids, node, below)
    places = below[:, 0].copy()
    for node in order[::-1]:
        places[node] = np.clip(places[parent[node]], below[node, 0], below[node, 1])
    return places

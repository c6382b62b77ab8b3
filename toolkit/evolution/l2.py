"""The shortest L2 tree: Smith's search over topologies, exact with proof up to 7 terminals; local search beyond.

Smith ("How to find Steiner minimal trees in Euclidean d-space", Algorithmica 1992) grows trees leaf by leaf. The optimum of a partial
tree bounds all trees grown from it, since taking a leaf away never lengthens a tree; `smith` stops as soon as its dual bound
exceeds the shortest tree known.
"""

import numpy as np

from toolkit.evolution import parsimony
from toolkit.evolution.bounds import tour_bound
from toolkit.evolution.geometry import TIE, distances, extent
from toolkit.evolution.smith import polish, smith
from toolkit.evolution.topology import graft, prune

EXACT_UP_TO = 7
"""With more terminals no proof is attempted: in many dimensions the bound of a partial tree cuts little."""
ROUGH, FINE = 25, 200
"""Smith sweeps for a partial tree, and for a complete one that may be shortest."""
NEAREST = 6
"""Edges near a cut-off subtree that the local search tries."""
SEARCH_WORK = 15_000_000
"""Smith sweeps, times nodes, times dimensions, that the local search may take."""
FINALISTS = 100
"""Complete trees that are solved to the last digit."""

Tree = tuple[np.ndarray, np.ndarray, np.ndarray]
"""places (2n-2, d), parent, kids of a tree rooted at leaf 0."""


def shortest_l2(points: np.ndarray, effort: float = 1.0) -> tuple[np.ndarray, np.ndarray, float]:
    """The shortest tree over n distinct points (n, D), rooted at the first; ``effort`` scales what the local search may cost.

    Returns:
        (2n-2, D) nodes, the points first; (2n-2,) the node above each, -1 for the first; and a length that no tree undercuts.
    """
    n = len(points)
    if n < 3:
        return points, np.array([-1, 0][:n]), np.inf
    origin, scale = points[0], extent(points)
    flat, axes = _flatten((points - origin) / scale)
    upper, found = np.inf, []
    if n > 3:
        found.append(_local_search(flat, effort if n > EXACT_UP_TO else 0.0))
        upper = _length(found[0])
    complete = n <= EXACT_UP_TO
    bound = np.inf
    if complete:
        grown, bound = _grow_all(flat, upper)
        found = grown or found
    best, proven = _finish(found, upper)
    lower = min(bound, proven) * scale if complete else 0.0
    places, parent, _ = best
    return origin + scale * (places @ axes), parent, max(lower, tour_bound(points, "l2"))


def _flatten(offsets: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Points (n, D) in their own span (n, d), d at most n - 1, and its axes (d, D)."""
    _, size, axes = np.linalg.svd(offsets, full_matrices=False)
    axes = axes[: max(1, int((size > 1e-14 * size.max(initial=0.0)).sum()))]
    return np.ascontiguousarray(offsets @ axes.T), axes


def _length(tree: Tree) -> float:
    places, parent, _ = tree
    ends = parsimony.edge_ends(parent)
    ends = ends[ends[:, 1] >= 0]
    return float(np.linalg.norm(places[ends[:, 0]] - places[ends[:, 1]], axis=1).sum())


# ---- all topologies -----------------------------------------------------------------------------------------------------


def _insertion_order(points: np.ndarray) -> list[int]:
    """The leaf farthest from the targets' mean, then always the one farthest from those chosen: far points first make bounds tight.

    The order depends on the targets alone, so that ties between trees are broken alike at every step of a walk to a meta robot.
    """
    gaps = distances(points, points, "l2")
    centre = points[1:].mean(axis=0, keepdims=True)
    order = [1 + int(distances(points[1:], centre, "l2").argmax())]
    while len(order) < len(points) - 1:
        nearest = gaps[order].min(axis=0)
        nearest[[0, *order]] = -1
        order.append(int(nearest.argmax()))
    return order


def _seed(points: np.ndarray, leaf: int) -> Tree:
    n, d = points.shape
    parent, kids = np.full(2 * n - 2, -1), np.full((2 * n - 2, 2), -1)
    parent[leaf], kids[0, 0] = 0, leaf
    return np.vstack([points, np.zeros((n - 2, d))]), parent, kids


def _insert(tree: Tree, leaf: int, hub: int, edge: int) -> Tree:
    """A copy with a leaf hung onto an edge; the new Steiner point starts between the three."""
    places, parent, kids = (array.copy() for array in tree)
    places[hub] = (places[edge] + places[parent[edge]] + places[leaf]) / 3
    graft(parent, kids, leaf, hub, edge)
    return places, parent, kids


def _grow_all(points: np.ndarray, upper: float) -> tuple[list[Tree], float]:
    """All complete trees that may be shortest, and a length that no other tree undercuts (depth first, most promising first)."""
    n = len(points)
    order = _insertion_order(points)
    waiting = [(0.0, 1, _seed(points, order[0]))]
    complete: list[tuple[float, Tree]] = []
    while waiting:
        lower, leaves, tree = waiting.pop()
        if lower > upper * (1 + TIE):
            continue
        if leaves == n - 1:
            complete.append((lower, tree))
            continue
        grown = []
        for edge in np.flatnonzero(tree[1] >= 0):
            child = _insert(tree, order[leaves], n + leaves - 1, int(edge))
            last = leaves == n - 2
            low, high = smith(*child, 0, FINE if last else ROUGH, upper * (1 + TIE), 1e-9 if last else 1e-3)
            upper = min(upper, high) if last else upper
            grown.append((low, leaves + 1, child))
        waiting += sorted(grown, key=lambda entry: -entry[0])
    kept = [(low, tree) for low, tree in complete if low <= upper * (1 + TIE)]
    kept.sort(key=lambda entry: entry[0])
    dropped = kept[FINALISTS][0] if len(kept) > FINALISTS else np.inf
    return [tree for _, tree in kept[:FINALISTS]], min(upper, dropped)


def _finish(trees: list[Tree], upper: float) -> tuple[Tree, float]:
    """The shortest of complete trees, solved to the last digit, and a length that no tree of their topologies undercuts."""
    lengths, lowers = [], []
    for places, parent, kids in trees:
        polish(places, parent, kids)
        lengths.append(_length((places, parent, kids)))
        # the spring forces at the optimum are the dual solution; on a copy, for a sweep moves the points
        lowers.append(smith(places.copy(), parent, kids, 0, 2, np.inf, 0.0)[0])
    least = min(lengths)
    tied = [tree for tree, length in zip(trees, lengths, strict=True) if length <= least * (1 + 10 * TIE)]
    shared = [np.linalg.norm(places[kids[0, 0]] - places[0]) for places, _, kids in tied]
    best = tied[int(np.argmax(np.array(shared) >= max(shared) - 1e-6))]
    return best, min(min(lowers), upper)


# ---- local search -------------------------------------------------------------------------------------------------------


def _local_search(points: np.ndarray, effort: float) -> Tree:
    """A short tree: from the L1 search's topology, move subtrees to near edges until nothing is gained; then kick, and again.

    Without effort there is one descent and no kick.
    """
    n, d = points.shape
    rng = np.random.default_rng(0)
    parent, kids, _ = parsimony.search(points, 20 * n, 0)
    tree = np.vstack([points, parsimony.embed(points, parent, kids)[n:] + 1e-3 * rng.standard_normal((n - 2, d))]), parent, kids
    best, length, used = _descend(tree)
    left = int(effort * SEARCH_WORK) // (ROUGH * 2 * n * d + 10_000) - used
    while left > 0:
        kicked = _random_move(_random_move(best, rng), rng)
        tree, found, used = _descend(kicked)
        left -= used
        if found < length * (1 - 1e-9):
            best, length = tree, found
    return best


def _move(tree: Tree, node: int, edge: int) -> Tree:
    """A copy with the subtree below ``node`` on another edge."""
    places, parent, kids = (array.copy() for array in tree)
    hub = parent[node]
    prune(parent, kids, node)
    places[hub] = (places[edge] + places[parent[edge]] + places[node]) / 3
    graft(parent, kids, node, hub, edge)
    return places, parent, kids


def _places_for(tree: Tree, node: int) -> np.ndarray:
    """Edges onto which the subtree below ``node`` can move, nearest first."""
    places, parent, kids = tree
    inside = np.zeros(len(parent), bool)
    stack = [node]
    while stack:
        here = stack.pop()
        inside[here] = True
        stack += [kid for kid in kids[here] if kid >= 0]
    hub = parent[node]
    sibling = kids[hub].sum() - node
    inside[[hub, sibling, 0]] = True
    edges = np.flatnonzero(~inside)
    # distance from the subtree's top to the edge as a segment
    ends = places[np.where(parent[edges] == hub, parent[hub], parent[edges])] if len(edges) else places[:0]
    along = ends - places[edges]
    share = ((places[node] - places[edges]) * along).sum(axis=1) / np.maximum((along**2).sum(axis=1), 1e-300)
    away = places[edges] + np.clip(share, 0, 1)[:, None] * along - places[node]
    return edges[np.argsort((away**2).sum(axis=1), kind="stable")]


def _descend(tree: Tree) -> tuple[Tree, float, int]:
    """Move subtrees while that shortens the tree; also its length, and how many trees were solved."""
    n = len(tree[0]) // 2 + 1
    _, length = smith(*tree, 0, FINE, np.inf, 1e-6)
    node, quiet, used = 0, 0, 1
    while quiet < 2 * n - 2:
        node, quiet = (node + 1) % (2 * n - 2), quiet + 1
        if tree[1][node] <= 0:  # the root, and the node below it
            continue
        for edge in _places_for(tree, node)[:NEAREST]:
            moved = _move(tree, node, int(edge))
            _, found = smith(*moved, 0, ROUGH, length, 1e-6)
            used += 1
            if found < length * (1 - 1e-7):
                tree, length, quiet = moved, found, 0
                break
    return tree, length, used


def _random_move(tree: Tree, rng: np.random.Generator) -> Tree:
    nodes = np.flatnonzero(tree[1] > 0)
    node = int(rng.choice(nodes))
    edges = _places_for(tree, node)
    return _move(tree, node, int(rng.choice(edges[:NEAREST]))) if len(edges) else tree

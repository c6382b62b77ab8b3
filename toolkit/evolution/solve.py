"""The evolution tree of a source and its targets: the choice of solver, and from its arrays to the record."""

import itertools
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from toolkit.errors import ToolkitError
from toolkit.evolution.geometry import distances, distinct_points, extent
from toolkit.evolution.l1 import shortest_l1
from toolkit.evolution.l2 import shortest_l2
from toolkit.evolution.median import median_l1, median_l2
from toolkit.evolution.points import load_points, read_points
from toolkit.evolution.tree import Edge, EvolutionTree, Kind, Metric, Node, Terminal, check_terminals, checked_vector

PROOF = 1e-8
"""A lower bound this close to the length, relatively, proves the tree."""
MERGE = {"l1": 1e-10, "l2": 1e-6}
"""Edges shorter than this fraction of the extent have zero length."""


def evolution_tree(
    source: Terminal, targets: Sequence[Terminal], metric: Metric = "l1", kind: Kind = "steiner", effort: float = 1.0
) -> EvolutionTree:
    """The tree that joins the source with all targets at the least total distance (eq. evolve:tree:init).

    Args:
        source: the robot to start from, alpha (D,).
        targets: the robots to reach, alpha (D,) each; none gives a tree of one node.
        metric: "l1" or "l2".
        kind: "steiner" is the shortest tree of all. Exact with proof up to 10 terminals in L1 (branch and bound
            over topologies; up to 12 where the bound allows) and 7 in L2 (Smith, "How to find Steiner minimal trees
            in Euclidean d-space", 1992); beyond, local search, and a lower bound. "geometric-median" has one meta
            robot, the point of least summed distance to source and targets. "independent" has none. The last two
            are always optimal of their kind.
        effort: how much search and proof may cost, in multiples of what suits a replan at every phase.

    Among equally short trees the one that shares the first stretch longest is taken, and a meta robot keeps its
    parent's value wherever several are equally good, so that less of the robot has to change.

    Raises:
        ToolkitError: unknown metric or kind, unequal D, a name used twice, or an effort not above 0.
    """
    check_terminals(source, targets, metric, kind)
    if not 0 < effort < np.inf:
        raise ToolkitError(f"The effort is {effort}; give a positive number.")
    terminals = (source, *targets)
    points = np.array([terminal.alpha for terminal in terminals])
    if kind == "independent" or len(terminals) <= 2:
        return _finish(terminals, points, [-1] + [0] * len(targets), metric, kind)
    if kind == "geometric-median":
        return _median_tree(terminals, points, metric)
    distinct, twin = distinct_points(points)
    solve = shortest_l1 if metric == "l1" else shortest_l2
    embedding, parent, bound = solve(points[distinct], effort)
    nodes, parents = _give_back_duplicates(points, distinct, twin, embedding, parent)
    return _finish(terminals, nodes, parents, metric, kind, bound)


def tree_from_points(
    points: Mapping[str, Any] | str | Path, metric: Metric = "l1", kind: Kind = "steiner"
) -> EvolutionTree:
    """`evolution_tree` of a points file, or of its content as a dictionary (see `load_points`).

    Raises:
        ToolkitError: as `load_points` and `evolution_tree`.
    """
    source, targets = load_points(points) if isinstance(points, (str, Path)) else read_points(points, "The input")
    return evolution_tree(source, targets, metric, kind)


# ---- from arrays to a tree ----------------------------------------------------------------------------------------------


def _give_back_duplicates(
    points: np.ndarray, distinct: Sequence[int], twin: Sequence[int], embedding: np.ndarray, parent: Sequence[int] | np.ndarray
) -> tuple[np.ndarray, list[int]]:
    """Number the tree over distinct points as all terminals, then meta robots; a duplicate hangs on its twin."""
    n, k = len(points), len(distinct)
    new = [*distinct, *range(n, n + len(embedding) - k)]
    parents = [*twin, *([-1] * (len(embedding) - k))]
    for old, above in enumerate(parent):
        parents[new[old]] = -1 if above < 0 else new[above]
    return np.concatenate([points, embedding[k:]]), parents


def _merge(points: np.ndarray, parents: Sequence[int], n: int, tolerance: float) -> dict[int, set[int]]:
    """Neighbours of every node, after each meta robot (index >= n) that coincides with a neighbour became it."""
    neighbours: dict[int, set[int]] = {index: set() for index in range(len(points))}
    for index, above in enumerate(parents):
        if above >= 0:
            neighbours[index].add(above)
            neighbours[above].add(index)
    for meta in range(len(points) - 1, n - 1, -1):
        gaps = {other: np.abs(points[meta] - points[other]).sum() for other in sorted(neighbours[meta])}
        twin = min(gaps, key=lambda other: gaps[other])  # the lowest index among equals: a terminal comes first
        if gaps[twin] <= tolerance:
            for other in neighbours.pop(meta):
                neighbours[other].discard(meta)
                if other != twin:
                    neighbours[other].add(twin)
                    neighbours[twin].add(other)
    return neighbours


def _names(taken: set[str]) -> Iterable[str]:
    """meta-1, meta-2 and so on, passing over the robots' own names."""
    return (name for name in (f"meta-{i}" for i in itertools.count(1)) if name not in taken)


def _finish(
    terminals: Sequence[Terminal],
    points: np.ndarray,
    parents: Sequence[int],
    metric: Metric,
    kind: Kind,
    bound: float = np.inf,
) -> EvolutionTree:
    """Merge zero-length edges, order everything from the source, and name the meta robots.

    Args:
        points: (n + m, D) the n terminals, then the meta robots.
        parents: index of the node above each, -1 for the source.
        bound: no tree of this kind is shorter; infinite if there is only one tree of this kind.
    """
    n = len(terminals)
    neighbours = _merge(points, parents, n, MERGE[metric] * extent(points))
    order, above = [0], {0: -1}
    for index in order:
        for other in sorted(neighbours[index] - {above[index]}):
            above[other] = index
            order.append(other)
    metas = [index for index in order if index >= n]
    place = {index: i for i, index in enumerate([*range(n), *metas])}
    nodes = [Node(t.name, "target" if i else "source", t.alpha) for i, t in enumerate(terminals)]
    for index, name in zip(metas, _names({t.name for t in terminals}), strict=False):
        nodes.append(Node(name, "meta", checked_vector(name, points[index])))
    edges = []
    for index in order[1:]:
        start, end = place[above[index]], place[index]
        length = distances(nodes[start].alpha[None], nodes[end].alpha[None], metric)[0, 0]
        edges.append(Edge(start, end, float(length)))
    total = sum(edge.length for edge in edges)
    optimal = total - bound <= PROOF * total
    return EvolutionTree(metric, kind, tuple(nodes), tuple(edges), bool(optimal), float(min(bound, total)))


def _median_tree(terminals: Sequence[Terminal], points: np.ndarray, metric: Metric) -> EvolutionTree:
    """One meta robot at the geometric median of source and targets (section "Baselines" of the paper)."""
    median = median_l1(points) if metric == "l1" else median_l2(points)
    n = len(points)
    return _finish(terminals, np.vstack([points, median]), [n] * n + [-1], metric, "geometric-median")

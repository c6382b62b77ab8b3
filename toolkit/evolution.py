"""Where to go: the shortest tree from the current robot to all targets, and the next meta robot on it.

Geometry only. A robot is a point alpha in [0, 1]^D; the cost of moving a policy between two robots is taken
as their L1 or L2 distance (Meta-Evolve, section "Evolution Tree Determination"). `evolution_tree` finds the
tree, `next_meta_robot` is Algorithm 2 of the paper, `tree_from_points` reads a file, `plot_tree` draws.

The L1 search rests on two facts about a tree whose topology is fixed:

1. Its L1 length is a sum over dimensions, and in one dimension the best Steiner values follow from an interval
   pass up and a clamping pass down (Wagner parsimony: Farris, "Methods for computing Wagner trees", 1970).
2. In one dimension, n sorted values are n - 1 gaps; each gap splits the terminals in two, and the best values
   cut a gap as often as Fitch's parsimony (1971) changes state on that split. Many dimensions thus collapse
   onto at most 2^(n-1) - 1 weighted splits, of which 64 fit in one machine word: D hardly matters.
"""

from __future__ import annotations

import itertools
import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from scipy.spatial.distance import cdist

from toolkit.errors import ToolkitError

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Metric = Literal["l1", "l2"]
Kind = Literal["steiner", "geometric-median", "independent"]

METRICS: tuple[Metric, ...] = ("l1", "l2")
KINDS: tuple[Kind, ...] = ("steiner", "geometric-median", "independent")

ARRIVED = 1e-9
"""Default Euclidean distance under which the current robot counts as being at a node [alpha]."""

MAX_TERMINALS = 60
"""A split is stored as one 64-bit integer. The paper expects fewer than 20 robots."""

# All partial trees are kept up to these many terminals (10395 and 105 of them before the last insertion),
# so the search is exhaustive; with more, only the most promising ones are, and `optimal` says what came of it.
_EXHAUSTIVE = {"l1": 9, "l2": 7}
_EVERYTHING = 1_000_000
_L1_WORDS = 400_000  # beam size beyond that: 64-bit words in one level of the search
_L1_PIECE = 100_000  # words worked on at once: what stays in a core's cache
_L2_BEAM = 4000  # beam size beyond that: times n^2, since larger trees take longer to solve
_L2_ROUNDS = 5  # of 40 sweeps each, before the survivors are solved to the last digit
_L2_FINALISTS = 100
_STIFFEST = 1e-10  # springs shorter than this fraction of the extent get no stiffer, so that forces keep six digits

_TIE = 1e-10  # trees whose lengths differ by less than this fraction are equally short
_PROOF = 1e-8  # a lower bound this close to the length, relatively, proves the tree
_MERGE = {"l1": 1e-10, "l2": 1e-6}  # edges shorter than this fraction of the extent have zero length


# ---------------------------------------------------------------------------------------------- records


@dataclass(frozen=True, eq=False)
class Terminal:
    """A robot that the tree must reach: the source (or the current robot), or a target.

    Args:
        name: unique name, shown in reports.
        alpha: (D,) evolution parameters [fraction of each range].

    Raises:
        ToolkitError: the name is empty, or alpha is not a finite vector.
    """

    name: str
    alpha: np.ndarray

    def __post_init__(self) -> None:
        if not isinstance(self.name, str) or not self.name:
            raise ToolkitError(f"A robot's name is {self.name!r}; give it a non-empty text.")
        object.__setattr__(self, "alpha", _vector(self.name, self.alpha))


@dataclass(frozen=True, eq=False)
class Node:
    """A robot in the tree: `kind` is "source", "target" or "meta"; alpha has shape (D,)."""

    name: str
    kind: Literal["source", "meta", "target"]
    alpha: np.ndarray


@dataclass(frozen=True)
class Edge:
    """A stretch of evolution, away from the source: indices of two nodes, and their distance [alpha]."""

    start: int
    end: int
    length: float


@dataclass(frozen=True, eq=False)
class MetaStep:
    """What Algorithm 2 returns: where to go now, and which targets share the way.

    Attributes:
        meta_name: the node's name: a meta robot, a target, or the current robot if the paths split here.
        meta_alpha: (D,) the temporary meta robot.
        partition: disjoint sets of target names; one set while the way is shared, one per subtree after it.
            Together with `reached` they are all targets.
        reached: targets that the current robot already is; nothing is left to do for them.
    """

    meta_name: str
    meta_alpha: np.ndarray
    partition: tuple[frozenset[str], ...]
    reached: frozenset[str]

    @property
    def splits(self) -> bool:
        """Whether the paths separate at the current robot."""
        return len(self.partition) > 1


@dataclass(frozen=True, eq=False)
class EvolutionTree:
    """A tree that joins the source with every target.

    Node 0 is the source, then come the targets in the order given, then the meta robots. Every robot has its
    own node, also where two coincide (an edge of length zero joins them); meta robots coincide with no other
    node. Targets may lie on the way to others, and several edges may leave the source.

    Attributes:
        metric: "l1" (eq. l1:diff of the paper) or "l2" (eq. l2:diff).
        kind: "steiner", "geometric-median" (one meta robot) or "independent" (one path per target).
        nodes: see above.
        edges: directed away from the source, parents first.
        optimal: proven to be the shortest tree of its kind, to a relative 1e-8.
        lower_bound: no tree of this kind is shorter [alpha].
    """

    metric: Metric
    kind: Kind
    nodes: tuple[Node, ...]
    edges: tuple[Edge, ...]
    optimal: bool
    lower_bound: float

    @cached_property
    def length(self) -> float:
        """Sum of all edges [alpha]."""
        return float(sum(edge.length for edge in self.edges))

    @cached_property
    def independent_length(self) -> float:
        """What one path per target would cost: the sum of the distances from the source [alpha]."""
        source = self.nodes[0].alpha[None]
        targets = [node.alpha for node in self.nodes if node.kind == "target"]
        return float(_distances(source, np.array(targets), self.metric).sum()) if targets else 0.0

    @property
    def ratio(self) -> float:
        """How many times shorter the tree is than independent paths; 1 if there is no way to go at all."""
        return self.independent_length / self.length if self.length > 0 else 1.0

    def next_meta(self, arrived: float = ARRIVED) -> MetaStep:
        """The first step on this tree, with its source as the current robot: see `next_meta_robot`."""
        children: dict[int, list[int]] = {index: [] for index in range(len(self.nodes))}
        for edge in self.edges:
            children[edge.start].append(edge.end)
        here = self.nodes[0]
        reached: set[str] = set()
        neighbours, queue = [], list(children[0])
        while queue:
            index = queue.pop(0)
            node = self.nodes[index]
            if np.linalg.norm(node.alpha - here.alpha) > arrived:
                neighbours.append(index)
                continue
            queue.extend(children[index])  # standing on this node: its neighbours are the current robot's
            reached |= {node.name} if node.kind == "target" else set()
        parts = tuple(self._targets_below(index, children) - reached for index in neighbours)
        meta = self.nodes[neighbours[0]] if len(neighbours) == 1 else here
        return MetaStep(meta.name, meta.alpha, tuple(part for part in parts if part), frozenset(reached))

    def _targets_below(self, index: int, children: Mapping[int, Sequence[int]]) -> frozenset[str]:
        own = {self.nodes[index].name} if self.nodes[index].kind == "target" else set()
        return frozenset(own).union(*(self._targets_below(child, children) for child in children[index]))

    def to_json(self) -> dict[str, Any]:
        """The tree as plain numbers and text, ready for `json.dumps`: the contract of `meta-evolve tree --json`."""
        return {
            "metric": self.metric,
            "kind": self.kind,
            "length": self.length,
            "optimal": self.optimal,
            "lower_bound": self.lower_bound,
            "nodes": [{"name": n.name, "kind": n.kind, "alpha": n.alpha.tolist()} for n in self.nodes],
            "edges": [
                {"from": self.nodes[e.start].name, "to": self.nodes[e.end].name, "length": e.length}
                for e in self.edges
            ],
        }


# ----------------------------------------------------------------------------------------------- verbs


def evolution_tree(
    source: Terminal, targets: Sequence[Terminal], metric: Metric = "l1", kind: Kind = "steiner"
) -> EvolutionTree:
    """The tree that joins the source with all targets at the least total distance (eq. evolve:tree:init).

    Args:
        source: the robot to start from, alpha (D,).
        targets: the robots to reach, alpha (D,) each; none gives a tree of one node.
        metric: "l1" or "l2".
        kind: "steiner" is the shortest tree of all. Exact with proof up to 9 terminals in L1 (branch and bound
            over topologies) and 7 in L2 (Smith, "How to find Steiner minimal trees in Euclidean d-space",
            1992); beyond, beam search, and `optimal` is true only if the bound happens to meet the length.
            "geometric-median" has one meta robot, the point of least summed distance to source and targets.
            "independent" has none. The last two are always optimal of their kind.

    Among equally short trees the one that shares the first stretch longest is taken, and a meta robot keeps its
    parent's value wherever several are equally good, so that less of the robot has to change.

    Raises:
        ToolkitError: unknown metric or kind, unequal D, or a name used twice.
    """
    _check(source, targets, metric, kind)
    terminals = (source, *targets)
    points = np.array([terminal.alpha for terminal in terminals])
    if kind == "independent" or len(terminals) <= 2:
        return _finish(terminals, points, [-1] + [0] * len(targets), metric, kind)
    if kind == "geometric-median":
        return _median_tree(terminals, points, metric)
    distinct, twin = _distinct(points)
    solve = _shortest_l1 if metric == "l1" else _shortest_l2
    embedding, parent, bound = solve(points[distinct])
    nodes, parents = _give_back_duplicates(points, distinct, twin, embedding, parent)
    return _finish(terminals, nodes, parents, metric, kind, bound)


def next_meta_robot(
    current: Terminal,
    targets: Sequence[Terminal],
    metric: Metric = "l1",
    kind: Kind = "steiner",
    arrived: float = ARRIVED,
) -> MetaStep:
    """Algorithm 2: rebuild the tree from the current robot, and say where to go next (eq. evolve:tree).

    If the current robot has one neighbour, that is the meta robot and the partition has one part: all targets.
    If it has several, the meta robot is the current robot itself, and each part is the targets of one subtree.
    Targets where the current robot already stands are `reached`, and no part holds them.

    For L1 the first meta robot lies beyond clamp(alpha; beta_L, beta_U) of eq. tmp:meta:robot, and going through
    that point costs nothing. Moving along the way to the meta robot leaves meta robot and partition as they
    are: a tree's length changes at most by the distance moved, so the tree in use stays among the shortest, and
    no other one of those shares a longer first stretch.

    Args:
        current: the robot now, alpha (D,).
        targets: robots yet to be reached, alpha (D,) each.
        metric, kind: as in `evolution_tree`.
        arrived: Euclidean distance under which the current robot counts as being at a node [alpha]; pass the
            step size xi of Algorithm 1, whose loop ends at that distance, so that the next call splits.

    Raises:
        ToolkitError: as `evolution_tree`.
    """
    _check(current, targets, metric, kind)
    away = [t for t in targets if np.linalg.norm(t.alpha - current.alpha) > arrived]
    step = evolution_tree(current, away, metric, kind).next_meta(arrived)
    reached = frozenset(t.name for t in targets) - frozenset(t.name for t in away)
    return MetaStep(step.meta_name, step.meta_alpha, step.partition, reached | step.reached)


def load_points(path: str | Path) -> tuple[Terminal, tuple[Terminal, ...]]:
    """Read source and targets from a JSON file.

    The file holds {"source": {"name": str, "alpha": [D floats]}, "targets": [{"name": ..., "alpha": ...}, ...]}
    with every alpha in [0, 1].

    Raises:
        ToolkitError: the file cannot be read, is not JSON, or breaks the form above.
    """
    path = Path(path)
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ToolkitError(f"{path} cannot be read ({error.strerror}); check the path.") from error
    except (UnicodeDecodeError, json.JSONDecodeError, RecursionError) as error:
        raise ToolkitError(f"{path} is not JSON ({error}); write source and targets as one JSON object.") from error
    return _read_points(content, str(path))


def tree_from_points(
    points: Mapping[str, Any] | str | Path, metric: Metric = "l1", kind: Kind = "steiner"
) -> EvolutionTree:
    """`evolution_tree` of a points file, or of its content as a dictionary (see `load_points`).

    Raises:
        ToolkitError: as `load_points` and `evolution_tree`.
    """
    source, targets = load_points(points) if isinstance(points, (str, Path)) else _read_points(points, "The input")
    return evolution_tree(source, targets, metric, kind)


# ------------------------------------------------------------------------------------ checking the input


def _vector(name: str, values: Any) -> np.ndarray:
    try:
        alpha = np.array(values, dtype=float)
    except (TypeError, ValueError) as error:
        raise ToolkitError(f"{name}: alpha is not a list of numbers; give it D numbers in [0, 1].") from error
    except OverflowError as error:
        raise ToolkitError(f"{name}: alpha holds a number too large to use; stay in [0, 1].") from error
    if alpha.ndim != 1 or alpha.size == 0:
        raise ToolkitError(f"{name}: alpha has shape {alpha.shape}; give it D numbers in one list.")
    wrong = np.flatnonzero(~np.isfinite(alpha))
    if wrong.size:
        raise ToolkitError(f"{name}: alpha[{wrong[0]}] is {alpha[wrong[0]]}; give a finite number in [0, 1].")
    alpha.setflags(write=False)
    return alpha


def _check(source: Terminal, targets: Sequence[Terminal], metric: str, kind: str) -> None:
    if metric not in METRICS:
        raise ToolkitError(f"The metric is {metric!r}; use one of {', '.join(METRICS)}.")
    if kind not in KINDS:
        raise ToolkitError(f"The kind of tree is {kind!r}; use one of {', '.join(KINDS)}.")
    if len(targets) >= MAX_TERMINALS:
        raise ToolkitError(f"{len(targets)} targets were given; use at most {MAX_TERMINALS - 1}.")
    seen = {source.name}
    for target in targets:
        if target.alpha.shape != source.alpha.shape:
            raise ToolkitError(
                f"{target.name}: alpha has {target.alpha.size} numbers where {source.name} has "
                f"{source.alpha.size}; give all robots the same dimensions."
            )
        if target.name in seen:
            raise ToolkitError(f"The name {target.name!r} is used twice; give every robot its own name.")
        seen.add(target.name)


def _read_points(content: Any, where: str) -> tuple[Terminal, tuple[Terminal, ...]]:
    if not isinstance(content, Mapping):
        raise ToolkitError(f"{where} holds a {type(content).__name__}; write an object with source and targets.")
    for key in ("source", "targets"):
        if key not in content:
            raise ToolkitError(f'{where} has no "{key}"; add it next to {sorted(map(str, content)) or "nothing"}.')
    if not isinstance(content["targets"], Sequence) or isinstance(content["targets"], str):
        raise ToolkitError(f'{where}: "targets" is a {type(content["targets"]).__name__}; write a list of robots.')
    if not content["targets"]:
        raise ToolkitError(f'{where}: "targets" is empty; list at least one robot.')
    source = _read_robot(content["source"], f"{where}: source")
    targets = tuple(_read_robot(t, f"{where}: targets[{i}]") for i, t in enumerate(content["targets"]))
    try:
        _check(source, targets, "l1", "steiner")
    except ToolkitError as error:
        raise ToolkitError(f"{where}: {error}") from error
    return source, targets


def _read_robot(entry: Any, where: str) -> Terminal:
    if not isinstance(entry, Mapping):
        raise ToolkitError(f'{where} is a {type(entry).__name__}; write an object with "name" and "alpha".')
    for key in ("name", "alpha"):
        if key not in entry:
            raise ToolkitError(f'{where} has no "{key}"; give it a name and alpha.')
    numbers = entry["alpha"]
    if not isinstance(numbers, (list, tuple, np.ndarray)) or any(
        isinstance(number, (bool, str, list, tuple)) for number in numbers
    ):
        raise ToolkitError(f'{where}: "alpha" is not a list of numbers; give it D numbers in [0, 1].')
    if not isinstance(entry["name"], str) or not entry["name"]:
        raise ToolkitError(f'{where}: "name" is {entry["name"]!r}; give it a non-empty text.')
    robot = Terminal(entry["name"], _vector(where, numbers))
    outside = np.flatnonzero((robot.alpha < 0) | (robot.alpha > 1))
    if outside.size:
        raise ToolkitError(
            f"{where}: alpha[{outside[0]}] is {robot.alpha[outside[0]]:g}; evolution parameters lie in [0, 1]."
        )
    return robot


# ------------------------------------------------------------------------------------ from arrays to a tree


def _distances(a: np.ndarray, b: np.ndarray, metric: Metric) -> np.ndarray:
    """(n, D), (m, D) -> (n, m) distances."""
    return cdist(a, b, "cityblock" if metric == "l1" else "euclidean")


def _extent(points: np.ndarray) -> float:
    """The longest side of the points' box: the yardstick of every tolerance."""
    return float(np.ptp(points, axis=0).max())


def _distinct(points: np.ndarray) -> tuple[list[int], list[int]]:
    """Indices of points that differ, and for every point the index of the one it equals."""
    near = cdist(points, points, "chebyshev") <= _TIE * _extent(points)
    distinct: list[int] = []
    twin = []
    for index, row in enumerate(near):
        twin.append(next((other for other in distinct if row[other]), index))
        if twin[-1] == index:
            distinct.append(index)
    return distinct, twin


def _give_back_duplicates(
    points: np.ndarray, distinct: Sequence[int], twin: Sequence[int], embedding: np.ndarray, parent: Sequence[int]
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
    neighbours = _merge(points, parents, n, _MERGE[metric] * _extent(points))
    order, above = [0], {0: -1}
    for index in order:
        for other in sorted(neighbours[index] - {above[index]}):
            above[other] = index
            order.append(other)
    metas = [index for index in order if index >= n]
    place = {index: i for i, index in enumerate([*range(n), *metas])}
    nodes = [Node(t.name, "target" if i else "source", t.alpha) for i, t in enumerate(terminals)]
    for index, name in zip(metas, _names({t.name for t in terminals}), strict=False):
        nodes.append(Node(name, "meta", _vector(name, points[index])))
    edges = []
    for index in order[1:]:
        start, end = place[above[index]], place[index]
        length = _distances(nodes[start].alpha[None], nodes[end].alpha[None], metric)[0, 0]
        edges.append(Edge(start, end, float(length)))
    total = sum(edge.length for edge in edges)
    optimal = total - bound <= _PROOF * total
    return EvolutionTree(metric, kind, tuple(nodes), tuple(edges), bool(optimal), float(min(bound, total)))


# -------------------------------------------------------------------------------------- geometric median


def _median_tree(terminals: Sequence[Terminal], points: np.ndarray, metric: Metric) -> EvolutionTree:
    """One meta robot at the geometric median of source and targets (section "Baselines" of the paper)."""
    median = _median_l1(points) if metric == "l1" else _median_l2(points)
    n = len(points)
    return _finish(terminals, np.vstack([points, median]), [n] * n + [-1], metric, "geometric-median")


def _median_l1(points: np.ndarray) -> np.ndarray:
    """Coordinate-wise median; where an interval of values is equally good, the one nearest to the source's."""
    ranked = np.sort(points, axis=0)
    return np.clip(points[0], ranked[(len(points) - 1) // 2], ranked[len(points) // 2])


def _median_l2(points: np.ndarray) -> np.ndarray:
    """The point of least summed Euclidean distance (Weiszfeld 1937), found as a star's one free node."""
    distinct, twin = _distinct(points)
    count = np.bincount(twin, minlength=len(points))[distinct].astype(float)
    flat, lift = _flatten(points[distinct])
    for index, here in enumerate(flat):
        away = flat - here
        radius = np.linalg.norm(away, axis=1)
        radius[index] = 1.0
        pull = np.linalg.norm((count / radius) @ away)
        if pull <= count[index] * (1 + _TIE):  # Vardi and Zhang 2000: no other point can pull the median off this one
            return points[distinct[index]]
    leaves = len(flat)
    star = np.hstack([np.eye(leaves), -np.ones((leaves, 1))])
    start = np.average(flat, axis=0, weights=count)[None]
    return lift(_relax(star, flat, start, count))[0]


# ------------------------------------------------------------------------- topologies by stepwise addition


@dataclass(frozen=True, eq=False)
class _Forest:
    """B partial trees over the same first k of n leaves, all rooted at leaf 0.

    Leaves are numbered 0 .. n-1 in the order of insertion; the Steiner node that came with leaf k is n + k - 2.
    An edge is named by its lower node.

    Attributes:
        parent: (B, 2n-2) node above each, -1 for the root and for nodes not there yet.
        kids: (B, 2n-2, 2) the two nodes below each Steiner node.
        order: (B, k-2) Steiner nodes, lower ones before those above them.
    """

    n: int
    parent: np.ndarray
    kids: np.ndarray
    order: np.ndarray

    @classmethod
    def seed(cls, n: int) -> _Forest:
        """The one tree over two leaves."""
        parent = np.full((1, 2 * n - 2), -1)
        parent[0, 1] = 0
        return cls(n, parent, np.full((1, 2 * n - 2, 2), -1), np.empty((1, 0), dtype=int))

    @property
    def leaves(self) -> int:
        return self.order.shape[1] + 2

    @property
    def edges(self) -> np.ndarray:
        """(2k-3,) names of the edges, the same in every tree."""
        return np.r_[1 : self.leaves, self.n : self.n + self.leaves - 2]

    def insert(self, trees: np.ndarray, edges: np.ndarray) -> _Forest:
        """Copies of the given trees (B',) with the next leaf put onto the given edges (B',)."""
        leaf, steiner = self.leaves, self.n + self.leaves - 2
        rows = np.arange(len(trees))
        parent, kids, order = self.parent[trees], self.kids[trees], self.order[trees]
        above = parent[rows, edges]
        replaced = kids[rows, above] == edges[:, None]
        kids[rows, above] = np.where(replaced, steiner, kids[rows, above])
        kids[rows, steiner] = np.stack([edges, np.full_like(edges, leaf)], axis=1)
        parent[rows, steiner], parent[rows, edges], parent[rows, leaf] = above, steiner, steiner
        # the new node comes right after the one below it, or first of all above a leaf
        slot = ((order == edges[:, None]) * np.arange(1, leaf - 1)).sum(axis=1)
        grown = np.concatenate([order, np.full((len(trees), 1), steiner)], axis=1)
        index = np.arange(leaf - 1)
        source = np.where(index == slot[:, None], leaf - 2, index - (index > slot[:, None]))
        return _Forest(self.n, parent, kids, np.take_along_axis(grown, source, axis=1))

    def take(self, trees: np.ndarray) -> _Forest:
        return _Forest(self.n, self.parent[trees], self.kids[trees], self.order[trees])

    def beside(self, other: _Forest) -> _Forest:
        if other.leaves < self.leaves:  # nothing was left to grow
            return self
        pairs = ((self.parent, other.parent), (self.kids, other.kids), (self.order, other.order))
        return _Forest(self.n, *(np.concatenate(pair) for pair in pairs))


def _search(
    n: int, bounds: Callable[[_Forest], tuple[np.ndarray, np.ndarray]], narrow: int, wide: int
) -> tuple[_Forest, float, float]:
    """Two passes of `_branch_and_bound`, the first to find a short tree early; same results."""
    first, early, _ = _branch_and_bound(n, bounds, np.inf, narrow)
    second, upper, bound = _branch_and_bound(n, bounds, early, wide)
    # a wider beam that had to drop trees may have dropped the one that the first pass found
    keep_both = bound < upper and upper >= early * (1 - _TIE)
    return first.beside(second) if keep_both else second, upper, bound


def _branch_and_bound(
    n: int, bounds: Callable[[_Forest], tuple[np.ndarray, np.ndarray]], upper: float, width: int
) -> tuple[_Forest, float, float]:
    """Grow all trees leaf by leaf; drop what cannot beat `upper`, and what exceeds the beam's `width`.

    Args:
        bounds: for a forest of B trees, two (B, E) arrays for the next leaf on each edge: a length that no
            complete tree grown from there undercuts, and for the last leaf also a length that it reaches.

    Returns:
        The complete trees that may be shortest (all that tie, up to the width), the least length reached (or
        `upper`), and a length that no tree undercuts.
    """
    forest, dropped = _Forest.seed(n), np.inf
    for leaf in range(2, n):
        if not len(forest.parent):
            break
        lower, reached = bounds(forest)
        if leaf == n - 1:
            upper = min(upper, float(reached.min()))
        trees, columns = np.nonzero(lower <= upper * (1 + _TIE))
        kept = lower[trees, columns]
        if len(kept) > width:
            best = np.argsort(kept, kind="stable")
            dropped = min(dropped, kept[best[width]])
            trees, columns = trees[best[:width]], columns[best[:width]]
        forest = forest.insert(trees, forest.edges[columns])
    return forest, upper, min(upper, dropped)


def _insertion_order(points: np.ndarray, metric: Metric) -> list[int]:
    """Source, then the target farthest from the targets' mean, then always the one farthest from those chosen.

    Far points first make partial trees long, and bounds tight. The order depends on the targets alone, so that
    ties between trees are broken alike at every step of a walk towards a meta robot.
    """
    gaps = _distances(points, points, metric)
    centre = points[1:].mean(axis=0, keepdims=True)
    order = [0, 1 + int(_distances(points[1:], centre, metric).argmax())]
    while len(order) < len(points):
        nearest = gaps[order[1:]].min(axis=0)
        nearest[order] = -1
        order.append(int(nearest.argmax()))
    return order


def _tour_bound(points: np.ndarray, metric: Metric) -> float:
    """Half of the longest 1-tree (Held and Karp 1970): 1-tree <= tour <= twice any tree that joins all points."""
    gaps = _distances(points, points, metric)
    best = 0.0
    for index in range(len(points)):
        rest = np.delete(np.delete(gaps, index, 0), index, 1)
        best = max(best, _spanning_length(rest) + np.sort(gaps[index])[1:3].sum())
    return best / 2


def _spanning_length(gaps: np.ndarray) -> float:
    """Length of the minimum spanning tree of (n, n) distances (Prim 1957)."""
    total, outside = 0.0, np.arange(1, len(gaps))
    nearest = gaps[0, 1:]
    while outside.size:
        place = nearest.argmin()
        total += nearest[place]
        nearest = np.delete(np.minimum(nearest, gaps[outside[place], outside]), place)
        outside = np.delete(outside, place)
    return float(total)


# ------------------------------------------------------------------------------------- shortest tree, L1


@dataclass(frozen=True, eq=False)
class _Splits:
    """Terminals as weighted splits: fact 2 of the module's docstring.

    Attributes:
        bits: (n, W) uint64, on which side of each split a terminal lies; the source lies on side 0.
        weight: (64 W,) total gap of each split [alpha]; zero in the padding.
        table: (8 W, 256) summed weight of each byte's bits.
        constant: weight of splits that part one terminal from all others: every tree cuts them exactly once.
    """

    bits: np.ndarray
    weight: np.ndarray
    table: np.ndarray
    constant: float

    @classmethod
    def of(cls, points: np.ndarray) -> _Splits:
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
        return cls(bits, padded[n], table, float(weight[~inner].sum()))

    def weigh(self, words: np.ndarray) -> np.ndarray:
        """(..., W) uint64 -> (...) summed weight of the bits set."""
        octets = words.reshape(-1, words.shape[-1]).view(np.uint8)
        total = np.zeros(len(octets))
        for column, table in enumerate(self.table):
            total += table[octets[:, column]]
        return total.reshape(words.shape[:-1])

    def undecided(self, leaves: int) -> float:
        """Weight of the splits that have all of the first leaves on one side: each is still to be cut once."""
        seen = self.bits[:leaves]
        return float(self.weigh(np.bitwise_or.reduce(seen) ^ np.bitwise_and.reduce(seen) ^ ~np.uint64(0)))


def _join(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Fitch's rule on (..., 2, W) sets of states: what both allow, else what either allows."""
    both = a & b
    neither = ~(both[..., :1, :] | both[..., 1:, :])
    return both | (neither & (a | b))


def _states(forest: _Forest, bits: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Optimal states of each edge's lower side, and of a node put onto the edge: (B, 2n-2, 2, W) each."""
    count, nodes = forest.parent.shape
    rows = np.arange(count)
    below = np.zeros((count, nodes, 2, bits.shape[1]), dtype=np.uint64)
    below[:, : len(bits), 0], below[:, : len(bits), 1] = ~bits, bits
    for node in forest.order.T:
        left, right = forest.kids[rows, node].T
        below[rows, node] = _join(below[rows, left], below[rows, right])
    above = np.zeros_like(below)
    top = forest.order[:, -1] if forest.leaves > 2 else np.ones(count, dtype=int)
    above[rows, top] = below[:, 0]
    for node in forest.order.T[::-1]:
        left, right = forest.kids[rows, node].T
        above[rows, left] = _join(above[rows, node], below[rows, right])
        above[rows, right] = _join(above[rows, node], below[rows, left])
    return below, _join(below, above)


class _L1Bounds:
    """Length of every way to insert the next leaf, plus what the splits not yet decided will cost at least.

    Inserting a leaf lengthens a tree by the weight of the splits whose optimal states on that edge exclude the
    leaf's: with slopes of -1, 0 and 1 only, the cost around an edge is flat there and rises by 1 outside.
    """

    def __init__(self, splits: _Splits) -> None:
        self.splits = splits

    def __call__(self, forest: _Forest) -> tuple[np.ndarray, np.ndarray]:
        size = 1 + _L1_PIECE // (forest.parent.shape[1] * 2 * self.splits.bits.shape[1])
        pieces = [np.arange(i, min(i + size, len(forest.parent))) for i in range(0, len(forest.parent), size)]
        totals = np.concatenate([self._totals(forest.take(piece)) for piece in pieces])
        lower = totals + self.splits.constant + self.splits.undecided(forest.leaves + 1)
        return lower, lower

    def _totals(self, forest: _Forest) -> np.ndarray:
        below, middle = _states(forest, self.splits.bits)
        leaf = self.splits.bits[forest.leaves]
        misses = (leaf & ~middle[:, forest.edges, 1]) | (~leaf & ~middle[:, forest.edges, 0])
        return self.length(forest, below)[:, None] + self.splits.weigh(misses)

    def length(self, forest: _Forest, below: np.ndarray) -> np.ndarray:
        """(B,) weight of the splits' changes of state: where the two sides of a node agree on nothing."""
        rows = np.arange(len(below))[:, None]
        kids = forest.kids[rows, forest.order]
        both = below[rows, kids[..., 0]] & below[rows, kids[..., 1]]
        changes = self.splits.weigh(~(both[:, :, 0] | both[:, :, 1])).sum(axis=1)
        return changes + self.first_stretch(forest, below)

    def first_stretch(self, forest: _Forest, below: np.ndarray) -> np.ndarray:
        """(B,) weight of the changes on the edge at the root, splits of one terminal left out."""
        top = forest.order[:, -1] if forest.leaves > 2 else np.ones(len(below), dtype=int)
        both = below[:, 0] & below[np.arange(len(below)), top]
        return self.splits.weigh(~(both[:, 0] | both[:, 1]))


def _shortest_l1(points: np.ndarray) -> tuple[np.ndarray, list[int], float]:
    """Nodes (2n-2, D), parents and lower bound of the shortest L1 tree over n distinct points, rooted at the first."""
    n = len(points)
    if n < 3:
        return points, [-1, 0][:n], np.inf
    order = _insertion_order(points, "l1")
    splits = _Splits.of(points[order])
    bounds = _L1Bounds(splits)
    beam = _L1_WORDS // (4 * n * splits.bits.shape[1])
    final, upper, bound = _search(n, bounds, min(beam, 8 * n), _EVERYTHING if n <= _EXHAUSTIVE["l1"] else beam)
    shared = bounds.first_stretch(final, _states(final, splits.bits)[0])
    chosen = int((shared >= shared.max() - _TIE * upper).argmax())
    values, parent = _wagner(final.take(np.array([chosen])), points[order])
    back = np.r_[np.argsort(order), n : 2 * n - 2]
    parents = [int(p) if p < 0 or p >= n else order[p] for p in parent[back]]
    return values[back], parents, max(bound, _tour_bound(points, "l1"))


def _wagner(forest: _Forest, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Best Steiner values (2n-2, D) and parents of one complete tree (Farris 1970).

    Upwards, each node gets the interval of values that are equally good for what hangs below: where its two
    children's intervals meet, or the gap between them. Downwards, it takes the value nearest to its parent's.
    """
    n = len(points)
    low, high = np.zeros((2, 2 * n - 2, points.shape[1]))
    low[:n] = high[:n] = points
    for node in forest.order[0]:
        left, right = forest.kids[0, node]
        inner, outer = np.maximum(low[left], low[right]), np.minimum(high[left], high[right])
        low[node], high[node] = np.minimum(inner, outer), np.maximum(inner, outer)
    values = low.copy()
    for node in forest.order[0, ::-1]:
        values[node] = np.clip(values[forest.parent[0, node]], low[node], high[node])
    return values, forest.parent[0]


# ------------------------------------------------------------------------------------- shortest tree, L2


def _flatten(points: np.ndarray) -> tuple[np.ndarray, Callable[[np.ndarray], np.ndarray]]:
    """The points in their own span (n, at most n-1), scaled to extent 1, and the way back."""
    origin, scale = points[0], _extent(points) or 1.0
    offsets = (points - origin) / scale
    _, size, axes = np.linalg.svd(offsets, full_matrices=False)
    axes = axes[: max(1, int((size > 1e-14 * size.max(initial=0.0)).sum()))]
    return offsets @ axes.T, lambda flat: origin + scale * (flat @ axes)


def _incidence(forest: _Forest) -> np.ndarray:
    """(B, E, 2n-2): +1 at each edge's lower node, -1 at its upper one."""
    edges, count = forest.edges, len(forest.parent)
    matrix = np.zeros((count, len(edges), forest.parent.shape[1]))
    matrix[:, np.arange(len(edges)), edges] = 1.0
    matrix[np.arange(count)[:, None], np.arange(len(edges)), forest.parent[:, edges]] = -1.0
    return matrix


def _smith(
    forest: _Forest, points: np.ndarray, sweeps: int, start: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Smith's iteration (1992) on B trees at once: bounds (B,) from below and above, and Steiner points.

    Each sweep solves the tree of springs whose stiffnesses are the inverses of the last edge lengths. The forces
    in the springs balance, so, scaled to at most one, they are a dual solution: no tree of this topology is
    shorter than the work they do (a flow of forces through the tree).
    """
    n, present = len(points), slice(forest.n, forest.n + forest.leaves - 2)
    incidence = _incidence(forest)
    free, fixed = incidence[:, :, present], incidence[:, :, :n] @ points
    count = len(incidence)
    lower, upper = np.zeros(count), np.full(count, np.inf)
    stiffness = np.ones(incidence.shape[:2])
    if start is not None:
        stiffness = 1 / np.maximum(np.linalg.norm(fixed + free @ start, axis=2), _STIFFEST)
    steiner = np.zeros((count, free.shape[2], points.shape[1]))
    for _ in range(sweeps):
        weighted = np.swapaxes(free * stiffness[:, :, None], 1, 2)
        steiner = -np.linalg.solve(weighted @ free, weighted @ fixed)
        length = np.linalg.norm(fixed + free @ steiner, axis=2)
        force = stiffness * length
        upper = np.minimum(upper, length.sum(axis=1))
        lower = np.maximum(lower, (force * length).sum(axis=1) / force.max(axis=1))
        stiffness = 1 / np.maximum(length, _STIFFEST)
    return lower, upper, steiner


def _relax(
    incidence: np.ndarray, points: np.ndarray, start: np.ndarray, weight: np.ndarray | float = 1.0
) -> np.ndarray:
    """Best free points (S, d) of one topology, by Newton's method.

    Each length l is smoothed to sqrt(l^2 + e^2), with e shrinking to 1e-11: smooth and strictly convex, also
    where an edge vanishes. The smoothed optimum exceeds the true one by at most e per edge.
    """
    free, fixed = incidence[:, len(points) :], incidence[:, : len(points)] @ points
    weights = np.broadcast_to(weight, len(fixed))
    x = start.copy()

    def value(x: np.ndarray, e: float) -> float:
        return float(weights @ np.sqrt(((fixed + free @ x) ** 2).sum(axis=1) + e * e))

    for e in 10.0 ** -np.arange(2, 12):
        for _ in range(40):
            gradient, newton = _newton_step(free, fixed + free @ x, weights, e)
            slope, step = float((gradient * newton).sum()), 1.0
            now = value(x, e)
            while value(x - step * newton, e) > now - 1e-4 * step * slope and step > 1e-6:
                step /= 2
            x = x - step * newton if step > 1e-6 else x
            if slope <= 1e-14 or step <= 1e-6:
                break
    return x


def _newton_step(free: np.ndarray, away: np.ndarray, weights: np.ndarray, e: float) -> tuple[np.ndarray, np.ndarray]:
    """Gradient (S, d) of the smoothed length, and the step that cancels it."""
    length = np.sqrt((away**2).sum(axis=1) + e * e)
    unit = away / length[:, None]
    size, d = free.shape[1], away.shape[1]
    gradient = free.T @ (weights[:, None] * unit)
    bend = (weights / length)[:, None, None] * (np.eye(d) - unit[:, :, None] * unit[:, None, :])
    hessian = np.einsum("es,et,eij->sitj", free, free, bend).reshape(size * d, size * d)
    hessian[np.diag_indices(size * d)] += 1e-13 * np.trace(hessian) / (size * d)
    return gradient, np.linalg.solve(hessian, gradient.ravel()).reshape(size, d)


def _l2_bounds(points: np.ndarray, sweeps: int) -> Callable[[_Forest], tuple[np.ndarray, np.ndarray]]:
    def bounds(forest: _Forest) -> tuple[np.ndarray, np.ndarray]:
        count, edges = len(forest.parent), forest.edges
        grown = forest.insert(np.repeat(np.arange(count), len(edges)), np.tile(edges, count))
        lower, upper, _ = _smith(grown, points, sweeps)
        return lower.reshape(count, -1), upper.reshape(count, -1)

    return bounds


def _shortest_l2(points: np.ndarray) -> tuple[np.ndarray, list[int], float]:
    """Nodes (2n-2, D), parents and lower bound of the shortest L2 tree over n distinct points (Smith 1992)."""
    n = len(points)
    if n < 3:
        return points, [-1, 0][:n], np.inf
    order = _insertion_order(points, "l2")
    flat, lift = _flatten(points[order])
    scale = _extent(points)
    beam = max(4, _L2_BEAM // n**2)
    forest, upper, bound = _search(n, _l2_bounds(flat, 25), 4, _EVERYTHING if n <= _EXHAUSTIVE["l2"] else beam)
    chosen, steiner, proven = _finalists(forest, flat, upper)
    nodes = np.concatenate([points[order], lift(steiner)])
    back = np.r_[np.argsort(order), n : 2 * n - 2]
    parents = [int(p) if p < 0 or p >= n else order[p] for p in forest.parent[chosen][back]]
    return nodes[back], parents, max(min(bound, proven) * scale, _tour_bound(points, "l2"))


def _finalists(forest: _Forest, points: np.ndarray, upper: float) -> tuple[int, np.ndarray, float]:
    """The shortest of complete trees, its Steiner points (n-2, d), and a length that none of them undercuts."""
    lower, alive = np.zeros(len(forest.parent)), np.arange(len(forest.parent))
    steiner = np.zeros((len(alive), len(points) - 2, points.shape[1]))
    start = None
    for _ in range(_L2_ROUNDS):
        low, high, start = _smith(forest.take(alive), points, 40, start)
        lower[alive], steiner[alive] = np.maximum(lower[alive], low), start
        upper = min(upper, float(high.min()))
        still = lower[alive] <= upper * (1 + _TIE)
        alive, start = alive[still], start[still]
        if len(alive) <= 2:
            break
    alive = alive[np.argsort(lower[alive], kind="stable")]
    lengths: dict[int, float] = {}
    for tree in alive[:_L2_FINALISTS]:
        incidence = _incidence(forest.take(np.array([tree])))[0]
        steiner[tree] = _relax(incidence, points, steiner[tree])
        bound, _, _ = _smith(forest.take(np.array([tree])), points, 2, steiner[[tree]])
        lengths[int(tree)] = float(np.linalg.norm(incidence @ np.vstack([points, steiner[tree]]), axis=1).sum())
        lower[tree] = max(lower[tree], bound[0])
    least = min(lengths.values())
    tied = sorted(tree for tree, length in lengths.items() if length <= least * (1 + 10 * _TIE))
    top = forest.order[:, -1] - len(points)
    shared = [np.linalg.norm(steiner[tree, top[tree]] - points[0]) for tree in tied]
    chosen = tied[int(np.argmax(np.array(shared) >= max(shared) - _MERGE["l2"]))]
    return chosen, steiner[chosen], float(min(lower[alive].min(), least))


# ------------------------------------------------------------------------------------------------- plot

# Okabe and Ito's colours (2008), told apart under every common colour blindness; shapes say the same again.
_LOOK = {"source": ("#0072B2", "s"), "meta": ("#E69F00", "D"), "target": ("#009E73", "o")}


def plot_tree(tree: EvolutionTree, path: str | Path) -> None:
    """Draw the tree from left to right, with the length of every edge and the totals, into an image file.

    Columns count the edges from the source, so horizontal distance is not length; the numbers are.

    Args:
        tree: any tree.
        path: image file; the suffix chooses the format (.png, .svg, .pdf).

    Raises:
        ToolkitError: the file cannot be written, or its suffix names no image format.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    spots = _layout(tree)
    columns, rows = spots.max(axis=0) + 1
    figure = Figure(figsize=(max(6.5, 2.3 * columns), 1.6 + 0.85 * rows), facecolor="white", layout="constrained")
    FigureCanvasAgg(figure)
    axes, below = figure.subplots(2, 1, height_ratios=[0.85 * rows + 0.4, 0.75])
    _draw_edges(axes, tree, spots)
    _draw_nodes(axes, tree, spots)
    axes.set(xlim=(-0.5, columns - 0.5), ylim=(-0.75, rows - 0.35))
    axes.set_title(f"Evolution tree: {tree.kind}, {tree.metric.upper()}")
    axes.set_axis_off()
    _draw_table(below, tree)
    try:
        figure.savefig(path, dpi=150)
    except (OSError, ValueError) as error:
        raise ToolkitError(f"The plot cannot be written to {path} ({error}); name a .png or .svg file.") from error


def _draw_table(axes: Axes, tree: EvolutionTree) -> None:
    axes.set_axis_off()
    proof = "yes" if tree.optimal else f"no; none is below {tree.lower_bound:.4g}"
    table = axes.table(
        [[f"{tree.length:.4g}", f"{tree.independent_length:.4g}", f"{tree.ratio:.2f}", proof]],
        colLabels=["total length", "independent paths", "ratio", "proven shortest of its kind"],
        cellLoc="center",
        loc="center",
    )
    table.scale(1, 1.4)


def _layout(tree: EvolutionTree) -> np.ndarray:
    """(nodes, 2) column and row of each node: leaves one row apart, others midway between their children."""
    children: dict[int, list[int]] = {index: [] for index in range(len(tree.nodes))}
    spots = np.zeros((len(tree.nodes), 2))
    for edge in tree.edges:
        children[edge.start].append(edge.end)
        spots[edge.end, 0] = spots[edge.start, 0] + 1
    rows = itertools.count()

    def place(index: int) -> float:
        below = [place(child) for child in children[index]]
        spots[index, 1] = (below[0] + below[-1]) / 2 if below else next(rows)
        return spots[index, 1]

    place(0)
    return spots


def _draw_edges(axes: Axes, tree: EvolutionTree, spots: np.ndarray) -> None:
    for edge in tree.edges:
        (x, y), (u, v) = spots[edge.start], spots[edge.end]
        axes.plot([x, u], [y, v], color="#555555", linewidth=1.6, zorder=1)
        axes.annotate(
            f"{edge.length:.3g}",
            (x + 0.55 * (u - x), y + 0.55 * (v - y)),
            ha="center",
            va="center",
            fontsize=9,
            bbox={"facecolor": "white", "edgecolor": "none", "pad": 1.5},
        )


def _draw_nodes(axes: Axes, tree: EvolutionTree, spots: np.ndarray) -> None:
    for kind, (colour, marker) in _LOOK.items():
        mine = [index for index, node in enumerate(tree.nodes) if node.kind == kind]
        if mine:
            axes.scatter(*spots[mine].T, s=110, color=colour, marker=marker, edgecolor="black", label=kind, zorder=3)
    for node, (x, y) in zip(tree.nodes, spots, strict=True):
        name = node.name if len(node.name) <= 22 else node.name[:21] + "\u2026"
        axes.annotate(
            name,
            (x, y),
            xytext=(0, -10),
            textcoords="offset points",
            ha="center",
            va="top",
            fontsize=10,
            bbox={"facecolor": "white", "edgecolor": "none", "pad": 0.5, "alpha": 0.85},
            zorder=2,
        )
    axes.legend(loc="upper left", ncols=3, frameon=False, fontsize=9)

"""The records of an evolution tree: terminals, nodes, edges, the tree, and the next step on it.

Geometry only. A robot is a point alpha in [0, 1]^D; the cost of moving a policy between two robots is taken as their L1 or L2
distance (Meta-Evolve, section "Evolution Tree Determination").
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal

import numpy as np

from toolkit.errors import ToolkitError
from toolkit.evolution.geometry import distances

Metric = Literal["l1", "l2"]
Kind = Literal["steiner", "geometric-median", "independent"]

METRICS: tuple[Metric, ...] = ("l1", "l2")
KINDS: tuple[Kind, ...] = ("steiner", "geometric-median", "independent")

ARRIVED = 1e-9
"""Default Euclidean distance under which the current robot counts as being at a node [alpha]."""

MAX_TERMINALS = 60
"""A split of the terminals is stored as one 64-bit integer. The paper expects fewer than 20 robots."""


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
        object.__setattr__(self, "alpha", checked_vector(self.name, self.alpha))


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
        return float(distances(source, np.array(targets), self.metric).sum()) if targets else 0.0

    @property
    def ratio(self) -> float:
        """How many times shorter the tree is than independent paths; 1 if there is no way to go at all."""
        return self.independent_length / self.length if self.length > 0 else 1.0

    def next_meta(self, arrived: float = ARRIVED) -> MetaStep:
        """The first step on this tree, with its source as the current robot: see `next_meta_robot`."""
        children = self._children()
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

    def below(self) -> dict[str, frozenset[str]]:
        """Name of each node -> the targets at it or behind it."""
        children = self._children()
        return {node.name: self._targets_below(index, children) for index, node in enumerate(self.nodes)}

    def _children(self) -> dict[int, list[int]]:
        children: dict[int, list[int]] = {index: [] for index in range(len(self.nodes))}
        for edge in self.edges:
            children[edge.start].append(edge.end)
        return children

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


# ---- checking what is given ---------------------------------------------------------------------------------------------


def checked_vector(name: str, values: Any) -> np.ndarray:
    """(D,) read-only finite numbers, or a sentence that names what they belong to."""
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


def check_terminals(source: Terminal, targets: Sequence[Terminal], metric: str, kind: str) -> None:
    """Refuse an unknown metric or kind, unequal D, a name used twice, and too many robots."""
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

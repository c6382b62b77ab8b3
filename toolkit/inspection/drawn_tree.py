"""The evolution tree as it was planned, laid out for drawing, and projected to where it varies most."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from grippers.gripper import DIGITS
from toolkit.morphology.parameters import ParameterSpace

ON_THE_WAY = 1e-3
"""Detour, in L1, of a robot that is still on its edge."""
WIDTH, ROW = 1000.0, 190.0
"""Drawing units of the tree: its longest way, and the distance of its rows."""
DIGIT = {name: row for row, digit in enumerate(DIGITS) for name in (digit.name, *digit.chain, digit.knuckle)}
"""Element of the evolution space that belongs to a digit -> which of them, index to thumb."""


class Plan:
    """The evolution tree as it was planned, with places for drawing.

    Args:
        tree: {"nodes": [{"name", "kind", "alpha"}], "edges": [{"from", "to", "length"}], ...}, as in tree.json.

    Attributes:
        nodes: name -> node.  edges: as given.
        places: name -> (x, y): x the length from the source, to scale, y a row.
        below: name -> targets at or after the node.
        paths: "path 1", "path 1.1", ... as a transfer along the plan names them: one per edge, and one per target that others lie
            behind. Where the ways part at the source itself nothing is told of the first one, which is left out.
        share: (k,) explained variance of the principal components, k at most 3.
    """

    def __init__(self, tree: dict[str, Any]) -> None:
        self.nodes = {node["name"]: node for node in tree["nodes"]}
        self.edges = tree["edges"]
        self._children: dict[str, list[str]] = {name: [] for name in self.nodes}
        entered = set()
        for edge in self.edges:
            self._children[edge["from"]].append(edge["to"])
            entered.add(edge["to"])
        self.roots = [name for name in self.nodes if name not in entered] or list(self.nodes)[:1]
        self.below: dict[str, frozenset[str]] = {}
        self.places = self._placed()
        below = self._children[self.roots[0]]
        self.paths = ["path 1", *self._parts("path 1", below[0])] if len(below) == 1 else self._parts("path 1", self.roots[0])
        alphas = np.array([node["alpha"] for node in self.nodes.values()])
        self._mean = alphas.mean(axis=0)
        _, spread, axes = np.linalg.svd(alphas - self._mean, full_matrices=False)
        variance = spread**2 / max(np.sum(spread**2), 1e-30)
        self.share, self._axes = variance[:3], axes[:3]
        self._scale = 10.0 / max(float(np.abs((alphas - self._mean) @ self._axes.T).max()), 1e-9)

    def _placed(self) -> dict[str, tuple[float, float]]:
        length = {(edge["from"], edge["to"]): edge["length"] for edge in self.edges}
        places: dict[str, tuple[float, float]] = {}
        rows = 0

        def place(name: str, x: float) -> float:
            nonlocal rows
            places[name] = (x, 0.0)  # taken before its children, so that a cycle ends
            own = {name} if self.nodes[name]["kind"] == "target" else set()
            inner = [child for child in self._children[name] if child not in places]
            below = [place(child, x + length[name, child]) for child in inner]
            self.below[name] = frozenset(own.union(*(self.below[child] for child in inner)))
            y = float(np.mean(below)) if below else float(rows)
            rows += not below
            places[name] = (x, y)
            return y

        for root in self.roots:
            place(root, 0.0)
        longest = max((x for x, _ in places.values()), default=1.0) or 1.0
        return {name: (WIDTH * x / longest, ROW * y) for name, (x, y) in places.items()}

    def _parts(self, path: str, node: str, passed: frozenset[str] = frozenset()) -> list[str]:
        """Names of the paths into which one that ends at the node parts, and of theirs; as ``Branch.split`` gives them."""
        order = list(self.nodes)
        inner = [child for child in self._children[node] if child not in passed]  # a tree of a damaged file may bite its tail
        ends: list[tuple[frozenset[str], str | None]] = [(self.below[child], child) for child in inner]
        if inner and self.nodes[node]["kind"] == "target":
            ends.append((frozenset([node]), None))
        ends = sorted(ends, key=lambda end: min((order.index(name) for name in end[0]), default=len(order)))
        found = []
        for number, (_, child) in enumerate(ends, start=1):
            own = f"{path}.{number}"
            found += [own, *([] if child is None else self._parts(own, child, passed | {node}))]
        return found

    def project(self, alphas: np.ndarray) -> np.ndarray:
        """(n, 3) principal components of alphas (n, D); missing ones are zero."""
        flat = (np.atleast_2d(alphas) - self._mean) @ self._axes.T * self._scale
        return np.pad(flat, ((0, 0), (0, 3 - flat.shape[1])))

    def edge_of(self, targets: Sequence[str]) -> dict[str, Any] | None:
        """The edge that a path to these targets follows; None if the plan has no such edge."""
        return next((edge for edge in self.edges if self.below[edge["to"]] == frozenset(targets)), None)

    def way_of(self, targets: Sequence[str], alpha: np.ndarray) -> dict[str, Any] | None:
        """What a robot alpha (D,) on its way to these targets walks along: its edge, or a way of its own from another robot of the plan.

        A tree that asks leaves from where it likes. Whoever walks from one robot to another, bent or not, makes no detour in L1.
        """
        edge = self.edge_of(targets)
        if edge is None:
            return None
        end = edge["to"]
        near = min((name for name in self.nodes if name != end), key=lambda name: (self._detour(name, end, alpha), name != edge["from"]))
        if self._detour(edge["from"], end, alpha) <= self._detour(near, end, alpha) + ON_THE_WAY:
            return edge
        return {"from": near, "to": end, "length": self._between(near, end)}

    def _between(self, start: str, end: str) -> float:
        return float(np.abs(np.array(self.nodes[start]["alpha"]) - self.nodes[end]["alpha"]).sum())

    def _detour(self, start: str, end: str, alpha: np.ndarray) -> float:
        """By how much longer, in L1, the way from a robot to another is by way of alpha (D,)."""
        first, last = (np.abs(alpha - np.array(self.nodes[name]["alpha"])).sum() for name in (start, end))
        return float(first + last) - self._between(start, end)

    def fraction(self, edge: dict[str, Any], alpha: np.ndarray) -> float:
        """How far along an edge a robot alpha (D,) is, 0 to 1."""
        start, end = (np.array(self.nodes[edge[key]]["alpha"]) for key in ("from", "to"))
        span = np.linalg.norm(end - start)
        return float(np.clip(1.0 - np.linalg.norm(end - alpha) / span, 0.0, 1.0)) if span > 0 else 1.0

    def stretch(self, edge: dict[str, Any], begin: float, end: float) -> np.ndarray:
        """The drawn line (k, 2) of part of an edge: across to its row first, then along it; of another way straight on."""
        (x0, y0), (x1, y1) = self.places[edge["from"]], self.places[edge["to"]]
        if edge not in self.edges:
            return np.array([(x0 + share * (x1 - x0), y0 + share * (y1 - y0)) for share in (begin, end)])
        along = [(x0 + begin * (x1 - x0), y1), (x0 + end * (x1 - x0), y1)]
        return np.array(([(x0, y0)] if begin <= 0 and y0 != y1 else []) + along)


def matrix(space: ParameterSpace) -> tuple[np.ndarray, list[str], dict[str, float]]:
    """alpha as a matrix: column and row (D, 2) of each dimension; names of the rows; heads of the columns and their middles."""
    first: dict[int, str] = {}
    for parameter in space.parameters:
        first.setdefault(parameter.dimension, parameter.name)
    split = [first[k].partition(".") for k in range(space.size)]
    items, parts = [item for item, _, _ in split], [quantity or item for item, _, quantity in split]
    rows = sorted(dict.fromkeys(items), key=_row)
    quantities = list(dict.fromkeys(part.split(".")[0] for part in parts))
    columns = sorted(dict.fromkeys(parts), key=lambda part: (quantities.index(part.split(".")[0]), part))
    places = np.array([(columns.index(part), rows.index(item)) for item, part in zip(items, parts, strict=True)], float)
    heads = [column.split(".")[0] for column in columns]
    return places, rows, {name: float(np.mean([k for k, head in enumerate(heads) if head == name])) for name in quantities}


def _row(item: str) -> tuple[bool, bool, str, int]:
    """Where an element's row stands: the arm from base to flange, then digit by digit, each time shapes after joints; then all others."""
    arm = item.startswith("arm")
    return not arm, "/" in item, item if arm else "", DIGIT.get(item.partition("/")[0], len(DIGITS))

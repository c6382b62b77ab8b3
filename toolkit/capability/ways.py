"""Stretches of evolution that are audited: the edges of a tree, straight ways between any two robots, and how they turn."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Any

import numpy as np

from grippers.gripper import DIGITS
from toolkit.errors import ToolkitError
from toolkit.evolution.bend import corner
from toolkit.evolution.tree import EvolutionTree
from toolkit.morphology.space import EvolutionSpace

SIDES = ("fingers", "thumb")
"""Sides of the grasp, either of which may go first on a way that turns a corner."""
LEADS = (0.5, 0.25)
"""By which shares of their way the others may then lag behind, if it is not the whole of it, the most telling first."""
WORDS = {digit.name: digit.title for digit in DIGITS}
REST = "rest"
"""All parameters that a turn does not name."""

Turn = Mapping[str, float]
"""How a way turns: side, digit or group of parameters (``EvolutionSpace.groups``), or REST -> share of its way that it has gone there."""


def leading(first: Sequence[str], lead: float = 1.0) -> Turn:
    """The turn at which sides of the grasp, or digits, have arrived and all else lags behind by a share of its way."""
    return dict.fromkeys(first, 1.0) | {REST: 1.0 - lead}


def turning(turn: Turn) -> str:
    """In words, how a way turns."""
    if REST not in turn:
        return f"turned, by {len(turn)} groups of parameters"
    names = " and ".join(WORDS.get(name, name) for name in turn if name != REST)
    lead = 1.0 - turn[REST]
    return f"{names} first{'' if lead == 1.0 else f', by {lead:.0%}'}"


def turn_in(edge: Mapping[str, Any]) -> Turn | None:
    """How an edge of an audit's JSON turns; those of older runs name the side that goes first, and its lead."""
    if edge.get("first") is not None:
        return leading([edge["first"]], edge.get("lead") or 1.0)
    return edge.get("turn")


def gone_at(turn: Turn, space: EvolutionSpace) -> np.ndarray:
    """(D,) share of its way that each parameter has gone where a way turns.

    Raises:
        ToolkitError: the space has no such group.
    """
    groups = space.groups() | space.digits() | {side: space.side(side) for side in SIDES}
    out = np.full(space.size, turn.get(REST, 0.5))
    for name, share in turn.items():
        if name not in groups and name != REST:
            raise ToolkitError(f"a way turns by {name}, and these robots have no such parameters; audit them anew")
        if name in groups:
            out[groups[name]] = share
    return out


@dataclass(frozen=True)
class Way:
    """A stretch of evolution.

    Attributes:
        start, end: names of its ends.  first, last: their alphas (D,).
        corner: (D,) where it turns, if it does.  turn: how.
    """

    start: str
    end: str
    first: np.ndarray
    last: np.ndarray
    corner: np.ndarray | None = None
    turn: Turn | None = None

    def at(self, share: float) -> np.ndarray:
        """The robot (D,) at a share of the way's length, L1."""
        if self.corner is None:
            return np.clip(self.first + share * (self.last - self.first), 0.0, 1.0)
        legs = [np.abs(self.corner - self.first).sum(), np.abs(self.last - self.corner).sum()]
        gone = share * sum(legs)
        if gone <= legs[0]:
            return np.clip(self.first + gone / legs[0] * (self.corner - self.first), 0.0, 1.0)
        return np.clip(self.corner + (gone - legs[0]) / legs[1] * (self.last - self.corner), 0.0, 1.0)

    def bent(self, space: EvolutionSpace, turn: Turn) -> "Way | None":
        """The same way, so turned; None: all that moves on it is as far there."""
        place = corner(self.first, self.last, gone_at(turn, space))
        return None if place is None else replace(self, corner=place, turn=turn)

    def turns(self, space: EvolutionSpace) -> list[Turn]:
        """Turns that mean something: a digit of the grasp goes first, or two, or all fingers; or a side leads by a part of the way."""
        moving = np.abs(self.last - self.first) > 0.0
        digits = [name for name, dimensions in space.digits().items() if moving[dimensions].any()]
        first = [*combinations(digits, 1), *combinations(digits, 2), ("fingers",)]
        return [leading(names) for names in first] + [leading([side], lead) for lead in LEADS for side in SIDES]

    @property
    def told(self) -> str:
        """Its end, and how it turns if it does."""
        return self.end if self.turn is None else f"{self.end} ({turning(self.turn)})"


def ways_of(tree: EvolutionTree) -> list[Way]:
    """The edges of an evolution tree, those of length zero left out."""
    nodes = tree.nodes
    return [Way(nodes[e.start].name, nodes[e.end].name, nodes[e.start].alpha, nodes[e.end].alpha) for e in tree.edges if e.length > 1e-9]


def ways_in(tree: Mapping[str, Any]) -> list[Way]:
    """The edges of a run's tree, as its tree.json has it."""
    nodes = {node["name"]: np.array(node["alpha"], float) for node in tree["nodes"]}
    edges = [edge for edge in tree["edges"] if edge["length"] > 1e-9]
    return [Way(edge["from"], edge["to"], nodes[edge["from"]], nodes[edge["to"]]) for edge in edges]


def pairs_on(ways: Sequence[Way], count: int, generator: np.random.Generator) -> list[Way]:
    """Straight ways between two robots each, drawn evenly by length (L1) from all robots of ``ways``."""
    lengths = np.array([np.abs(way.last - way.first).sum() for way in ways])
    ends = generator.choice(len(ways), (count, 2), p=lengths / lengths.sum())
    shares = generator.random((count, 2))
    drawn = [[(f"{ways[k].start} to {ways[k].end} {share:.1%}", ways[k].at(share)) for k, share in zip(*pair, strict=True)]
             for pair in zip(ends, shares, strict=True)]
    return [Way(first[0], last[0], first[1], last[1]) for first, last in drawn]

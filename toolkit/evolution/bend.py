"""Ways that turn a corner: some parameters reach their goal before the others begin, or when these have gone a part of their way.

In the L1 distance every way is as long as the straight one on which each parameter only ever goes towards its goal, so that of all
these ways the one may be taken whose robots can do most.
"""

from dataclasses import dataclass

import numpy as np

ARRIVED = 1e-9
"""Difference [alpha] under which a parameter is at its goal."""


def corner(alpha: np.ndarray, goal: np.ndarray, first: np.ndarray, lead: float = 1.0) -> np.ndarray | None:
    """Where the way from a robot to ``goal`` turns; None: it does not, or has turned.

    Args:
        alpha, goal: (D,) evolution parameters.
        first: indices of the parameters that go first.
        lead: share of their way by which the others then lag behind, in (0, 1].

    Returns:
        (D,) ``alpha`` with the first parameters at their goal.
    """
    before, others = np.abs(goal - alpha) > ARRIVED, np.ones(alpha.size, bool)
    others[first] = False
    if not np.any(before[first]) or not np.any(before & others):
        return None
    out = alpha + (1.0 - lead) * (goal - alpha)
    out[first] = goal[first]
    return out


@dataclass(frozen=True)
class Bend:
    """How an edge turns.

    Attributes:
        start: (D,) where the edge begins.
        first: indices of the parameters that go first.
        lead: share of their way by which the others lag behind when the first have arrived.
    """

    start: np.ndarray
    first: np.ndarray
    lead: float = 1.0

    def ahead(self, alpha: np.ndarray, goal: np.ndarray) -> np.ndarray | None:
        """Where the way from the robot ``alpha`` (D,) to the edge's end ``goal`` (D,) turns: where the edge does, if that is on a
        shortest way in L1 from there too, else as it would for an edge that begins there. None: it does not, or has turned."""
        here = corner(alpha, goal, self.first, self.lead)
        whole = corner(self.start, goal, self.first, self.lead)
        if here is None or whole is None:
            return here
        between = (np.minimum(alpha, goal) - ARRIVED <= whole) & (whole <= np.maximum(alpha, goal) + ARRIVED)
        return whole if between.all() else here

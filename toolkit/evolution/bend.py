"""Ways that turn a corner: some parameters are ahead of the others there, all have arrived at the end.

In the L1 distance every way is as long as the straight one on which each parameter only ever goes towards its goal, so that of all
these ways the one may be taken whose robots can do most.
"""

from dataclasses import dataclass

import numpy as np

ARRIVED = 1e-9
"""Difference [alpha] under which a parameter is at its goal."""


def corner(alpha: np.ndarray, goal: np.ndarray, gone: np.ndarray) -> np.ndarray | None:
    """Where the way from a robot to ``goal`` turns; None: all that moves is as far there, so that it goes straight.

    Args:
        alpha, goal: (D,) evolution parameters.
        gone: (D,) share of its way that each parameter has gone there, in [0, 1].

    Returns:
        (D,) the corner.
    """
    moving = np.abs(goal - alpha) > ARRIVED
    if not moving.any() or np.ptp(gone[moving]) == 0.0:
        return None
    return np.where(gone == 1.0, goal, alpha + gone * (goal - alpha))


@dataclass(frozen=True)
class Bend:
    """How an edge turns.

    Attributes:
        start: (D,) where the edge begins.
        gone: (D,) share of its way that each parameter has gone where it turns.
    """

    start: np.ndarray
    gone: np.ndarray

    def ahead(self, alpha: np.ndarray, goal: np.ndarray) -> np.ndarray | None:
        """Where the way from the robot ``alpha`` (D,) to the edge's end ``goal`` (D,) turns: at the edge's corner; from beside the edge,
        where all parameters that it may still bring there have come as far, and the others stay. None: it does not, or has turned."""
        turn = corner(self.start, goal, self.gone)
        if turn is None:
            return None
        here = np.clip(turn, np.minimum(alpha, goal), np.maximum(alpha, goal))
        passed = min(np.abs(here - alpha).max(), np.abs(here - goal).max()) <= ARRIVED
        return None if passed else here

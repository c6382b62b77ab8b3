"""Ways that turn a corner: some parameters reach their goal before the others begin.

In the L1 distance every way is as long as the straight one on which each parameter only ever goes towards its goal, so that of all
these ways the one may be taken whose robots can do most. Of what is left of such a way the same holds, so that a corner needs no
memory of where the way began.
"""

import numpy as np

ARRIVED = 1e-9
"""Difference [alpha] under which a parameter is at its goal."""


def corner(alpha: np.ndarray, goal: np.ndarray, first: np.ndarray) -> np.ndarray | None:
    """Where the way from a robot to ``goal`` turns; None: it does not, or has turned.

    Args:
        alpha, goal: (D,) evolution parameters.
        first: indices of the parameters that go first.

    Returns:
        (D,) ``alpha`` with the first parameters at their goal.
    """
    before, after = np.abs(goal - alpha) > ARRIVED, np.ones(alpha.size, bool)
    after[first] = False
    if not np.any(before[first]) or not np.any(before & after):
        return None
    out = np.array(alpha, dtype=float)
    out[first] = goal[first]
    return out

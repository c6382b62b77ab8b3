"""Which joint of one robot is probably which of another's: a proposal from geometry alone, no name and no role.

Chains are aligned in order (global alignment by dynamic programming; Needleman and Wunsch 1970): the cheapest pairing that
never crosses, where a joint may also stay without a partner. What a pair costs is read from the two screws at the common
start posture.
"""

from collections.abc import Sequence

import numpy as np

from toolkit.morphology.tree import Screw

RIGHT_ANGLE = 1.0
"""Cost of two axes at a right angle; a joint's own sense is free, so that this is the largest angle there is."""
METRE = 1.0
"""Cost of two joints 1 m apart along their axes' common normal: about an arm's reach."""
ALONE = 2.0
"""Cost of a joint without a partner: more than any pair within reach, so that as few as possible stay alone."""


def pair_cost(one: Screw, other: Screw) -> float:
    """Cost of two joints being the same one: the angle and the distance between their axes; infinite if their kinds differ."""
    if one.sliding != other.sliding:
        return float("inf")
    cosine = min(1.0, abs(float(one.axis @ other.axis)))
    apart = other.anchor - one.anchor
    normal = np.cross(one.axis, other.axis)
    length = float(np.linalg.norm(normal))
    if length > 1e-2:
        distance = abs(float(apart @ normal)) / length
    else:  # parallel
        distance = float(np.linalg.norm(apart - one.axis * (one.axis @ apart)))
    return RIGHT_ANGLE * np.arccos(cosine) / (np.pi / 2) + METRE * distance


def align(costs: np.ndarray) -> list[tuple[int | None, int | None]]:
    """The cheapest order-preserving pairing of two chains.

    Args:
        costs: (n, m) of pairing joint i of one with joint j of the other; infinite where they must not pair.

    Returns:
        pairs (i, j) in the order of the merged chain; None where a joint has no partner.
    """
    n, m = costs.shape
    best = np.full((n + 1, m + 1), np.inf)
    best[:, 0], best[0, :] = ALONE * np.arange(n + 1), ALONE * np.arange(m + 1)
    for i in range(1, n + 1):
        for j in range(1, m + 1):
            best[i, j] = min(best[i - 1, j - 1] + costs[i - 1, j - 1], best[i - 1, j] + ALONE, best[i, j - 1] + ALONE)
    pairs: list[tuple[int | None, int | None]] = []
    i, j = n, m
    while i or j:
        if i and j and best[i, j] == best[i - 1, j - 1] + costs[i - 1, j - 1]:
            i, j = i - 1, j - 1
            pairs.append((i, j))
        elif i and best[i, j] == best[i - 1, j] + ALONE:
            i -= 1
            pairs.append((i, None))
        else:
            j -= 1
            pairs.append((None, j))
    return pairs[::-1]


def align_chains(one: Sequence[Screw], other: Sequence[Screw]) -> list[tuple[int | None, int | None]]:
    """``align`` by ``pair_cost``."""
    return align(np.array([[pair_cost(a, b) for b in other] for a in one]).reshape(len(one), len(other)))

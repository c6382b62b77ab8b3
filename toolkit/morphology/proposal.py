"""Which joint of one robot is probably which of another's: a proposal from geometry alone, no name and no role.

Chains are aligned in order (global alignment by dynamic programming; Needleman and Wunsch 1970): the cheapest pairing that
never crosses, where a joint may also stay without a partner. What a pair costs is read from the two screws at the common
start posture.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import linear_sum_assignment

from grippers.gripper import DIGIT_OF
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


@dataclass(frozen=True)
class Finger:
    """A chain of a gripper's joints from the palm outwards.

    Attributes:
        joints: their names, the palm's first.
        screws: at the start posture.
        driven: whether an actuator moves any of them; a passive chain is the inner knuckle of a linkage, not a finger.
    """

    joints: tuple[str, ...]
    screws: tuple[Screw, ...]
    driven: bool

    @property
    def tip(self) -> np.ndarray:
        """Centre of mass of the outermost link (3,) [m], world."""
        return self.screws[-1].com


def propose_roles(own: Sequence[Finger], source: Sequence[Finger]) -> dict[str, str]:
    """Which joint of the source's hand each joint of another gripper is, by geometry.

    Driven fingers are assigned to the source's so that the distances between tips are shortest in sum (Kuhn 1955); within a
    pair the joints are aligned in order. A slide has no partner in a hand of hinges and becomes that of the source's finger,
    and the first joint of a passive chain the inner knuckle of the finger whose tip is nearest, where the hand's card has these.

    Args:
        own: the gripper's chains.
        source: the source's chains; their joints are named by the roles they play.

    Returns:
        joint -> role, for every joint that has a partner.
    """
    driven = [finger for finger in own if finger.driven]
    costs = np.array([[np.linalg.norm(a.tip - b.tip) for b in source] for a in driven]).reshape(len(driven), len(source))
    rows, columns = linear_sum_assignment(costs)
    roles: dict[str, str] = {}
    for row, column in zip(rows, columns, strict=True):
        mine, theirs = driven[row], source[column]
        for i, j in align_chains(theirs.screws, mine.screws):
            if j is not None and i is not None:
                roles[mine.joints[j]] = theirs.joints[i]
            elif j is not None and mine.screws[j].sliding and (slide := DIGIT_OF[theirs.joints[0]].slide) is not None:
                roles[mine.joints[j]] = slide
    for finger in own:
        if not finger.driven and driven:
            nearest = min(driven, key=lambda other: float(np.linalg.norm(other.tip - finger.tip)))
            named = [roles[joint] for joint in nearest.joints if joint in roles]
            if named and (knuckle := DIGIT_OF[named[0]].knuckle) is not None:
                roles[finger.joints[0]] = knuckle
    return roles

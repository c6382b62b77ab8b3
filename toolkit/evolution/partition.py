"""Algorithm 2: from the current robot and the targets left, where to go next and who shares the way."""

from collections.abc import Sequence

import numpy as np

from toolkit.evolution.solve import evolution_tree
from toolkit.evolution.tree import ARRIVED, Kind, MetaStep, Metric, Terminal, check_terminals


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
    check_terminals(current, targets, metric, kind)
    away = [t for t in targets if np.linalg.norm(t.alpha - current.alpha) > arrived]
    step = evolution_tree(current, away, metric, kind).next_meta(arrived)
    reached = frozenset(t.name for t in targets) - frozenset(t.name for t in away)
    return MetaStep(step.meta_name, step.meta_alpha, step.partition, reached | step.reached)

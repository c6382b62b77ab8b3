"""A policy taken along a tree without any training: where does it break?"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from tasks.sight import Sight
from toolkit.evolution import EvolutionTree
from toolkit.learning.policy import GaussianPolicy, MeanActor
from toolkit.runs.seeds import EVALUATION_SEEDS
from toolkit.simulation.rollout import RolloutEngine


@dataclass(frozen=True)
class Waypoint:
    """Success of one policy, untrained for it, on a robot of an edge of the evolution tree.

    Attributes:
        start, end: names of the edge's nodes.
        share: of the edge that lies behind, 0 to 1.
        episodes, successes, diverged: counts.
    """

    start: str
    end: str
    share: float
    episodes: int
    successes: int
    diverged: int


def walk(
    policy: GaussianPolicy, engine: RolloutEngine, tree: EvolutionTree, steps: int, episodes: int,
    sight: Callable[[np.ndarray], Sight],
) -> Iterator[Waypoint]:
    """Walk every edge of a tree with a policy that is not trained on the way: where does it break?

    Args:
        policy: plays its mean action.
        engine: of the merged robot in which the tree lies.
        tree: whose edges to walk.
        steps: parts of each edge; its ends are measured too.
        episodes: per robot, on evaluation's seeds.
        sight: alpha (D,) -> how the policy sees that robot, as a transfer has it.
    """
    seeds = [EVALUATION_SEEDS + i for i in range(episodes)]
    for edge in tree.edges:
        start, end = tree.nodes[edge.start], tree.nodes[edge.end]
        for share in np.linspace(0.0, 1.0, steps + 1):
            alpha = start.alpha + share * (end.alpha - start.alpha)
            played = engine.play(MeanActor(policy.through(sight(alpha))), [alpha] * episodes, seeds)
            yield Waypoint(start.name, end.name, float(share), episodes, sum(e.success for e in played),
                           sum(e.diverged for e in played))

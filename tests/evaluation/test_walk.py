"""A policy taken along a tree without any training, against its episodes played one by one."""

from dataclasses import replace

import numpy as np
import pytest
from toys import CRAWL, CRAWLER_ROBOTS

from tasks.sight import Sight
from toolkit.evaluation.walk import walk
from toolkit.learning.policy import GaussianPolicy, MeanActor
from toolkit.morphology.lab import Lab
from toolkit.runs.seeds import EVALUATION_SEEDS
from toolkit.simulation.laws import merged_plant
from toolkit.simulation.rollout import RolloutEngine, play

EPISODES, STEPS = 3, 2
HIGH = replace(CRAWL, goal=0.5, hold_steps=1, horizon=8)
"""Some starts are high enough, others are not, whatever the policy does."""


@pytest.fixture(scope="module")
def lab():
    return Lab(CRAWLER_ROBOTS[0], CRAWLER_ROBOTS[1:], HIGH)


def test_every_edge_is_walked_from_end_to_end(lab):
    """On evaluation's seeds, each robot seen as it is for it alone."""
    policy = GaussianPolicy(HIGH.observation.names, HIGH.action.names, np.random.default_rng(0))
    policy.set_parameters(np.random.default_rng(1).standard_normal(len(policy.parameters)))
    tree = lab.tree("l1", "steiner")
    size = HIGH.observation.size
    sight = lambda alpha: Sight(np.eye(size) + 0.1 * alpha.sum() * np.tri(size), np.full(size, alpha.sum()))  # noqa: E731
    engine = RolloutEngine(lab.merged, threads=1)
    try:
        found = list(walk(policy, engine, tree, STEPS, EPISODES, sight))
    finally:
        engine.close()
    names = [node.name for node in tree.nodes]
    wanted = [(names[edge.start], names[edge.end], share) for edge in tree.edges for share in (0.0, 0.5, 1.0)]
    assert [(point.start, point.end, point.share) for point in found] == wanted
    counts = []
    for start, end, share in wanted:
        ends = [tree.nodes[names.index(name)].alpha for name in (start, end)]
        alpha = (1 - share) * ends[0] + share * ends[1]
        plant, actor = merged_plant(lab.merged, alpha, *lab.merged.new()), MeanActor(policy.through(sight(alpha)))
        played = [play(plant, actor, EVALUATION_SEEDS + i, alpha) for i in range(EPISODES)]
        counts.append((EPISODES, sum(e.success for e in played), sum(e.diverged for e in played)))
    assert [(point.episodes, point.successes, point.diverged) for point in found] == counts
    assert 0 < sum(successes for _, successes, _ in counts) < EPISODES * len(counts), "both must occur"

"""The weighted metric: distances as they should be, judgements on numbers known beforehand, and one short rollout on the real robots."""

from itertools import islice

import numpy as np
import pytest

from tasks import TASKS
from tasks.sight import Sight
from toolkit.benchmarks import metrics as sensitivity
from toolkit.benchmarks.metrics import Judgement, capability_weights, compare_metrics, sensitivities, weighted
from toolkit.evolution import Terminal, evolution_tree
from toolkit.expert.training import new_learner
from toolkit.morphology.build import MergedRobot


def test_weighted_terminals_are_apart_by_the_weighted_distance():
    rng = np.random.default_rng(0)
    weights, points = rng.random(7), rng.random((3, 7))
    scaled = weighted([Terminal(f"r{i}", p) for i, p in enumerate(points)], weights)
    expected = (np.abs(points[0] - points[1]) * weights).sum() / weights.mean()
    assert np.abs(scaled[0].alpha - scaled[1].alpha).sum() == pytest.approx(expected)
    assert evolution_tree(scaled[0], scaled[1:]).optimal


def test_a_metric_that_knows_what_matters_foretells_failure():
    """Success depends on the first of 20 dimensions alone: weighing that one foretells it, counting all alike does not."""
    rng = np.random.default_rng(1)
    alphas = rng.random((200, 20))
    judged = Judgement(alphas, 1 - alphas[:, 0])
    knows = np.r_[1.0, np.zeros(19)]
    assert judged.rank_correlation(np.zeros(20), knows) == pytest.approx(1)
    assert abs(judged.rank_correlation(np.zeros(20), np.ones(20))) < 0.5
    assert judged.rank_correlation(np.zeros(20), 1 - knows) < 0.3
    assert judged.ahead(np.zeros(20), knows) == 1 and judged.ahead(np.zeros(20), np.ones(20)) == 0


def test_real_parameters_change_a_real_rollout(pair):
    """The first dimensions, measured twice: the same figures, finite, and not all of them zero."""
    task = TASKS["061_foam_brick"]
    policy, _ = new_learner(task, 0)
    plain = lambda alpha: Sight.plain(task.observation.size)  # noqa: E731
    first = list(islice(sensitivities(pair.merged, policy, pair.space.betas[0], plain), 3))
    assert first == list(islice(sensitivities(pair.merged, policy, pair.space.betas[0], plain), 3))
    assert np.isfinite(first).all() and min(first) >= 0 and max(first) > 0


@pytest.mark.slow
def test_what_a_robot_can_do_hangs_on_its_fingers(pair):
    """Between hand and jaw: a finger's dimension changes the grip, most arm joints' do not."""
    weights = capability_weights(pair.merged, [pair.space.beta("kinova3")], lambda done, total: None)
    element = {p.dimension: p.element for p in pair.space.parameters}
    fingers = max(weights[d] for d in element if element[d] in ("FF", "TH"))
    arm = [weights[d] for d in element if element[d].startswith("arm") and element[d] != "arm7"]
    assert fingers > 1.0 and (not arm or max(arm) < 0.2 * fingers), (fingers, arm)


def test_metrics_are_compared_on_the_same_robots(monkeypatch):
    """Rollouts are replaced by a toy in which only the first dimension matters; the weighted metric must come out ahead."""

    class Policy:
        def through(self, sight):
            assert sight == "as a transfer has it"

    class Engine:
        merged = MergedRobot.__new__(MergedRobot)  # is not asked for anything

        def play(self, actor, alphas, seeds):
            return [type("Played", (), {"success": alpha[0] < 0.2 + 0.1 * (seed % 7)})() for alpha, seed in zip(alphas, seeds, strict=True)]

    monkeypatch.setattr(sensitivity, "sensitivities", lambda merged, policy, alpha, sight: iter(np.r_[5.0, np.full(11, 0.01)]))
    monkeypatch.setattr(sensitivity, "capability_weights", lambda merged, alphas, progress: np.r_[3.0, np.full(11, 0.1)])
    source = Terminal("hand", np.zeros(12))
    targets = [Terminal(f"t{i}", np.random.default_rng(i).uniform(0.5, 1, 12)) for i in range(3)]
    found = compare_metrics(Engine(), Policy(), source, targets, lambda alpha: "as a transfer has it", 60, 7, 0)
    plain, heavy, root, able = found.metrics
    assert heavy.correlation > plain.correlation and heavy.correlation > 0.6
    assert plain.ahead == 0 and heavy.ahead > 0.9
    assert np.mean(found.weights) == pytest.approx(1) and 0 < found.success < 1
    assert plain.ratio == pytest.approx(evolution_tree(source, targets).ratio)
    assert able.name == "L1 by capability" and able.correlation > plain.correlation
    assert all(m.length <= m.independent_length for m in found.metrics)

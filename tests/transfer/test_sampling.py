"""Episodes are counted to the last, measured on seeds of their own, and not played where the outcome is sure."""

import numpy as np
import pytest
from toy_transfer import NPG, OBSERVATION, TARGETS, TOLERANCE, Toy, config, own, records, timeless, tolerance, transfer_of

from tasks.sight import Sight
from toolkit.runs.seeds import CHECKING_SEEDS, EVALUATION_SEEDS, TRAINING_SEEDS

pytestmark = pytest.mark.usefixtures("unhurried")


def test_checks_say_what_was_played(finished):
    transfer, toy = finished
    checks = iter(toy.of(training=False))
    for record in (r for r in records(transfer) if r["event"] in ("check", "look", "explore")):
        played = []
        while len(played) < record["checked"]:
            played += next(checks)["seeds"]
        assert len(played) == record["checked"]
        wanted = transfer.config.noisy_threshold if record["event"] == "explore" else transfer.config.threshold
        assert not record["held"] or record["success"] >= wanted
    assert next(checks, None) is None, "a measurement was played but not written down"


def test_a_measurement_stops_early_without_changing_its_outcome(tmp_path):
    """The rate on the way and the goal alike, at every error from none to hopeless."""
    toy = Toy()
    transfer = transfer_of(tmp_path / "run", config(), toy)
    branch, saved = transfer.pending[0], 0
    for error in np.linspace(0.001, TOLERANCE + 0.001, 25):
        alpha = np.array([error, 0.0, 0.0])
        rate = np.mean([error < tolerance(CHECKING_SEEDS + i) for i in range(24)])
        for needed in (0.5, 2 / 3, 0.85, 1.0):
            before = toy.episodes
            measured = transfer.sampler.success(branch, toy, alpha, needed, 24)
            assert (measured >= needed) is bool(rate >= needed - 1e-9), (error, rate, needed)
            saved += 24 - (toy.episodes - before)
    assert transfer.costs["path 1"].check_episodes == toy.episodes
    assert saved > 0, "no measurement stopped early"


def test_costs_count_exactly_what_was_played(finished):
    transfer, toy = finished
    for path, cost in transfer.costs.items():
        mine = [call for call in toy.calls if call["path"] == path]
        trained = [len(call["seeds"]) for call in mine if call["training"]]
        checked = [len(call["seeds"]) for call in mine if not call["training"]]
        assert (cost.sim_epochs, cost.check_episodes) == (sum(trained), sum(checked)), path
        assert cost.train_iterations == len(trained) and set(trained) <= {NPG.batch_size}
    totals = sum(c.sim_epochs + c.check_episodes for c in transfer.costs.values())
    assert totals == toy.episodes > 0
    last = {r["path"]: r for r in records(transfer)}
    for path, cost in transfer.costs.items():
        assert all(last[path][key] == getattr(cost, key) for key in ("sim_epochs", "check_episodes", "train_iterations"))


def test_seeds_of_training_checking_and_evaluation_never_meet(finished):
    _, toy = finished
    trained = {seed for call in toy.of(training=True) for seed in call["seeds"]}
    checked = {seed for call in toy.of(training=False) for seed in call["seeds"]}
    assert trained and max(trained) < TRAINING_SEEDS <= CHECKING_SEEDS <= min(checked)
    assert max(checked) < CHECKING_SEEDS + 100 < EVALUATION_SEEDS
    counts = sum(len(call["seeds"]) for call in toy.of(training=True))
    assert len(trained) > 0.99 * counts, f"{counts} training episodes share {len(trained)} seeds"


def test_every_robot_is_checked_on_the_same_seeds(finished):
    """All but what was trained to the goal of a target, which has to show it on others."""
    _, toy = finished
    first = {tuple(range(CHECKING_SEEDS, CHECKING_SEEDS + 8)), tuple(range(CHECKING_SEEDS + 8, CHECKING_SEEDS + 12))}
    batches = toy.of(training=False)
    assert first <= {tuple(call["seeds"]) for call in batches}
    assert all(len(np.unique(call["alphas"], axis=0)) == 1 for call in batches)
    anew = [call for call in batches if tuple(call["seeds"]) not in first]
    assert all(min(call["seeds"]) >= CHECKING_SEEDS + 12 for call in anew)
    assert all(any(np.allclose(alpha, target.alpha) for target in TARGETS) for call in anew for alpha in call["alphas"])


def test_how_a_robot_is_seen_is_no_matter_to_what_is_taken_along(tmp_path):
    """Robots whose own observations are others, as is said of them, learn, move and cost as those that are seen as they are; what
    arrives is the policy of the target's own observations, and so is what is shown of the way, with the robot's own episodes."""
    sight = lambda alpha: Sight(np.array([[1.0 + 0.5 * alpha[0]]]), np.array([alpha[2] - 0.5 * alpha[1]]))  # noqa: E731
    shown = []
    for learner in ("npg", "search"):
        settings = config(learner=learner)
        even = transfer_of(tmp_path / f"{learner}-even", settings, Toy())
        odd = transfer_of(tmp_path / f"{learner}-odd", settings, Toy(sight=sight), sight=sight,
                          on_batch=lambda branch, episodes, noise, policies: shown.extend(zip(episodes, policies, strict=True)))
        even.meta_evolve()
        odd.meta_evolve()
        for one, other in zip(timeless(even), timeless(odd), strict=True):
            assert {key: pytest.approx(value, abs=1e-6) if isinstance(value, float) else value for key, value in one.items()} == other
        for target in TARGETS:
            mine, there, seen = even.arrived[target.name], odd.arrived[target.name], sight(target.alpha)
            assert not seen.is_plain
            np.testing.assert_allclose(there.mean(own(seen)), mine.mean(OBSERVATION), atol=1e-9)
            np.testing.assert_allclose(there.mean(own(seen) + 0.01), mine.mean(OBSERVATION + 0.01 * seen.matrix[0]), atol=1e-9)
    for episode, _ in shown:
        np.testing.assert_array_equal(episode.observations[0], own(sight(episode.alpha)))
    played = [np.allclose(episode.actions[0], policy.mean(episode.observations[0]), atol=1e-12) for episode, policy in shown]
    assert np.mean(played) > 1 / 4, "the policy that is shown is not the one that played by its mean action"

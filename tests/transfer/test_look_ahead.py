"""Looks ahead: a policy that holds farther on goes there at once, and only where it holds."""

import numpy as np
import pytest
from toy_transfer import SOURCE, TARGETS, TOLERANCE, Toy, config, error_at, records, transfer_of

from toolkit.evolution import Terminal
from toolkit.learning.exploration import SearchConfig

pytestmark = pytest.mark.usefixtures("unhurried")


def test_the_way_goes_on_only_where_the_exploring_policy_succeeds_too(finished):
    """Before every move: the mean action and the policy under noise, each at its threshold, on the very robot that is next.

    Adaptive steps ask the mean action alone at a target, where nothing follows.
    """
    transfer, toy = finished
    told = [r for r in records(transfer) if r["event"] in ("check", "look", "explore", "moved")]
    calm = [r for i, r in enumerate(told) if not (r["event"] == "explore" and i + 1 < len(told) and told[i + 1]["event"] == "explore")]
    moves = [calm[i - 2 : i + 1] for i, record in enumerate(calm) if record["event"] == "moved"]
    assert moves
    for before, last, moved in moves:
        if last["event"] == "explore":
            assert before["event"] in ("check", "look") and before["reach"] == last["reach"]
            assert before["success"] >= transfer.config.threshold and last["success"] >= transfer.config.noisy_threshold
        else:
            alone = transfer.routes[moved["path"]][-1] in ("left", "right")
            assert alone and moved["distance"] < 1e-9 and transfer.config.step == "adaptive", moved
            assert last["held"] and last["success"] >= transfer.config.threshold
    checks = toy.of(training=False)
    assert {call["noisy"] for call in checks} == {True, False}
    assert sum(len(call["seeds"]) for call in checks if call["noisy"]) == sum(r["checked"] for r in told if r["event"] == "explore")


def test_a_target_that_holds_already_leaves_the_tree_at_once(tmp_path):
    """Its branch begins on it, and costs no training; the others go on from where the policy stood."""
    toy = Toy()
    near = Terminal("near", np.array([0.3, 0.0, 0.43]))  # wants what the source wants
    transfer = transfer_of(tmp_path / "run", config(learner="search"), toy, targets=[TARGETS[0], near])
    transfer.meta_evolve()
    paths = {transfer.routes[path][-1]: path for path in transfer.costs}
    assert transfer.costs[paths["near"]].sim_epochs == 0 and transfer.costs["path 1"].sim_epochs == 0
    (moved,) = [r for r in records(transfer, "moved") if r["path"] == paths["near"]]
    assert not moved["trained"] and moved["distance"] == 0
    begins = [call["alpha"] for call in toy.calls if call["path"] == paths["left"]]
    np.testing.assert_array_equal(begins[0], SOURCE.alpha)
    assert error_at(transfer.arrived["left"], TARGETS[0].alpha) < TOLERANCE


def test_a_look_at_the_unmodified_robot_can_end_a_path_at_once(tmp_path):
    """F(beta) wants something else than the source; the native robot does not, and is looked at first."""
    native = Toy()
    native.one = lambda actor, alpha, seed: Toy.one(native, actor, SOURCE.alpha, seed)
    toy = Toy()
    transfer = transfer_of(tmp_path / "run", config(learner="search", native=True), toy, targets=TARGETS[:1], native={"left": native})
    transfer.meta_evolve()
    assert not toy.calls and {call["stage"] for call in native.calls} == {"settle"} and not native.of(training=True)
    assert [r["event"] for r in records(transfer)] == ["look", "moved", "check", "arrived"]


class Valley(Toy):
    """Robots between a tenth and nine tenths of the way to the target want something else than both ends do."""

    def one(self, actor, alpha, seed):
        inside = 0.1 < float(alpha @ TARGETS[0].alpha / (TARGETS[0].alpha @ TARGETS[0].alpha)) < 0.9
        return super().one(actor, np.array([0.5, 0.0, 0.0]) if inside else SOURCE.alpha, seed)


@pytest.mark.parametrize("learner", ["npg", "search"])
def test_success_need_not_be_monotone_along_a_way(tmp_path, learner):
    """A policy that is already behind the robots that it could not master goes on from there, however short its last step was."""
    toy = Valley()
    transfer = transfer_of(tmp_path / "run", config(learner=learner, path_budget=500), toy, targets=TARGETS[:1])
    transfer.pending[0].stride = 0.05
    transfer.meta_evolve()
    assert not toy.of(training=True), f"{len(toy.of(training=True))} batches were trained on a way that needs none"
    assert error_at(transfer.arrived["left"], SOURCE.alpha) < TOLERANCE


class Cliff(Toy):
    """Robots up to nine tenths of the way want what no policy does; from there on the source's action succeeds for some of the seeds."""

    def one(self, actor, alpha, seed):
        ahead = 0.01 < float(alpha @ TARGETS[0].alpha / (TARGETS[0].alpha @ TARGETS[0].alpha)) < 0.9
        return super().one(actor, np.array([9.0 if ahead else 0.11, 0.0, 0.0]), seed)


def test_the_search_trains_where_a_look_succeeded_sometimes(tmp_path):
    """The end of the way is within reach although nothing before it is: not one episode is spent there."""
    toy = Cliff()
    transfer = transfer_of(tmp_path / "run", config(learner="search"), toy, targets=TARGETS[:1])
    transfer.meta_evolve()
    assert toy.of(training=True)
    for call in toy.of(training=True):
        np.testing.assert_allclose(call["alphas"], np.tile(TARGETS[0].alpha, (len(call["seeds"]), 1)), atol=1e-12)
    assert set(transfer.arrived) == {"left"} and not records(transfer, "budget")


class Hidden(Toy):
    """No mean action succeeds on any robot but the source; at the end of the way one that an offset of what is seen brings about does."""

    def one(self, actor, alpha, seed):
        share = float(alpha @ TARGETS[0].alpha / (TARGETS[0].alpha @ TARGETS[0].alpha))
        return super().one(actor, SOURCE.alpha if share < 0.01 else np.array([0.2 if share > 0.99 else 9.0, 0.0, 0.0]), seed)


def test_where_no_look_succeeds_the_search_draws_at_the_end_of_the_way_first(tmp_path):
    toy = Hidden()
    transfer = transfer_of(tmp_path / "run", config(learner="search"), toy, targets=TARGETS[:1])
    transfer.meta_evolve()
    assert all(r["success"] == 0 for r in records(transfer, "look")[:5])
    assert toy.of(training=True) and set(transfer.arrived) == {"left"} and not records(transfer, "budget")
    for call in toy.of(training=True):
        np.testing.assert_allclose(call["alphas"], np.tile(TARGETS[0].alpha, (len(call["seeds"]), 1)), atol=1e-12)


def test_what_a_batch_at_the_end_does_not_find_is_looked_for_where_a_look_succeeded(tmp_path):
    """Half of the way allows some of the seeds, the end none: one batch there, then the hope."""
    toy = Toy()
    allows = lambda alpha, seed: alpha[0] < 0.41 and seed % 4 == 0  # noqa: E731
    toy.one = lambda actor, alpha, seed: Toy.one(toy, actor, np.array([0.0 if allows(alpha, seed) else 9.0, 0, 0]), seed)
    transfer = transfer_of(tmp_path / "run", config(learner="search", check_episodes=20), toy, targets=TARGETS[:1])
    (branch,) = transfer.pending
    transfer.advance(branch)
    np.testing.assert_array_equal(branch.next_alpha, TARGETS[0].alpha)
    assert [hope[0] / TARGETS[0].alpha[0] for hope in branch.hopes] == [0.5, 0.25, 0.125]
    while np.array_equal(branch.next_alpha, TARGETS[0].alpha):
        transfer.advance(branch)
    assert len(toy.of(training=True)) == 1
    np.testing.assert_array_equal(branch.next_alpha, 0.5 * TARGETS[0].alpha)


class Hurdle(Toy):
    """All robots but the source want the same; up to four tenths of the way only a third of the seeds allow it."""

    def one(self, actor, alpha, seed):
        share = float(alpha @ TARGETS[0].alpha / (TARGETS[0].alpha @ TARGETS[0].alpha))
        hopeless = 0.01 < share < 0.4 and seed % 3 > 0
        return super().one(actor, np.array([9.0 if hopeless else 0.3 if share > 0.01 else 0.0, 0.0, 0.0]), seed)


@pytest.mark.parametrize("learner, most", [("search", 100), ("npg", 1_500)])
def test_what_was_learned_in_vain_is_tried_farther_on(tmp_path, learner, most):
    """No robot within reach of the first step can have the success that moving on takes; what it teaches is all that the end asks."""
    toy = Hurdle()
    settings = config(learner=learner, patience=3, path_budget=2_000, search=SearchConfig(batch_size=8))
    transfer = transfer_of(tmp_path / "run", settings, toy, targets=TARGETS[:1])
    transfer.pending[0].looked, transfer.pending[0].stride = True, 0.2
    transfer.meta_evolve()
    events = records(transfer)
    move = next(i for i, r in enumerate(events) if r["event"] == "moved")
    turns = {r.get("turn") for r in events[:move] if r["event"] == "update"}
    assert turns == ({"offset"} if learner == "search" else {None}), "one turn was enough to see that it holds farther on"
    assert events[move]["trained"] and events[move]["stride"] > 0.5 and events[move - 1]["event"] in ("look", "explore")
    trained = sum(len(call["seeds"]) for call in toy.of(training=True))
    assert 0 < trained <= most, f"{trained} training episodes"


def test_training_goes_on_farther_where_more_succeeds_than_here(tmp_path):
    """A look that does not hold, but is better than what was reached on the nearer robot, says where to train."""
    toy = Toy()
    rates = {True: 0.25, False: 0.6}  # before and behind the middle of the way
    toy.one = lambda actor, alpha, seed: Toy.one(toy, actor, np.array([0.0 if seed % 20 < 20 * rates[alpha[0] < 0.4] else 9.0, 0, 0]), seed)
    transfer = transfer_of(tmp_path / "run", config(learner="search", patience=2, check_episodes=20), toy, targets=TARGETS[:1])
    (branch,) = transfer.pending
    branch.begin_phase(0.25 * TARGETS[0].alpha)
    branch.best_success = 0.25
    assert transfer.look_ahead.look_farther(branch, branch.next_alpha, transfer.way.evolution_tree(branch))
    np.testing.assert_array_equal(branch.next_alpha, TARGETS[0].alpha)
    assert not branch.alpha.any() and branch.best_success == 0 and not toy.of(training=True)
    branch.best_success = 0.7
    assert not transfer.look_ahead.look_farther(branch, 0.25 * TARGETS[0].alpha, transfer.way.evolution_tree(branch))


@pytest.mark.parametrize("signal", [1 / 8, 0.6])
def test_where_half_of_a_look_succeeds_training_begins_at_once(tmp_path, signal):
    """Nearer robots that hold barely teach what the farther one does not need; and where less than half succeeds they are asked first.

    Also where more is asked of a hope than half.
    """
    begun = {}
    for seeds in (7, 5):
        toy = Toy()
        toy.one = lambda actor, alpha, seed, toy=toy, seeds=seeds: Toy.one(
            toy, actor, np.array([0.0 if alpha[0] < 0.4 or seed % 12 < seeds else 0.3, 0.0, 0.0]), 0)
        transfer = transfer_of(tmp_path / f"{seeds}", config(learner="search", signal=signal), toy, targets=TARGETS[:1])
        (branch,) = transfer.pending
        transfer.look_ahead.look_ahead(branch, transfer.way.evolution_tree(branch))
        begun[seeds] = (branch.next_alpha, branch.alpha.copy(), [call["alphas"][0] for call in toy.calls])
    np.testing.assert_array_equal(begun[7][0], TARGETS[0].alpha)
    assert not begun[7][1].any() and all(np.array_equal(alpha, TARGETS[0].alpha) for alpha in begun[7][2]), "nothing else was looked at"
    assert begun[5][0] is None and 0 < begun[5][1][0] < 0.4, "it went to where it holds"

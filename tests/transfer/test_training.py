"""A phase of training: turns, the best policy, other starts, and a budget that is spent."""

from dataclasses import replace

import numpy as np
import pytest
from toy_transfer import NPG, SOURCE, TARGETS, TOLERANCE, Toy, config, error_at, expert, records, transfer_of, wanted

from toolkit.evolution import Terminal
from toolkit.learning.exploration import Explored, Gain, SearchConfig
from toolkit.runs.seeds import TRAINING_SEEDS
from toolkit.transfer.events import Checked

pytestmark = pytest.mark.usefixtures("unhurried")


@pytest.fixture(scope="module")
def hopeless(tmp_path_factory):
    """(transfer, toy) of a robot that always fails."""
    toy = Toy(succeeds=False)
    settings = config(path_budget=48, xi=0.2)
    transfer = transfer_of(tmp_path_factory.mktemp("hopeless") / "run", settings, toy)
    transfer.meta_evolve()
    return transfer, toy


def test_a_hopeless_robot_exhausts_the_budget_and_says_so(hopeless):
    transfer, toy = hopeless
    budgets = records(transfer, "budget")
    assert {r["path"] for r in budgets} == set(transfer.costs), "every path has its own budget, and says when it is spent"
    assert all(cost.sim_epochs == 48 for cost in transfer.costs.values()), transfer.costs
    assert len(toy.of(training=True)) == 3 * 48 // NPG.batch_size


def test_a_hopeless_robot_never_claims_success(hopeless):
    transfer, _ = hopeless
    for record in records(transfer):
        assert not record.get("held") and not record.get("success") and not record.get("train_success"), record


def test_moves_on_a_spent_budget_do_not_say_trained(hopeless):
    transfer, _ = hopeless
    log = records(transfer)
    after = [r for before, r in zip(log, log[1:], strict=False) if before["event"] == "budget" and r["event"] == "moved"]
    assert after and not any(r["trained"] for r in after), f"{len(after)} moves on a spent budget say trained"


def test_failure_leaves_the_policy_alone(hopeless):
    """No reward, no signal: nothing but the value function may change."""
    transfer, _ = hopeless
    for policy in transfer.arrived.values():
        np.testing.assert_array_equal(policy.parameters, expert()[0].parameters)


@pytest.mark.parametrize(("measured", "shares"), [(0.6, [0.5, 0.25, 0.25]), (0.3, [1.0, 1.0, 1.0])])
def test_noise_under_which_nothing_succeeds_is_halved_where_the_mean_action_does(tmp_path, monkeypatch, measured, shares):
    """By NPG alone: it would else learn nothing for good. Where the mean action fails as well, more noise is what may help."""
    transfer = transfer_of(tmp_path / "run", config(least_noise=0.25), Toy())
    (branch,), training = transfer.pending, transfer.training
    monkeypatch.setattr(training.weights, "improve", lambda *seen: 0.0)
    monkeypatch.setattr(training.sampler, "success", lambda *seen, **more: measured)
    seen = []
    for _ in shares:
        assert training.train_to(branch, Toy(), TARGETS[0].alpha, 0.9, 12) == "training"
        seen.append(branch.noise)
    assert seen == shares


def test_the_weights_have_their_turn_where_the_search_brings_no_more(tmp_path):
    """A policy that does not look: no offset moves it, so the weights have to, and take it all the way."""
    settings = config(learner="search", patience=2, search=SearchConfig(batch_size=8), path_budget=5_000)
    transfer = transfer_of(tmp_path / "run", settings, Toy(), targets=TARGETS[:1])
    blind = expert()[0].parameters.copy()
    blind[:8], blind[-2] = 0.0, wanted(SOURCE.alpha)
    blind[8:16] = 0.0
    transfer.pending[0].policy.set_parameters(blind)
    transfer.meta_evolve()
    turns = [r["learner"] for r in records(transfer, "update")]
    assert turns[0] == "search" and set(turns) == {"search", "npg"} and not records(transfer, "budget")
    assert error_at(transfer.arrived["left"], TARGETS[0].alpha) < TOLERANCE


def test_responses_have_a_turn_between_offsets_and_weights(tmp_path):
    """The same policy, but its action may respond: no offset moves it, and NPG is not needed."""
    settings = config(learner="search", patience=2, search=SearchConfig(batch_size=8, features=1), path_budget=5_000)
    toy = Toy()
    transfer = transfer_of(tmp_path / "run", settings, toy, targets=TARGETS[:1], explored=Explored(np.array([0.2]), np.array([0.2])))
    blind = expert()[0].parameters.copy()
    blind[:16], blind[-2] = 0.0, wanted(SOURCE.alpha)
    transfer.pending[0].policy.set_parameters(blind)
    transfer.meta_evolve()
    updates = records(transfer, "update")
    assert {r["turn"] for r in updates} == {"offset", "response"} and not records(transfer, "budget")
    (cost,) = transfer.costs.values()
    assert cost.check_episodes == sum(len(call["seeds"]) for call in toy.of(training=False))
    watched = cost.check_episodes - sum(r["checked"] for r in records(transfer) if r["event"] in ("check", "look", "explore"))
    assert watched > 0 and watched % 8 == 0, "the states that responses are to are seen in checks"
    assert error_at(transfer.arrived["left"], TARGETS[0].alpha) < TOLERANCE


def test_gains_have_a_turn_after_offsets(tmp_path):
    """What the policy does has to become larger or smaller: no offset does that, where it sees nothing."""
    settings = config(learner="search", patience=6, search=SearchConfig(batch_size=8, features=1), path_budget=5_000)
    explored = Explored(np.array([0.2]), np.zeros(1), (Gain("action", slice(0, 1), 1.0),))
    transfer = transfer_of(tmp_path / "run", settings, Toy(), targets=TARGETS[:1], explored=explored)
    assert transfer.training.search.turns == ("offset", "gain", "weights")
    blind = expert()[0].parameters.copy()
    blind[:16], blind[-2] = 0.0, wanted(SOURCE.alpha)
    transfer.pending[0].policy.set_parameters(blind)
    transfer.meta_evolve()
    assert {r.get("turn") for r in records(transfer, "update")} == {"offset", "gain"}
    assert error_at(transfer.arrived["left"], TARGETS[0].alpha) < TOLERANCE


def test_the_best_policy_of_a_phase_is_returned_to(tmp_path):
    """After `patience` measurements without a better one the policy is the one that was measured best, bit for bit."""
    transfer = transfer_of(tmp_path / "run", config(learner="search", patience=2), Toy())
    (branch,) = transfer.pending
    branch.begin_phase(np.full(3, 0.03))
    first = branch.policy.copy()
    assert transfer.training.keep_best(branch, 0.4) == "training"
    for success in (0.3, 0.2):
        branch.policy.set_parameters(branch.policy.parameters + 0.01)
        outcome = transfer.training.keep_best(branch, success)
    assert outcome == "turned" and branch.turn == "weights", "the search's turn is over"
    np.testing.assert_array_equal(branch.policy.parameters, first.parameters)
    assert transfer.training.keep_best(branch, 0.5) == "training" and branch.best_success == 0.5 and branch.idle == 0


def test_a_phase_without_success_goes_back_to_the_policy_it_began_with(tmp_path):
    """Failures teach the search nothing: the policy that came holds on the robots before, and one that has strayed may hold nowhere.

    NPG has learned on nearer robots, too, and is not taken back.
    """
    transfer = transfer_of(tmp_path / "run", config(learner="search", patience=2), Toy())
    (branch,) = transfer.pending
    branch.begin_phase(np.full(3, 0.03))
    first = branch.policy.copy()
    for _ in range(3):
        outcome = transfer.training.keep_best(branch, 0.0)
        strayed = branch.policy.parameters + 0.01
        branch.policy.set_parameters(strayed if outcome == "training" else branch.policy.parameters)
    assert outcome in ("turned", "stalled")
    np.testing.assert_array_equal(branch.policy.parameters, first.parameters)
    branch.begin_turn("weights")
    branch.policy.set_parameters(first.parameters + 0.01)
    transfer.training.keep_best(branch, 0.0)
    branch.return_to_best()
    assert not np.array_equal(branch.policy.parameters, first.parameters)


@pytest.mark.parametrize("best, turn", [(0.4, None), (0.6, "weights")])
def test_the_weights_have_a_turn_before_a_nearer_robot_where_they_can_learn(tmp_path, best, turn):
    transfer = transfer_of(tmp_path / "run", config(learner="search", patience=1), Toy())
    (branch,) = transfer.pending
    branch.begin_phase(np.full(3, 0.3))
    transfer.training.keep_best(branch, best)
    assert transfer.training.keep_best(branch, 0.1) == ("stalled" if turn is None else "turned")
    assert turn is None or branch.turn == turn
    assert transfer.training.keep_best(branch, 0.1) == "stalled", "after both turns a nearer robot is tried"


@pytest.mark.parametrize("succeeding, turn", [(0.0, "offset"), (0.5, "weights")])
def test_weights_that_learn_nothing_under_the_least_noise_leave_the_turn_to_the_search(tmp_path, succeeding, turn):
    """At a target where the mean action succeeds often and hardly an episode under noise, NPG would play for nothing, over and over."""
    transfer = transfer_of(tmp_path / "run", config(learner="search", patience=2), Toy())
    (branch,) = transfer.pending
    training, (target, *_) = transfer.training, TARGETS
    branch.begin_phase()
    training.keep_best(branch, 0.6)
    branch.begin_turn("weights")
    branch.noise = transfer.config.least_noise
    training.weights.improve = lambda *_: succeeding
    assert training.learn(branch, transfer.players.engine, target.alpha, 0.6) == "training" and branch.numb == (succeeding == 0.0)
    branch.begin_turn("offset")  # as after all turns
    assert training.leave(branch, 0.6) == "training" and branch.turn == turn


def test_a_spent_budget_leaves_the_best_policy(tmp_path):
    """What arrives is what was measured best on its target, not what came last."""
    measured = []

    def watch(entry, branch):
        if isinstance(entry.event, Checked) and branch.next_alpha is None:
            measured.append((entry.event.success, branch.policy.copy()))

    settings = config(learner="search", kind="direct", path_budget=400, patience=50, goal=1.0, search=SearchConfig(batch_size=8, reuse=8))
    toy = Toy()
    toy.one = lambda actor, alpha, seed: Toy.one(toy, actor, alpha + (seed % 5 == 0), seed)  # so the goal is out of reach
    transfer = transfer_of(tmp_path / "run", settings, toy, targets=[Terminal("near", np.array([0.2, 0.1, 0.0]))], report=watch)
    transfer.meta_evolve()
    assert records(transfer, "budget") and len({success for success, _ in measured}) > 2
    best = max(success for success, _ in measured)
    assert any(success == best and np.array_equal(policy.layers().shift, transfer.arrived["near"].layers().shift)
               for success, policy in measured)


@pytest.mark.parametrize(
    "anew, outcome, turn", [(0.25, "training", "offset"), (0.5, "training", "weights"), (0.875, "kept", None), (1.0, "kept", None)]
)
def test_a_target_is_left_with_its_best_policy_only_if_other_starts_say_so(tmp_path, anew, outcome, turn):
    """The best of many measurements on the same starts is partly luck: what it does on others takes its place."""
    settings = config(learner="search", patience=1, goal_episodes=8, goal=0.9, enough=0.8)
    toy = Toy()
    toy.one = lambda actor, alpha, seed: Toy.one(toy, actor, alpha + (seed % 8 >= 8 * anew), seed)
    transfer = transfer_of(tmp_path / "run", settings, toy)
    (branch,) = transfer.pending
    transfer.training.keep_best(branch, 0.85)
    outcomes = [transfer.training.keep_best(branch, 0.1) for _ in range(2)]
    assert outcomes == ["training", "over"], "both turns have brought no more"
    branch.updates = 5
    success = transfer.training.measure_anew(branch, transfer.players.engine, SOURCE.alpha, 0.9, 8)
    assert transfer.training.leave(branch, success) == outcome
    assert success == branch.best_success == anew and turn in (None, branch.turn)
    seeds = [seed for call in toy.of(training=False) for seed in call["seeds"]]
    assert seeds == [2 * 10**6 + 5 * 8 + i for i in range(8)], "none of the starts by which it was chosen"
    assert bool(records(transfer, "kept")) == (outcome == "kept")


@pytest.mark.parametrize("learner", ["npg", "search"])
@pytest.mark.parametrize("lucky", [False, True])
def test_a_policy_trained_to_the_goal_has_to_show_it_on_other_starts(tmp_path, learner, lucky):
    """One that succeeds on the starts of the schedule's checks alone is trained on until the budget is spent."""
    first = set(range(2 * 10**6, 2 * 10**6 + 8))
    toy = Toy()
    toy.one = lambda actor, alpha, seed: Toy.one(toy, actor, alpha + (lucky and 10**6 <= seed < 3 * 10**6 and seed not in first), seed)
    settings = config(learner=learner, kind="direct", path_budget=400, goal_episodes=8)
    transfer = transfer_of(tmp_path / "run", settings, toy, targets=[Terminal("near", np.array([0.2, 0.1, 0.0]))])
    transfer.meta_evolve()
    assert bool(records(transfer, "budget")) == lucky
    assert any(r["success"] >= settings.goal for r in records(transfer, "check")), "the checks alone would have been believed"


def test_what_was_chosen_by_starts_is_not_left_by_the_same_starts(tmp_path):
    """Where a policy fails anew and the turns end in the same update, the best one shows what it can do on starts of a second choice."""
    checks = range(2 * 10**6, 2 * 10**6 + 8)
    toy = Toy()
    toy.one = lambda actor, alpha, seed: Toy.one(toy, actor, alpha + (seed not in checks), seed)
    transfer = transfer_of(tmp_path / "run", config(learner="search", patience=1, goal_episodes=8), toy)
    (branch,) = transfer.pending
    branch.updates, branch.turn, branch.turns, branch.best, branch.best_success = 4, "weights", 1, branch.policy.copy(), 0.5
    transfer.training.train_to(branch, transfer.players.engine, SOURCE.alpha, 0.9, 8)
    chosen, anew, left = (call["seeds"] for call in toy.of(training=False))
    assert branch.best_success == 0.0, "it was measured anew, and left with that"
    assert chosen == list(checks) and anew == [2 * 10**6 + 4 * 8 + i for i in range(8)]
    assert len(left) == 8 and not set(left) & {*chosen, *anew} and min(left) >= TRAINING_SEEDS


@pytest.mark.parametrize("firm", [2 / 3, 0.9])
def test_a_robot_that_is_trained_for_is_left_firmly(tmp_path, firm):
    """The search goes on where the policy barely holds; looks ask no more than before."""
    transfer = transfer_of(tmp_path / "run", config(learner="search", firm=firm), Toy())
    transfer.meta_evolve()
    left, looked = successes_before_moves(transfer)
    assert left and looked and min(left + looked) >= 8 and min(looked) < 11
    assert (min(left) >= 11) == (firm > 0.8), left


def test_a_policy_that_cannot_hold_firmly_goes_on(tmp_path):
    """In between a quarter of the starts is lost: two measurements in vain, and it leaves by the policy that holds."""
    class Slippery(Toy):
        def one(self, actor, alpha, seed):
            episode = super().one(actor, alpha, seed)
            end = any(np.allclose(alpha, terminal.alpha) for terminal in (SOURCE, *TARGETS))
            return episode if end else replace(episode, success=episode.success and seed * 5 % 12 < 9)

    transfer = transfer_of(tmp_path / "run", config(learner="search", firm=0.9, path_budget=1_000), Slippery())
    transfer.meta_evolve()
    left, _ = successes_before_moves(transfer)
    assert 8 <= min(left) < 11, left
    assert not records(transfer, "budget")


def successes_before_moves(transfer):
    """Of the policies that left a robot for which they had been trained, successes in their best check there, of up to 12, which ends when
    what is asked is sure; of those that had not, in their last look."""
    checked, seen, left, looked = {}, {}, [], []
    for record in records(transfer):
        path = record["path"]
        if record["event"] == "check":
            checked.setdefault(path, []).append(round(record["success"] * record["checked"]))
        if record["event"] == "look":
            seen[path] = round(record["success"] * record["checked"])
        if record["event"] == "moved":
            found = max(checked.pop(path, [])) if record["trained"] else seen.get(path)
            checked.pop(path, None)
            if found is not None:  # a branch that begins at a target knows by its parent's look
                (left if record["trained"] else looked).append(found)
    return left, looked

"""Strides: how far the next robot is, in which direction, and what is tried where it is too far."""

import itertools

import numpy as np
import pytest
from toy_transfer import (
    META,
    NPG,
    SOURCE,
    TARGETS,
    TOLERANCE,
    Killed,
    Toy,
    assert_same_end,
    config,
    easy_toy,
    error_at,
    records,
    transfer_of,
)

pytestmark = pytest.mark.usefixtures("unhurried")


def test_where_a_robot_gives_signal_training_begins_there(tmp_path):
    """The first stride on which the policy does not hold, but succeeds often enough under noise, is trained on: no shorter one is tried."""
    toy = Toy()
    transfer = transfer_of(tmp_path / "run", config(signal=0.1), toy)
    transfer.meta_evolve()
    told = [r for r in records(transfer) if r["event"] in ("check", "explore", "update")]
    begun = [told[i - 2 : i] for i, r in enumerate(told) if r["event"] == "update" and told[i - 1]["event"] == "explore"]
    assert any(
        mean["reach"] == noisy["reach"] > transfer.config.xi + 1e-9 and not (mean["held"] and noisy["held"]) and noisy["success"] >= 0.1
        for mean, noisy in begun
    ), "no long stride was trained on"


def test_there_is_less_noise_where_it_alone_stands_in_the_way(tmp_path):
    """Robots that all want what the source wants: less noise is all that it takes, at once, and no training."""
    toy = easy_toy()
    transfer = transfer_of(tmp_path / "run", config(least_noise=0.05), toy)
    transfer.pending[0].policy.set_log_std(np.array([-1.0]))  # more than TOLERANCE bears
    transfer.look_ahead._leave = lambda branch, step: []  # every target holds already
    transfer.meta_evolve()
    told = [r for r in records(transfer) if r["event"] in ("check", "explore")]
    assert all(0.05 <= r["noise"] <= 1.0 for r in told)
    calmed = [(a, b) for a, b in itertools.pairwise(told) if b["event"] == "explore" == a["event"]]
    assert calmed, "noise never stood in the way"
    for before, after in calmed:
        assert after["noise"] == pytest.approx(max(0.8 * before["noise"], 0.05)) and not before["held"]
    assert not records(transfer, "update")
    assert set(transfer.arrived) == {"left", "right"}


@pytest.mark.parametrize("finished", ["fixed"], indirect=True)
def test_fixed_steps_have_length_xi(finished):
    transfer, toy = finished
    strides = {path: [r["stride"] for r in records(transfer, "moved") if r["path"] == path] for path in transfer.costs}
    for path, found in strides.items():
        np.testing.assert_allclose(found[:-1], transfer.config.xi, atol=1e-9, err_msg=path)
        assert 0.0 < found[-1] <= transfer.config.xi + 1e-9, f"{path} ends with a step of {found[-1]}"
    ways = [np.linalg.norm(META), *(np.linalg.norm(t.alpha - META) for t in TARGETS)]
    np.testing.assert_allclose(sorted(sum(found) for found in strides.values()), sorted(ways), atol=1e-9)


def test_adaptive_steps_never_skip_a_robot_on_which_they_do_not_hold(finished):
    """Each move ends where the measurement right before it held, and distances shrink by what was gone."""
    transfer, _ = finished
    log = records(transfer)
    for i, record in enumerate(log):
        if record["event"] == "moved":
            last = next(r for r in reversed(log[:i]) if r["event"] != "split")
            assert last["held"], f"record {i} moves on {last}"
            gone = last["reach"]
            assert abs(gone - record["stride"]) < transfer.config.xi + 1e-9, (gone, record["stride"])


def test_the_adaptive_step_leaps_where_it_can(tmp_path):
    """Robots that all want the same action are passed in one leap, and cost no training."""
    toy = easy_toy()
    transfer = transfer_of(tmp_path / "run", config(xi=0.01, threshold=0.4), toy, targets=TARGETS[:1])
    transfer.meta_evolve()
    assert not toy.of(training=True)
    moves = records(transfer, "moved")
    assert len(moves) == 1 and moves[0]["trained"] is False and moves[0]["distance"] < 1e-12


@pytest.mark.parametrize("finished", ["adaptive"], indirect=True)
def test_a_step_is_halved_until_it_holds(finished):
    transfer, _ = finished
    reaches, tried = [], 0
    for record in records(transfer):
        if record["event"] == "check":
            reaches.append(record["reach"])
        elif record["event"] != "explore":
            failed = [r for r in reaches if r > transfer.config.xi + 1e-9]
            for longer, shorter in zip(failed, failed[1:], strict=False):
                tried += 1
                assert shorter <= longer / 2 + transfer.config.xi, f"after {longer:.3f} came {shorter:.3f}"
            reaches = []
    assert tried, "no step had to be halved, so the test saw nothing"


def test_a_phase_without_success_gives_way_to_the_next_hope_then_to_half_the_way_then_to_another_look(tmp_path):
    transfer = transfer_of(tmp_path / "run", config(learner="search"), Toy())
    (branch,) = transfer.pending
    branch.hopes, branch.looked = [0.5 * META], True
    branch.begin_phase(META)
    seen = []
    while branch.next_alpha is not None:
        seen.append(float(np.linalg.norm(branch.next_alpha) / np.linalg.norm(META)))
        assert branch.looked
        transfer.stride.try_nearer(branch, META)
    shortest = transfer.config.xi / np.linalg.norm(META)
    assert seen[:3] == pytest.approx([1.0, 0.5, 0.25]) and shortest <= seen[-1] < 2 * shortest
    assert not branch.looked, "the policy has changed since it looked"


def test_on_an_optimised_path_the_search_tries_nearer_where_the_return_rises(tmp_path):
    """Its leaps cost no Jacobian; what they do not reach is asked of one."""
    toy = Toy()
    transfer = transfer_of(tmp_path / "run", config(learner="search", path="optimised", jacobian_episodes=8), toy)
    toy.one = lambda actor, alpha, seed: Toy.one(toy, actor, SOURCE.alpha if alpha[2] > 0 else META, seed)  # only the third rewards
    (branch,) = transfer.pending
    branch.looked = True
    branch.begin_phase(META)
    transfer.stride.try_nearer(branch, META)
    nearer = branch.next_alpha
    assert len(records(transfer, "steered")) == 1 and branch.ledger.cost.sim_epochs == 8
    assert np.linalg.norm(nearer) <= np.linalg.norm(META) / 2 + 1e-12
    assert nearer[2] / np.linalg.norm(nearer) > META[2] / np.linalg.norm(META) + 0.05, nearer


@pytest.fixture(scope="module")
def steered(tmp_path_factory):
    """(transfer, toy) after a whole run on optimised paths."""
    toy = Toy()
    settings = config(path="optimised", step="fixed", jacobian_episodes=8)
    transfer = transfer_of(tmp_path_factory.mktemp("steered") / "run", settings, toy)
    transfer.meta_evolve()
    return transfer, toy


def test_an_optimised_path_reaches_every_target(steered):
    transfer, _ = steered
    errors = {t.name: error_at(transfer.arrived[t.name], t.alpha) for t in TARGETS}
    assert max(errors.values()) < TOLERANCE and not records(transfer, "budget"), errors


def test_an_optimised_path_counts_its_jacobians_as_simulation_epochs(steered):
    transfer, toy = steered
    spent = 8 * len(records(transfer, "steered")) + NPG.batch_size * len(records(transfer, "update"))
    assert sum(cost.sim_epochs for cost in transfer.costs.values()) == spent
    assert spent == sum(len(call["seeds"]) for call in toy.of(training=True))
    sampled = [call for call in toy.of(training=True) if len(call["seeds"]) == 8]
    assert len(sampled) == len(records(transfer, "steered")) > 10
    for call in sampled:
        away = np.linalg.norm(call["alphas"] - call["alpha"], axis=1)
        assert (away <= transfer.config.xi + 1e-12).all(), "a robot was sampled farther than a step away"
        assert call["seeds"][0::2] == call["seeds"][1::2], "a pair plays one seed"


def test_steps_of_an_optimised_path_are_no_longer_than_xi_and_come_nearer(steered):
    transfer, _ = steered
    for path in transfer.costs:
        moves = [r for r in records(transfer, "moved") if r["path"] == path]
        assert all(r["stride"] <= transfer.config.xi + 1e-9 for r in moves)
        distances = [r["distance"] for r in moves]
        assert all(b < a for a, b in zip(distances, distances[1:], strict=False) if a > 2 * transfer.config.xi), path
    bent = [r["straight_share"] for r in records(transfer, "steered")]
    assert min(bent) < 0.999, "no step ever left the straight line"
    assert min(bent) >= 0.6 - 1e-9, "a step was bent farther than the estimate is trusted"


@pytest.mark.slow
@pytest.mark.parametrize("step, event", [("fixed", "steered"), ("fixed", "moved"), ("adaptive", "steered")])
def test_an_optimised_path_killed_and_resumed_is_the_same_run(tmp_path, step, event):
    settings = config(path="optimised", step=step, jacobian_episodes=6, xi=0.12)
    whole = transfer_of(tmp_path / "whole", settings, Toy())
    whole.meta_evolve()
    seen = []

    def kill(entry, branch):
        seen.append(entry.event.name)
        if seen.count(event) == 3:
            raise Killed

    with pytest.raises(Killed):
        transfer_of(tmp_path / "run", settings, Toy(), report=kill).meta_evolve()
    resumed = transfer_of(tmp_path / "run", settings, Toy(), resume=True)
    resumed.meta_evolve()
    assert_same_end(resumed, whole)

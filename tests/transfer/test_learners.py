"""The two learners: which robots they play, what they change of a policy, and that a kill loses nothing of the search."""

import itertools

import numpy as np
import pytest
from toy_transfer import (
    OBSERVATION,
    SOURCE,
    TARGETS,
    TOLERANCE,
    Killed,
    Toy,
    assert_same_end,
    config,
    expert,
    natives,
    records,
    seeing_expert,
    share_on_segment,
    transfer_of,
    wanted,
)

from toolkit.errors import ToolkitError
from toolkit.learning.exploration import SearchConfig
from toolkit.runs.run import Run
from toolkit.runs.seeds import TRAINING_SEEDS
from toolkit.transfer.meta_evolve import Transfer

pytestmark = pytest.mark.usefixtures("unhurried")


def test_calming_and_rousing_scale_the_noise_and_nothing_else(tmp_path):
    transfer = transfer_of(tmp_path / "run", config(calm=0.5, least_noise=0.25), Toy())
    (branch,) = transfer.pending
    first, mean = branch.policy.log_std, branch.policy.mean(OBSERVATION)
    assert not transfer.training.weights.rouse(branch), "the first noise is the most"
    shares = []
    while transfer.training.weights.calm(branch):
        shares.append(branch.noise)
        np.testing.assert_allclose(branch.policy.log_std, first + np.log(branch.noise), rtol=0, atol=1e-12)
    assert shares == [0.5, 0.25], "not halved down to a quarter"
    shares = []
    while transfer.training.weights.rouse(branch):
        shares.append(branch.noise)
    assert shares == [0.5, 1.0]
    np.testing.assert_allclose(branch.policy.log_std, first, rtol=0, atol=1e-12)
    assert np.array_equal(branch.policy.mean(OBSERVATION), mean)


def test_fixed_steps_leave_the_noise_to_training(tmp_path):
    transfer = transfer_of(tmp_path / "run", config(step="fixed"), Toy())
    transfer.meta_evolve()
    assert {r["noise"] for r in records(transfer) if "noise" in r} == {1.0}


def test_training_robots_lie_on_the_segment_within_the_window(finished):
    """Shares in (1 - window, 1] of the way from the robot to the next one; the window closes by 0.995 per update."""
    transfer, toy = finished
    phase, updates, drawn = None, 0, []
    for call in toy.of(training=True):
        end = call["next"] if call["next"] is not None else call["alpha"]
        here = (call["path"], call["alpha"].tobytes(), None if call["next"] is None else call["next"].tobytes())
        updates = updates + 1 if here == phase else 0
        phase = here
        assert call["window"] == pytest.approx(0.995**updates, rel=1e-12), f"update {updates} of a phase"
        shares, off = share_on_segment(call["alphas"], call["alpha"], end)
        assert off < 1e-12, f"a training robot lies {off:.1e} beside the segment"
        assert (shares >= 1 - call["window"] - 1e-9).all() and (shares <= 1 + 1e-9).all()
        drawn += list((1 - shares) / call["window"]) if call["next"] is not None else []
    assert updates >= 0 and len(drawn) > 100
    assert abs(np.mean(drawn) - 0.5) < 0.1 and np.ptp(drawn) > 0.9, "robots are not drawn evenly from the window"
    windows = [r["window"] for r in records(transfer, "update")]
    assert all(0.0 < w < 1.0 for w in windows), "the window written down is the one after the update"


SEARCH = config(learner="search", native=True, path_budget=3_000)


@pytest.fixture(scope="module")
def searched(tmp_path_factory):
    """(transfer, engine, native robots, policies that played each training batch) of a whole run of the search."""
    toy, others, played = Toy(), natives(), []

    def on_batch(branch, episodes, noise, policies):
        if max(episode.seed for episode in episodes) < TRAINING_SEEDS:
            played.append((branch.policy.copy(), policies, episodes, noise))

    transfer = transfer_of(tmp_path_factory.mktemp("search") / "run", SEARCH, toy, native=others, on_batch=on_batch)
    transfer.meta_evolve()
    return transfer, toy, others, played


def test_the_search_reaches_every_target_by_what_the_policy_sees(searched):
    """The native robots want something else again; weights are touched only where the search has had its turn."""
    transfer, _, _, _ = searched
    for target, shift in zip(TARGETS, (0.2, -0.2), strict=True):
        error = abs(float(transfer.arrived[target.name].mean(OBSERVATION)[0]) - wanted(target.alpha) - shift)
        assert error < TOLERANCE, f"{target.name} is off by {error:.2f}"
    updates = records(transfer, "update")
    assert {r["learner"] for r in updates} == {"search"} and not records(transfer, "budget")
    for policy in transfer.arrived.values():
        np.testing.assert_array_equal(policy.parameters, seeing_expert()[0].parameters)
        assert abs(float(policy.layers().shift[0]) - float(seeing_expert()[0].layers().shift[0])) > TOLERANCE


def test_the_searchs_episodes_are_counted_to_the_last(searched):
    transfer, toy, others, played = searched
    calls = [*toy.calls, *itertools.chain(*(other.calls for other in others.values()))]
    for path, cost in transfer.costs.items():
        mine = [call for call in calls if call["path"] == path]
        assert cost.sim_epochs == sum(len(call["seeds"]) for call in mine if call["training"]), path
        assert cost.check_episodes == sum(len(call["seeds"]) for call in mine if not call["training"]), path
    total = sum(cost.sim_epochs for cost in transfer.costs.values())
    assert total == sum(len(episodes) for _, _, episodes, _ in played) > 0
    learned = [r for r in records(transfer, "update") if r["learned"]]
    assert sum(cost.train_iterations for cost in transfer.costs.values()) == len(learned) > 0


def test_an_offset_is_held_for_an_episode_and_mirrored_on_the_same_start(searched):
    """No noise on the actions; each pair of policies is the branch's, moved by as much to either side, and plays one seed."""
    _, toy, _, played = searched
    assert not any(call["noisy"] for call in toy.calls)
    for policy, policies, episodes, noise in played:
        assert not noise and [e.seed for e in episodes[0::2]] == [e.seed for e in episodes[1::2]]
        offsets = np.array([p.layers().shift - policy.layers().shift for p in policies])
        np.testing.assert_allclose(offsets[0::2], -offsets[1::2], rtol=0, atol=1e-12)
        assert (np.abs(offsets) > 0).all()
        for own, episode in zip(policies, episodes, strict=True):
            np.testing.assert_array_equal(episode.actions[0], own.mean(OBSERVATION))


def test_a_first_batch_without_success_ends_after_its_first_part_and_the_step_is_halved(searched):
    transfer, toy, _, _ = searched
    short = [call for call in toy.of(training=True) if len(call["seeds"]) == 8]
    assert short, "no batch was cut"
    barren = [r for r in records(transfer, "update") if not r["learned"]]
    assert barren and all(r["train_success"] == 0 for r in barren)
    asked = [call for call in toy.of(training=True) if call["stage"] == "evolve"]
    for before, after in itertools.pairwise(asked):
        if (before["path"], before["alpha"].tobytes()) == (after["path"], after["alpha"].tobytes()):
            ahead = [float(np.linalg.norm(call["next"] - call["alpha"])) for call in (before, after)]
            assert ahead[1] == pytest.approx(ahead[0]) or ahead[1] == pytest.approx(ahead[0] / 2), ahead


def test_the_search_trains_on_the_next_robot_alone(searched):
    _, toy, _, _ = searched
    for call in toy.of(training=True):
        assert len(np.unique(call["alphas"], axis=0)) == 1 and np.array_equal(call["alphas"][0], call["next"])


@pytest.mark.parametrize("share", [0.0, 0.1, 0.4, 0.75, 0.98])
def test_a_search_killed_in_a_rollout_and_resumed_is_the_same_run(tmp_path, searched, share):
    whole, toy, _, _ = searched
    kill = int(share * len(toy.calls))
    with pytest.raises(Killed):
        transfer_of(tmp_path / "run", SEARCH, Toy(kill_after=kill), native=natives()).meta_evolve()
    resumed = transfer_of(tmp_path / "run", SEARCH, Toy(), resume=True, native=natives())
    resumed.meta_evolve()
    assert_same_end(resumed, whole)


@pytest.mark.parametrize("settings", [SEARCH, config(learner="search", patience=1, search=SearchConfig(batch_size=8), path_budget=200)])
def test_a_search_killed_again_and_again_is_the_same_run(tmp_path, settings):
    """With little patience the turns and the best policy of a phase matter at every kill."""
    whole = transfer_of(tmp_path / "whole", settings, Toy(), native=natives())
    whole.meta_evolve()
    sittings = 0
    while True:
        transfer = transfer_of(tmp_path / "run", settings, Toy(kill_after=12), resume=sittings > 0, native=natives())
        try:
            transfer.meta_evolve()
            break
        except Killed:
            sittings += 1
            assert sittings < 400, "the run does not get anywhere"
    assert sittings > 3
    assert_same_end(transfer, whole)


def test_a_search_needs_something_to_explore(tmp_path):
    with pytest.raises(ToolkitError, match="declare one in the task"):
        Transfer(config(learner="search"), SOURCE, TARGETS, *expert(), Toy(), {}, Run.create(tmp_path / "run", {}))

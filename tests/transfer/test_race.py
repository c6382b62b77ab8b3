"""Races: a path that costs much is run against another from the source, by turns, and the slower is given up."""

import dataclasses

import numpy as np
import pytest
from toy_transfer import META, Killed, Toy, assert_same_end, config, records, transfer_of

pytestmark = pytest.mark.usefixtures("unhurried")


class Trap(Toy):
    """A toy that lets nobody through on the tree's way to the left target; the one from the source passes by."""

    def one(self, actor, alpha, seed):
        trapped = np.linalg.norm(alpha[:2] - META[:2]) < 0.5 and alpha[2] > 0.55 * alpha[0] + 0.15 and alpha[2] < 0.8
        found = super().one(actor, alpha, seed)
        return dataclasses.replace(found, success=found.success and not trapped)


RACED = config(learner="search", kind="asking", allowance=16)


@pytest.fixture(scope="module")
def raced(tmp_path_factory):
    """A finished run of a tree that asks, in which two paths raced."""
    transfer = transfer_of(tmp_path_factory.mktemp("raced") / "run", RACED, Trap())
    transfer.meta_evolve()
    return transfer


def test_a_path_that_costs_much_is_raced_from_the_source(raced):
    """One of the two arrives, the other is given up; all of both is counted."""
    rivals = [r for r in records(raced, "split") if "rival" in r]
    gone = {r["path"] for r in records(raced, "overtaken")}
    assert set(raced.arrived) == {"left", "right"} and rivals and not raced.pending
    for record in rivals:
        assert len({record["path"], record["rival"]} & gone) == 1, "one of the two is given up"
        assert raced.routes[record["path"]][0] == "hand"
    assert sum(cost.sim_epochs + cost.check_episodes for cost in raced.costs.values()) == raced.players.engine.episodes


def test_branches_take_turns_by_what_they_promise(tmp_path):
    transfer = transfer_of(tmp_path / "run", config(learner="search", kind="asking"), Toy())
    race, pending = transfer.race, transfer.pending
    slow, quick = transfer.way.part(pending[-1], [frozenset(["left"]), frozenset(["right"])])
    pending[:] = [quick, slow]
    race.asking.raced = ["left", "right"]
    for branch, gone, spent in ((slow, 0.1, 70), (quick, 0.5, 70)):
        race.begin(branch)
        branch.alpha = gone * transfer.way.goal(branch)
        branch.ledger.cost.sim_epochs = spent
    assert race.may_change(slow)
    race.choose(pending)
    assert pending[-1] is quick and quick.allowance == 140
    quick.ledger.cost.sim_epochs = 100
    assert not race.may_change(quick)


@pytest.mark.parametrize("share", [0.3, 0.6, 0.9])
def test_a_tree_that_asks_killed_and_resumed_is_the_same_run(tmp_path, raced, share):
    with pytest.raises(Killed):
        transfer_of(tmp_path / "run", RACED, Trap(int(share * len(raced.players.engine.calls)))).meta_evolve()
    again = transfer_of(tmp_path / "run", RACED, Trap(), resume=True)
    again.meta_evolve()
    assert_same_end(again, raced)

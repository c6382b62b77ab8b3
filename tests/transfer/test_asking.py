"""A tree that asks: a target is left for from where a policy holds nearest to it."""

import dataclasses

import numpy as np
import pytest
from toy_transfer import META, TARGETS, Toy, config, records, transfer_of

pytestmark = pytest.mark.usefixtures("unhurried")


class Carrying(Toy):
    """A toy in which what holds on the right target holds on nearly all of the way from there to the left one."""

    def one(self, actor, alpha, seed):
        right, left = TARGETS[1].alpha, TARGETS[0].alpha
        share = float((alpha - right) @ (left - right) / ((left - right) @ (left - right)))
        near = np.linalg.norm(alpha - (right + share * (left - right))) < 1e-9
        return super().one(actor, right if near and 0.0 <= share <= 0.8 else alpha, seed)


@pytest.fixture(scope="module")
def asked(tmp_path_factory):
    """A finished run of a tree that asks."""
    settings = config(learner="search", kind="asking", allowance=10_000)
    transfer = transfer_of(tmp_path_factory.mktemp("asked") / "run", settings, Carrying())
    transfer.meta_evolve()
    return transfer


def test_a_target_is_left_for_from_where_a_policy_holds_nearest_to_it(asked):
    assert set(asked.arrived) == {"left", "right"}
    assert asked.routes["path 1.1"] == ["hand", "meta", "right", "left"]
    (left,) = records(asked, "left")
    assert (left["origin"], left["target"], left["share"]) == ("right", "left", 0.75)
    between = TARGETS[1].alpha + 0.75 * (TARGETS[0].alpha - TARGETS[1].alpha)
    first = next(r for r in records(asked, "moved") if r["path"] == "path 1.1")
    assert first["distance"] == pytest.approx(np.linalg.norm(TARGETS[0].alpha - between)) and not first["trained"]


def test_asking_costs_looks_and_no_training(asked):
    """All that is played beside the looks is counted as without asking: every episode is in one of the two counts."""
    costs = asked.costs.values()
    assert sum(cost.sim_epochs + cost.check_episodes for cost in costs) == asked.players.engine.episodes
    trained = sum(len(call["seeds"]) for call in asked.players.engine.of(True))
    assert sum(cost.sim_epochs for cost in costs) == trained


def test_where_no_other_policy_holds_the_tree_is_followed(tmp_path):
    class Lonely(Toy):
        def one(self, actor, alpha, seed):
            found = super().one(actor, alpha, seed)
            off_tree = min(alpha[1], TARGETS[0].alpha[1]) > META[1] + 1e-9 and alpha[2] > META[2] + 1e-9
            return dataclasses.replace(found, success=found.success and not off_tree)

    transfer = transfer_of(tmp_path / "run", config(learner="search", kind="asking", allowance=10_000), Lonely())
    transfer.meta_evolve()
    assert transfer.routes["path 1.1"] == ["hand", "meta", "left"] and not records(transfer, "left")

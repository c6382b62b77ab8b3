"""Algorithm 1 as a whole, on the toy: every target is reached and learned, along every kind of tree, and on the unmodified robots."""

import numpy as np
import pytest
from toy_transfer import (
    META,
    OBSERVATION,
    SOURCE,
    TARGETS,
    TOLERANCE,
    Killed,
    Toy,
    assert_same_end,
    config,
    error_at,
    expert,
    records,
    transfer_of,
    wanted,
)

from toolkit.errors import ToolkitError
from toolkit.evolution import Terminal, evolution_tree

pytestmark = pytest.mark.usefixtures("unhurried")


def test_the_toy_is_no_gift():
    """The expert holds on the source and nowhere that matters, and no one policy serves both targets."""
    policy, _ = expert()
    assert error_at(policy, SOURCE.alpha) < 1e-12
    far = {t.name: error_at(policy, t.alpha) for t in TARGETS} | {"meta": error_at(policy, META)}
    assert min(far.values()) > 2 * TOLERANCE, far
    apart = abs(wanted(TARGETS[0].alpha) - wanted(TARGETS[1].alpha))
    assert apart > 2 * TOLERANCE, f"the targets want actions only {apart:.2f} apart"


def test_every_target_is_reached_and_learned(finished):
    transfer, _ = finished
    assert set(transfer.arrived) == {"left", "right"} and not transfer.pending
    errors = {t.name: error_at(transfer.arrived[t.name], t.alpha) for t in TARGETS}
    assert max(errors.values()) < TOLERANCE, f"the mean action is off by {errors}"
    assert not records(transfer, "budget")


@pytest.mark.parametrize("finished", ["fixed"], indirect=True)
def test_paths_split_at_the_meta_robot(finished):
    transfer, toy = finished
    assert list(transfer.routes) == ["path 1", "path 1.1", "path 1.2"] and transfer.routes["path 1"] == ["hand"]
    ends = {tuple(transfer.routes[path]) for path in ("path 1.1", "path 1.2")}
    assert ends == {("hand", "meta", "left"), ("hand", "meta", "right")}
    tree = evolution_tree(SOURCE, TARGETS)
    (meta,) = [node.alpha for node in tree.nodes if node.kind == "meta"]
    np.testing.assert_allclose(meta, META, atol=1e-12)
    for path in ("path 1.1", "path 1.2"):
        start = next(call["alpha"] for call in toy.calls if call["path"] == path)
        off = float(np.linalg.norm(start - meta))
        assert off < 1e-9, f"{path} begins {off:.1e} away from the meta robot"


def test_the_answer_was_measured_on_its_target(finished):
    """The last measurement before "arrived" was played on the target, and what it says is what was played."""
    transfer, toy = finished
    log = records(transfer)
    for target in TARGETS:
        end = next(i for i, r in enumerate(log) if r["event"] == "arrived" and r["target"] == target.name)
        check = log[end - 1]
        assert check["event"] == "check" and check["held"] and check["success"] >= transfer.config.goal
        last = [call for call in toy.of(training=False) if call["path"] == check["path"]][-1]
        off = float(np.abs(last["alphas"] - target.alpha).max())
        assert off < 1e-9, f"success at {target.name} was measured {off:.1e} away from it"


def test_the_last_hop_is_trained_like_any_phase(tmp_path):
    """The native robot wants an action 0.25 beside F(beta)'s: the hop has to learn it, and its episodes count."""
    toy, native = Toy(), Toy(shift=0.25)
    transfer = transfer_of(tmp_path / "run", config(native=True), toy, targets=TARGETS[:1], native={"left": native})
    policy = transfer.meta_evolve()["left"]
    apart = abs(float(policy.mean(OBSERVATION)[0]) - wanted(TARGETS[0].alpha) - 0.25)
    assert apart < TOLERANCE, f"the policy that arrived is {apart:.2f} from what the native robot wants"
    assert native.of(training=True) and {call["stage"] for call in native.calls} == {"settle"}
    assert {call["stage"] for call in toy.calls} == {"evolve"}
    cost = transfer.costs["path 1"]
    assert cost.sim_epochs + cost.check_episodes == toy.episodes + native.episodes
    last = records(transfer)[-2:]
    assert [r["event"] for r in last] == ["check", "arrived"] and last[0]["held"]


@pytest.mark.parametrize("kind", ["steiner", "geometric-median", "independent"])
@pytest.mark.parametrize("metric", ["l1", "l2"])
def test_every_kind_of_tree_is_followed_to_its_ends(tmp_path, kind, metric):
    transfer = transfer_of(tmp_path / "run", config(kind=kind, metric=metric), Toy())
    arrived = transfer.meta_evolve()
    assert max(error_at(arrived[t.name], t.alpha) for t in TARGETS) < TOLERANCE
    assert len(transfer.costs) == 3, f"{list(transfer.costs)}: one shared path and one per target"
    if kind == "independent":
        assert transfer.costs["path 1"].sim_epochs == 0, "independent paths share no way"


def test_direct_trains_on_the_targets_alone(tmp_path):
    """No robot between source and target is played; what is out of the expert's reach is not learned from nothing.

    The expert's demonstrations on the source (DAPG) are given data: played without noise, and not counted.
    """
    near, far = Terminal("near", np.array([0.1, 0.0, 0.0])), TARGETS[0]
    toy = Toy()
    transfer = transfer_of(tmp_path / "run", config(kind="direct", path_budget=120), toy, targets=[near, far])
    arrived = transfer.meta_evolve()
    shown = [call for call in toy.calls if (call["alphas"] == SOURCE.alpha).all()]
    played = np.unique(np.concatenate([call["alphas"] for call in toy.calls if not any(call is one for one in shown)]), axis=0)
    np.testing.assert_array_equal(played, np.unique([near.alpha, far.alpha], axis=0))
    assert len(shown) == 1 and not shown[0]["training"] and len(shown[0]["seeds"]) == 12
    counted = sum(cost.sim_epochs + cost.check_episodes for cost in transfer.costs.values())
    assert counted == toy.episodes - 12
    assert error_at(arrived["near"], near.alpha) < TOLERANCE
    spent = {transfer.routes[path][-1]: cost.sim_epochs for path, cost in transfer.costs.items()}
    assert spent["left"] == 120 and {r["path"] for r in records(transfer, "budget")} == {"path 1.2"}, spent
    assert transfer.costs["path 1"] == type(transfer.costs["path 1"])(), "the shared path of a star costs nothing"


def test_direct_killed_and_resumed_is_the_same_run(tmp_path):
    settings = config(kind="direct", path_budget=60)
    whole = transfer_of(tmp_path / "whole", settings, Toy())
    whole.meta_evolve()
    with pytest.raises(Killed):
        transfer_of(tmp_path / "run", settings, Toy(kill_after=6)).meta_evolve()
    resumed = transfer_of(tmp_path / "run", settings, Toy(), resume=True)
    resumed.meta_evolve()
    assert_same_end(resumed, whole)


def test_direct_needs_an_expert_that_succeeds(tmp_path):
    with pytest.raises(ToolkitError, match="fails 12 times of 12 on hand"):
        transfer_of(tmp_path / "run", config(kind="direct"), Toy(succeeds=False)).meta_evolve()

"""Ways: they turn their corners, and lead to every target, also to one on another's way."""

import numpy as np
import pytest
from toy_transfer import META, SOURCE, TARGETS, TOLERANCE, Killed, Toy, config, easy_toy, error_at, records, share_on_segment, transfer_of

from toolkit.evolution import Terminal
from toolkit.evolution.bend import Bend

pytestmark = pytest.mark.usefixtures("unhurried")


def test_a_bent_way_turns_its_corner_and_its_siblings_go_straight(tmp_path):
    """On the way to the left its second parameter goes first, in steps that never cut the corner; to the meta robot all go at once."""
    toy = Toy()
    bends = {frozenset(["left", "right"]): Bend(SOURCE.alpha, np.array([0.0, 1.0, 0.0]))}
    transfer = transfer_of(tmp_path / "run", config(step="fixed", xi=0.1), toy, bends=bends)
    transfer.meta_evolve()
    assert set(transfer.arrived) == {"left", "right"}
    places = [call["next"] for call in toy.calls if call["path"] == "path 1" and call["next"] is not None]
    assert len(places) > 3
    for place in places:
        assert place[1] == pytest.approx(META[1]) or place[[0, 2]] == pytest.approx([0.0, 0.0]), place
    for path in ("path 1.1", "path 1.2"):
        end = next(t.alpha for t in TARGETS if [t.name] == [r["target"] for r in records(transfer, "arrived") if r["path"] == path])
        for call in toy.calls:
            if call["path"] == path and call["next"] is not None:
                assert share_on_segment(call["next"][None], META, end)[1] < 1e-9


@pytest.mark.slow
@pytest.mark.parametrize("lead", [1.0, 0.5])
def test_a_bent_way_killed_and_resumed_is_the_same_run(tmp_path, lead):
    bends = {frozenset(["left", "right"]): Bend(SOURCE.alpha, np.array([1.0 - lead, 1.0, 1.0 - lead]))}
    whole = transfer_of(tmp_path / "whole", config(step="fixed", xi=0.1), Toy(), bends=bends)
    whole.meta_evolve()
    broken = transfer_of(tmp_path / "broken", config(step="fixed", xi=0.1), Toy(kill_after=9), bends=bends)
    with pytest.raises(Killed):
        broken.meta_evolve()
    again = transfer_of(tmp_path / "broken", config(step="fixed", xi=0.1), Toy(), resume=True, bends=bends)
    again.meta_evolve()
    for name in ("left", "right"):
        np.testing.assert_array_equal(again.arrived[name].parameters, whole.arrived[name].parameters)


def test_a_part_of_a_lead_turns_once_and_where_the_edge_does(tmp_path):
    """The second parameter arrives when the others have gone half of their way, however many phases it takes."""
    toy = Toy()
    bends = {frozenset(["left", "right"]): Bend(SOURCE.alpha, np.array([0.5, 1.0, 0.5]))}
    transfer = transfer_of(tmp_path / "run", config(step="fixed", xi=0.1), toy, bends=bends)
    transfer.meta_evolve()
    places = [call["next"] for call in toy.calls if call["path"] == "path 1" and call["next"] is not None]
    turn = np.where(np.arange(3) == 1, META, 0.5 * META)
    off = [min(share_on_segment(place[None], *leg)[1].item() for leg in ((SOURCE.alpha, turn), (turn, META))) for place in places]
    assert len(places) > 3 and max(off) < 1e-9, off
    assert any(np.allclose(place, turn) for place in places)


def ends(folder, targets):
    """Run with a policy that holds everywhere; what arrived when it ended, or after 80 records."""

    def enough(entry, branch):
        if len(records(transfer)) >= 80:
            raise Killed

    transfer = transfer_of(folder, config(), easy_toy(), targets=targets, report=enough)
    try:
        transfer.meta_evolve()
    except Killed:
        events = [r["event"] for r in records(transfer)]
        counts = {event: events.count(event) for event in sorted(set(events))}
        pytest.fail(f"no end after {counts}, {len(transfer.costs)} paths; arrived: {list(transfer.arrived)}")
    return set(transfer.arrived)


def test_a_target_on_the_way_to_another_is_reached(tmp_path):
    near, far = Terminal("near", np.array([0.4, 0.4, 0.0])), Terminal("far", np.array([0.8, 0.8, 0.4]))
    assert ends(tmp_path / "run", [near, far]) == {"near", "far"}


def test_two_targets_at_one_place_are_both_reached(tmp_path):
    twins = [Terminal(name, np.array([0.4, 0.4, 0.0])) for name in ("one", "other")]
    assert ends(tmp_path / "run", twins) == {"one", "other"}


def test_a_target_at_the_source_is_reached(tmp_path):
    assert ends(tmp_path / "run", [Terminal("same", SOURCE.alpha), TARGETS[0]]) == {"same", "left"}


@pytest.mark.parametrize("learner", ["npg", "search"])
def test_a_target_on_the_others_way_is_learned_once_for_all(tmp_path, learner):
    """The branch that gets there trains to the goal before it parts; the target's own has nothing left to learn."""
    near, far = Terminal("near", np.array([0.3, 0.0, 0.0])), Terminal("far", np.array([0.6, 0.0, 0.0]))
    toy = Toy()
    transfer = transfer_of(tmp_path / "run", config(learner=learner, goal=1.0, threshold=0.5), toy, targets=[near, far])
    transfer.meta_evolve()
    paths = {transfer.routes[path][-1]: path for path in transfer.costs}
    assert transfer.costs["path 1"].sim_epochs > 0 and transfer.costs[paths["near"]].sim_epochs == 0
    last = [r for r in records(transfer, "check") if r["path"] == "path 1"][-1]
    assert last["success"] == 1.0, "more than it takes to go on"
    (split,) = [r for r in records(transfer, "split") if r["path"] == paths["far"]]
    assert split["sim_epochs"] == 0
    assert error_at(transfer.arrived["near"], near.alpha) < TOLERANCE and error_at(transfer.arrived["far"], far.alpha) < TOLERANCE

"""Ways that turn: no detour in L1, by parameters that are where the turn says; and pairs of robots drawn from a tree."""

import itertools

import numpy as np
import pytest

from toolkit.capability.ways import LEADS, REST, SIDES, Way, gone_at, leading, pairs_on, turn_in, turning
from toolkit.errors import ToolkitError


def test_a_bent_way_is_as_long_in_l1_and_goes_through_its_corner(arms):
    first, last = arms.space.beta("kinova3"), arms.space.beta("jaco")
    way = Way("kinova3", "jaco", first, last)
    for side, lead in itertools.product(SIDES, (1.0, *LEADS)):
        bent = way.bent(arms.space, leading([side], lead))
        places = np.array([bent.at(share) for share in np.linspace(0.0, 1.0, 101)])
        assert np.abs(np.diff(places, axis=0)).sum() == pytest.approx(np.abs(last - first).sum())
        np.testing.assert_allclose(places[[0, -1]], [first, last], atol=1e-12)
        mine = arms.space.side(side)
        others = np.setdiff1d(np.arange(arms.space.size), mine)
        settled = np.abs(places[:, mine] - last[mine]).max(axis=1) < 1e-9
        gone = np.abs(places[:, others] - first[others]).sum(axis=1) / np.abs(last - first)[others].sum()
        assert np.all(settled | (gone < 1.0 - lead + 1e-9)) and np.all(~settled | (gone > 1.0 - lead - 1e-9))
    assert Way("here", "here", first, first).bent(arms.space, leading(["thumb"])) is None
    assert not set(arms.space.side("thumb")) & set(arms.space.side("fingers"))


def test_digits_go_first_few_before_many(arms):
    way = Way("kinova3", "jaco", arms.space.beta("kinova3"), arms.space.beta("jaco"))
    turns = [list(turn) for turn in way.turns(arms.space)]
    assert turns[:3] == [["FF", REST], ["RF", REST], ["TH", REST]] and ["RF", "TH", REST] in turns, "the Jaco has no middle finger"
    assert turns.index(["FF", REST]) < turns.index(["FF", "RF", REST]) < turns.index(["fingers", REST])


def test_groups_part_the_parameters_by_side_and_quantity(arms):
    groups = arms.space.groups()
    assert sorted(np.concatenate(list(groups.values()))) == list(range(arms.space.size))
    for side in SIDES:
        mine = np.concatenate([dimensions for name, dimensions in groups.items() if name.startswith(f"{side} ")])
        assert sorted(mine) == sorted(arms.space.side(side))


def test_a_turn_says_how_far_each_parameter_has_gone(arms):
    gone = gone_at({"fingers axis": 0.2, "thumb axis": 1.0}, arms.space)
    groups = arms.space.groups()
    assert [set(gone[groups[name]]) for name in ("fingers axis", "thumb axis", "thumb com")] == [{0.2}, {1.0}, {0.5}]
    assert turning(leading(["thumb"], 0.25)) == "thumb first, by 25%" and turning(leading(["RF", "TH"])) == "ring and thumb first"
    assert turning({"a": 0.1, "b": 0.2}) == "turned, by 2 groups of parameters"
    gone = gone_at(leading(["RF"]), arms.space)
    assert set(gone[arms.space.digits()["RF"]]) == {1.0} and set(gone[arms.space.side("thumb")]) == {0.0}
    assert turn_in({"first": "thumb", "lead": 0.25}) == {"thumb": 1.0, REST: 0.75}, "as runs of before have it"
    assert turn_in({"turn": None}) is None
    with pytest.raises(ToolkitError, match="turns by fingers wit, and these robots"):
        gone_at({"fingers wit": 1.0}, arms.space)


def test_pairs_are_drawn_from_the_robots_of_the_tree():
    """Every end lies on one of the ways, and longer ways are drawn as much oftener as they are longer."""
    axis = np.eye(2)
    ways = [Way("a", "b", np.zeros(2), 0.9 * axis[0]), Way("a", "c", np.zeros(2), 0.1 * axis[1])]
    pairs = pairs_on(ways, 2000, np.random.default_rng(3))
    ends = np.array([alpha for pair in pairs for alpha in (pair.first, pair.last)])
    assert ((ends > 0.0).sum(1) == 1).all() and (ends <= [0.9, 0.1]).all()
    assert (ends[:, 0] > 0.0).mean() == pytest.approx(0.9, abs=0.02)
    assert np.median(ends[ends[:, 0] > 0.0, 0]) == pytest.approx(0.45, abs=0.03)
    assert {pair.start.rsplit(maxsplit=1)[0] for pair in pairs} == {"a to b", "a to c"}

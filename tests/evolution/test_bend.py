"""Corners of a way: no detour in L1, and the same corner from anywhere before it."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from toolkit.evolution.bend import Bend, corner

SIZE = 5
points = st.lists(st.sampled_from([0.0, 0.25, 0.5, 1.0]), min_size=SIZE, max_size=SIZE).map(np.array)
groups = st.sets(st.integers(0, SIZE - 1)).map(lambda found: np.array(sorted(found), int))


@given(alpha=points, goal=points, first=groups, lead=st.floats(0.0, 1.0, exclude_min=True))
def test_a_corner_lies_on_a_shortest_way_in_l1(alpha, goal, first, lead):
    turn = corner(alpha, goal, first, lead)
    if turn is None:
        others = np.setdiff1d(np.arange(SIZE), first)
        assert np.array_equal(alpha[first], goal[first]) or np.array_equal(alpha[others], goal[others])
    else:
        legs = np.abs(turn - alpha).sum() + np.abs(goal - turn).sum()
        assert np.isclose(legs, np.abs(goal - alpha).sum())
        assert np.array_equal(turn[first], goal[first])


@given(alpha=points, goal=points, first=groups, share=st.floats(0.0, 0.9), lead=st.sampled_from([0.25, 0.5, 1.0]))
def test_what_is_left_of_a_way_turns_where_the_whole_did(alpha, goal, first, share, lead):
    turn = corner(alpha, goal, first, lead)
    bend = Bend(alpha, first, lead)
    if turn is not None:
        np.testing.assert_allclose(bend.ahead(alpha + share * (turn - alpha), goal), turn, atol=1e-12)
        assert bend.ahead(turn, goal) is None


@given(start=points, alpha=points, goal=points, first=groups, lead=st.sampled_from([0.25, 0.5, 1.0]))
def test_a_corner_is_no_detour_from_anywhere(start, alpha, goal, first, lead):
    turn = Bend(start, first, lead).ahead(alpha, goal)
    if turn is not None:
        assert np.isclose(np.abs(turn - alpha).sum() + np.abs(goal - turn).sum(), np.abs(goal - alpha).sum())
        np.testing.assert_array_equal(turn[first], goal[first])

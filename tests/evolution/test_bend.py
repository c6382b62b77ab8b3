"""Corners of a way: no detour in L1, and the same corner from anywhere before it."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from toolkit.evolution.bend import ARRIVED, Bend, corner

SIZE = 5
points = st.lists(st.sampled_from([0.0, 0.25, 0.5, 1.0]), min_size=SIZE, max_size=SIZE).map(np.array)
shares = st.lists(st.sampled_from([0.0, 0.1, 0.5, 0.75, 1.0]), min_size=SIZE, max_size=SIZE).map(np.array)


@given(alpha=points, goal=points, gone=shares)
def test_a_corner_lies_on_a_shortest_way_in_l1(alpha, goal, gone):
    turn = corner(alpha, goal, gone)
    if turn is None:
        assert len(set(gone[alpha != goal])) <= 1, "all that moves is as far, or nothing moves"
    else:
        legs = np.abs(turn - alpha).sum() + np.abs(goal - turn).sum()
        assert np.isclose(legs, np.abs(goal - alpha).sum())
        np.testing.assert_allclose(np.abs(turn - alpha), gone * np.abs(goal - alpha), atol=1e-12)
        assert np.array_equal(turn[gone == 1.0], goal[gone == 1.0]), "what has arrived has, to the last bit"


@given(alpha=points, goal=points, gone=shares, share=st.floats(0.0, 0.9), beyond=st.floats(0.0, 1.0))
def test_what_is_left_of_a_way_turns_where_the_whole_did(alpha, goal, gone, share, beyond):
    turn, bend = corner(alpha, goal, gone), Bend(alpha, gone)
    if turn is not None:
        np.testing.assert_allclose(bend.ahead(alpha + share * (turn - alpha), goal), turn, atol=1e-12)
        assert bend.ahead(turn + beyond * (goal - turn), goal) is None, "a way turns once"


@given(start=points, alpha=points, goal=points, gone=shares)
def test_a_corner_is_no_detour_from_anywhere(start, alpha, goal, gone):
    turn, whole = Bend(start, gone).ahead(alpha, goal), corner(start, goal, gone)
    if turn is not None:
        assert np.isclose(np.abs(turn - alpha).sum() + np.abs(goal - turn).sum(), np.abs(goal - alpha).sum())
        assert np.abs(turn - alpha).max() > ARRIVED and np.abs(turn - goal).max() > ARRIVED
        assert np.all((turn == whole) | (turn == alpha) | (turn == goal)), "each parameter as far as at the edge's corner, if it may"

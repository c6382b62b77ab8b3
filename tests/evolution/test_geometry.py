"""Distances, the yardstick of every tolerance, and which points are one, against NumPy's norms and a lattice's own corners."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from toolkit.evolution.geometry import TIE, distances, distinct_points, extent

clouds = st.integers(1, 4).flatmap(lambda d: st.lists(st.lists(st.integers(-3, 3), min_size=d, max_size=d), min_size=1, max_size=9))


@pytest.mark.parametrize("metric, order", [("l1", 1), ("l2", 2)])
@given(a=clouds, shift=st.floats(-5, 5))
def test_distances_are_the_norms_of_differences(metric, order, a, shift):
    a = np.array(a, float)
    b = a[: 1 + len(a) // 2] + shift
    wanted = [[np.linalg.norm(p - q, order) for q in b] for p in a]
    np.testing.assert_allclose(distances(a, b, metric), wanted, rtol=1e-12, atol=1e-12)


@given(a=clouds)
def test_the_extent_is_the_longest_side(a):
    a = np.array(a, float)
    assert extent(a) == max(column.max() - column.min() for column in a.T)


@given(a=clouds, scale=st.floats(1e-6, 1e6))
def test_points_of_one_place_are_one(a, scale):
    """On a lattice of any size, each moved by less than what counts as apart."""
    lattice = np.array(a, float)
    jitter = 0.4 * TIE * extent(lattice) * np.sin(np.arange(lattice.size)).reshape(lattice.shape)
    distinct, twin = distinct_points(scale * (lattice + jitter))
    places = [tuple(point) for point in a]
    first = [places.index(place) for place in places]
    assert twin == first and distinct == sorted(set(first))


def test_what_lies_further_apart_than_a_tie_is_two():
    points = np.array([[0.0, 0.0], [0.0, 10 * TIE], [1.0, 0.0]])
    assert distinct_points(points) == ([0, 1, 2], [0, 1, 2])
    points[1, 1] = 0.1 * TIE
    assert distinct_points(points) == ([0, 2], [0, 0, 2])

"""How far a finger's shapes are from the box, against points sampled on them."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from toolkit.morphology.contact import gap_of

HALF = np.array([0.04, 0.025, 0.025])
PUSH = np.array([0.0, 1.0, 0.0])


def gap(centre, turn, size, box):
    """Of one shape whose link stands at the start."""
    one = np.zeros(1, int)
    distance, where, _, _ = gap_of(np.eye(3)[None], np.zeros((1, 3)), one, one, centre[None], turn[None], size[None], np.array([box]),
                                   np.ones(1), PUSH, np.zeros(3), HALF)
    return distance, where


def surface(centre, turn, size, box, rng, count=40_000):
    """Points (n, 3) on a box, or on a capsule along its third axis."""
    if box:
        points = rng.uniform(-1.0, 1.0, (count, 3)) * size
        rows, axis = np.arange(count), rng.integers(3, size=count)
        points[rows, axis] = np.sign(points[rows, axis]) * size[axis]
    else:
        points = rng.standard_normal((count, 3))
        points *= size[0] / np.linalg.norm(points, axis=1)[:, None]
        points[:, 2] += rng.uniform(-1.0, 1.0, count) * size[1]
    return centre + points @ turn.T


angle = st.floats(-1.2, 1.2)


@settings(max_examples=60, deadline=None)
@given(pitch=angle, roll=st.floats(-0.2, 0.2), height=st.floats(-0.04, 0.04), away=st.floats(-0.06, -0.035))
def test_a_slanted_pad_is_as_far_as_its_points_in_front_of_the_box(pitch, roll, height, away):
    """Narrower than the box, as pads are, and at some heights in front of it."""
    turn = Rotation.from_euler("xz", [pitch, roll]).as_matrix()
    centre, size = np.array([0.0, away, height]), np.array([0.01, 0.004, 0.03])
    points = surface(centre, turn, size, True, np.random.default_rng(0))
    front = np.abs(points[:, 2]) <= HALF[2]
    if front.sum() > 100:
        found, where = gap(centre, turn, size, True)
        assert found == pytest.approx(-HALF[1] - points[front, 1].max(), abs=4e-4)
        assert abs(where[2]) <= HALF[2] + 1e-12


@settings(max_examples=60, deadline=None)
@given(pitch=angle, yaw=angle, height=st.floats(-0.02, 0.02), aside=st.floats(-0.03, 0.03), away=st.floats(-0.08, -0.05))
def test_a_slanted_capsule_is_as_far_as_its_points_in_front_of_the_box(pitch, yaw, height, aside, away):
    """Within its radius: it is cut where its axis leaves the box's width and height, and what bulges back from beyond is left out."""
    turn = Rotation.from_euler("xz", [pitch, yaw]).as_matrix()
    centre, size = np.array([aside, away, height]), np.array([0.008, 0.03, 0.0])
    points = surface(centre, turn, size, False, np.random.default_rng(0))
    front = (np.abs(points[:, 2]) <= HALF[2]) & (np.abs(points[:, 0]) <= HALF[0])
    if front.sum() > 200:
        found, _ = gap(centre, turn, size, False)
        true = -HALF[1] - points[front, 1].max()
        assert true - 5e-4 <= found <= true + size[0] + 5e-4


def test_what_leans_over_the_box_or_stands_above_it_is_not_in_contact():
    """A Sawyer's finger: its pad touches, its knuckle reaches 16 mm farther, well above the box."""
    pad, _ = gap(np.array([0.0, -0.029, 0.005]), np.eye(3), np.array([0.004, 0.004, 0.018]), True)
    knuckle, _ = gap(np.array([0.0, -0.0114, 0.0563]), np.eye(3), np.array([0.005, 0.025, 0.009]), True)
    assert pad == pytest.approx(0.0, abs=1e-12) and knuckle > 0.04


@settings(max_examples=40, deadline=None)
@given(pitch=st.floats(-1.0, 1.0), height=st.floats(-0.08, 0.08), box=st.booleans())
def test_the_distance_moves_evenly(pitch, height, box):
    """Also where a shape comes to be in front of the box: no step of a micrometre jumps."""
    turn, size = Rotation.from_euler("x", pitch).as_matrix(), np.array([0.01, 0.006, 0.02])
    near, far = (gap(np.array([0.0, -0.04, height + step]), turn, size, box)[0] for step in (0.0, 1e-6))
    assert abs(near - far) < 2e-5

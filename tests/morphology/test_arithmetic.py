"""Compiled arithmetic, against NumPy, SciPy and MuJoCo."""

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from toolkit.morphology.arithmetic import bones, principal, quaternion, turned


def inertia_from_gyration(mass, root):
    """Inertias (n, 3, 3) by their definition: with the second moment S = m G G, I = tr(S) - S."""
    matrix = root[:, [0, 3, 4, 3, 1, 5, 4, 5, 2]].reshape(-1, 3, 3)
    moment = mass[:, None, None] * (matrix @ matrix)
    return np.trace(moment, axis1=1, axis2=2)[:, None, None] * np.eye(3) - moment


finite = st.floats(-1.0, 1.0)
vectors = st.tuples(finite, finite, finite).map(np.array)


@given(mass=st.floats(1e-3, 20.0), root=st.tuples(*[st.floats(-0.3, 0.3)] * 6).map(np.array))
def test_principal_moments_in_their_frame_are_the_inertia(mass, root):
    moments, frames = principal(np.array([mass]), root[None], 0.0)
    rotation = Rotation.from_quat(frames[0], scalar_first=True).as_matrix()
    wanted = inertia_from_gyration(np.array([mass]), root[None])[0]
    assert abs(np.linalg.norm(frames[0]) - 1) < 1e-12
    np.testing.assert_allclose(rotation @ np.diag(moments[0]) @ rotation.T, wanted, atol=1e-12 * max(1.0, mass))


@given(turn=vectors)
def test_a_quaternion_is_its_matrix(turn):
    rotation = Rotation.from_rotvec(3 * turn)
    back = Rotation.from_quat(quaternion(rotation.as_matrix()), scalar_first=True)
    assert (back * rotation.inv()).magnitude() < 1e-7


@given(turn=vectors, reference=vectors)
def test_a_turn_comes_after_its_reference(turn, reference):
    start = Rotation.from_rotvec(3 * reference)
    got = turned(3 * turn[None], start.as_quat(scalar_first=True)[None])[0]
    wanted = Rotation.from_rotvec(3 * turn) * start
    assert (Rotation.from_quat(got, scalar_first=True) * wanted.inv()).magnitude() < 1e-7


@given(anchor=vectors, tip=vectors)
def test_a_bone_reaches_from_anchor_to_tip(anchor, tip):
    assume(np.linalg.norm(tip - anchor) > 1e-6)
    centre, frame, size = (out[0] for out in bones(anchor[None], tip[None], np.array([0.01]), 1e-5))
    axis = Rotation.from_quat(frame, scalar_first=True).as_matrix()[:, 2]
    reach = max(size[1], 0.5 * np.linalg.norm(tip - anchor))
    np.testing.assert_allclose(anchor + centre + reach * axis, tip, atol=1e-9)
    np.testing.assert_allclose(anchor + centre - reach * axis, anchor, atol=1e-9)
    assert size[0] == 0.01


def test_a_bone_straight_down_has_a_frame():
    _, frame, size = bones(np.zeros((1, 3)), np.array([[0.0, 0.0, -0.4]]), np.array([0.01]), 1e-5)
    np.testing.assert_allclose(Rotation.from_quat(frame[0], scalar_first=True).as_matrix()[:, 2], [0, 0, -1], atol=1e-12)
    assert size[0, 1] == pytest.approx(0.2)

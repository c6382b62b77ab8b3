"""The compiled control step: algebra against NumPy, SciPy and robosuite, motion against robosuite's own env.step."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from robosuite.utils.control_utils import nullspace_torques, opspace_matrices
from scipy.spatial.transform import Rotation

from robots import ROBOTS
from tasks.pick import ACTION_SIZE
from toolkit.morphology.native_scene import NativeScene
from toolkit.simulation.osc import NULL_KP, SINGULAR, base_rotation, cholesky, osc_torque, rotation_from_vector, solve_factored

vectors = st.tuples(*[st.floats(-4.0, 4.0)] * 3).map(np.array)
seeds = st.integers(0, 2**32 - 1)


def positive_definite(rng, n, smallest=0.05):
    """Symmetric, eigenvalues between ``smallest`` and 5: an arm's mass matrix."""
    frame = np.linalg.qr(rng.standard_normal((n, n)))[0]
    return frame @ np.diag(rng.uniform(smallest, 5.0, n)) @ frame.T


# -- algebra -------------------------------------------------------------------------------------------------


@given(vector=vectors)
def test_rotation_from_vector_is_scipys(vector):
    off = np.abs(rotation_from_vector(vector) - Rotation.from_rotvec(vector).as_matrix()).max()
    assert off < 1e-12, f"rotation of {vector} is off by {off:.1e}"


def test_a_vanishing_rotation_is_none():
    np.testing.assert_array_equal(rotation_from_vector(np.zeros(3)), np.eye(3))
    off = np.abs(
        rotation_from_vector(np.array([0.0, 1e-9, 0.0])) - Rotation.from_rotvec([0, 1e-9, 0]).as_matrix()
    ).max()
    assert off < 1e-12, f"off by {off:.1e}"


@given(turned=st.floats(-3, 3), follows=st.sampled_from([0.0, 0.5, 1.0]))
def test_the_base_turns_by_its_share(turned, follows):
    axis = np.array([0.0, 0.6, 0.8])
    wanted = Rotation.from_rotvec(follows * turned * axis).as_matrix()
    np.testing.assert_allclose(base_rotation(follows, turned, axis), wanted, atol=1e-12)


@given(seed=seeds, n=st.integers(1, 8), leading=st.integers(1, 8))
def test_a_factor_and_its_leading_blocks_solve_as_numpy_does(seed, n, leading):
    rng = np.random.default_rng(seed)
    matrix, leading = positive_definite(rng, n), min(n, leading)
    right, low = rng.standard_normal(leading), np.empty((n, n))
    assert SINGULAR < cholesky(matrix, low) <= 1.0
    solution = right.copy()
    solve_factored(low, leading, solution)
    off = np.abs(solution - np.linalg.solve(matrix[:leading, :leading], right)).max()
    assert off < 1e-9, f"solution of {leading} of {n} equations is off by {off:.1e}"


def test_an_indefinite_matrix_says_so():
    low = np.zeros((2, 2))
    assert cholesky(np.diag([1.0, -1.0]), low) == 0.0 and np.isnan(low).any()


def robosuites_torque(mass, jacobian, force, bias, start, q, qd):
    """robosuite's matrices with its pseudo-inverses, assembled as controllers/parts/arm/osc.py does."""
    _, lambda_position, lambda_rotation, null = opspace_matrices(mass, jacobian, jacobian[:3], jacobian[3:])
    wrench = np.concatenate([lambda_position @ force[:3], lambda_rotation @ force[3:]])
    return jacobian.T @ wrench + bias + nullspace_torques(mass, null, start, q, qd, joint_kp=NULL_KP)


@given(seed=seeds, lost=st.sampled_from([None, 0, 2, 4]))
def test_torques_are_robosuites(seed, lost):
    """Also where the arm is singular: there the grasp frame cannot move along one axis at all."""
    rng = np.random.default_rng(seed)
    mass, jacobian = positive_definite(rng, 7), rng.standard_normal((6, 7))
    if lost is not None:
        jacobian[lost] = 0.0
    force, bias = rng.uniform(-20, 20, 6), rng.uniform(-30, 30, 7)
    start, q, qd = rng.uniform(-1, 1, 7), rng.uniform(-1, 1, 7), rng.uniform(-1, 1, 7)
    wanted = robosuites_torque(mass, jacobian, force, bias, start, q, qd)
    posture = NULL_KP * (start - q) - 2 * np.sqrt(NULL_KP) * qd
    off = np.abs(osc_torque(mass, jacobian, force, bias, posture) - wanted).max() / np.abs(wanted).max()
    assert off < 1e-6, f"torques are off by {off:.1e} of the largest"


def test_a_mass_matrix_that_is_none_gives_no_number():
    torque = osc_torque(-np.eye(7), np.eye(6, 7), np.ones(6), np.zeros(7), np.zeros(7))
    assert np.isnan(torque).all()


# -- motion --------------------------------------------------------------------------------------------------


def gentle_actions(seed, steps=40):
    """Small random OSC deltas that carry the arm up and about, gripper kept open."""
    rng = np.random.default_rng(seed)
    actions = np.full((steps, ACTION_SIZE), -1.0)
    actions[:, :6] = rng.uniform(-0.2, 0.2, (steps, 6))
    actions[:10, 2] += 0.4
    return actions


@pytest.mark.parametrize("name", list(ROBOTS))
@pytest.mark.parametrize("seed", [0, 1])
def test_two_seconds_agree_with_robosuites_own_step(native, native_fast, name, seed, record_property):
    """Same model, state and actions; 40 policy steps of robosuite's env.step beside the compiled control step."""
    slow, fast = native(name), native_fast(name)
    slow.begin(seed)
    fast.begin(seed)
    arm = NativeScene(slow.model).arm_qpos
    np.testing.assert_allclose(slow.data.qpos, fast.data.qpos, atol=1e-12, err_msg="they start apart")
    worst = 0.0
    for action in gentle_actions(seed):
        slow.step(action)
        fast.step(action)
        worst = max(worst, float(np.abs(slow.data.qpos[arm] - fast.data.qpos[arm]).max()))
    moved = np.abs(fast.data.qpos[arm] - fast.start[arm]).max()
    record_property("radians", worst)
    assert moved > 0.02, f"{name}: the arm moved {moved} rad only, which tests nothing"
    assert slow.data.time == pytest.approx(2.0)
    assert worst < 1e-6, f"{name}: arm qpos {worst:.1e} rad from robosuite's env.step within 2 s"


@pytest.mark.parametrize("name", sorted(ROBOTS))
def test_torques_stay_within_the_arms_limits(native_fast, name):
    plant = native_fast(name)
    rng = np.random.default_rng(0)
    for scale in (1.0, 1e6):
        for _ in range(5):
            plant.step(scale * rng.uniform(-1, 1, ACTION_SIZE))
            arm = len(NativeScene(plant.model).arm)
            low, high = plant.model.actuator_ctrlrange[:arm].T
            torques = plant.data.ctrl[:arm]
            assert (torques >= low).all() and (torques <= high).all(), f"{name}: {torques} N m"


def test_an_action_beyond_one_is_one(native_fast):
    plant, ends = native_fast("kinova3"), []
    for size in (1.0, 50.0):
        plant.begin(0)
        action = np.full(ACTION_SIZE, -1.0)
        action[:6] = size * np.array([1, 0, 1, 0, 0, 0])
        for _ in range(3):
            plant.step(action)
        ends.append(np.array(plant.data.qpos))
    np.testing.assert_array_equal(*ends)

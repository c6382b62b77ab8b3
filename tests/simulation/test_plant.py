"""Command laws against their formula in NumPy, addresses in the mass matrix against MuJoCo's full one, and what counts as diverged."""

import mujoco
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from toys import HAND

from grippers.gripper import CLOSING_ROLES, COMMANDED_ROLES
from robots import ROBOTS
from toolkit.errors import ToolkitError
from toolkit.morphology.grasp import Course
from toolkit.simulation.plant import CLOSING, SPEED_LIMIT, CommandLaw, all_finite, blew_up, command_law, mass_addresses

N = len(COMMANDED_ROLES)
unit = st.floats(-1.0, 1.0)
commands = st.lists(unit, min_size=N, max_size=N).map(np.array)


def law(**changes):
    """Two actuators, of the first and the last role, over a course that turns twice."""
    course = Course(np.array([[-1.0, -0.2, 0.3, 1.0], [-1.0, 0.0, 0.5, 1.0]]), np.array([[0.1, 0.4, 0.5, 0.9], [0.8, 0.2, 0.1, -0.3]]))
    own = {"common": 0.0, "gain": 1.0, "leak": 1.0, "rate": 0.3, "preshape": -0.5, "course": course, "role": np.array([0, N - 1])}
    return CommandLaw(**own | changes)


@given(state=commands, action=commands, common=st.floats(0.0, 1.0), gain=st.floats(0.0, 1000.0), leak=st.floats(0.0, 1.0),
       rate=st.floats(0.0, 2.0))
def test_the_command_follows_its_formula(state, action, common, gain, leak, rate):
    """s+ = clip(s + clip(K u - leak s, -rate, rate), -1, 1), u between each role's own action and the closing roles' mean."""
    closing = [COMMANDED_ROLES.index(role) for role in CLOSING_ROLES]
    u = (1 - common) * action + common * action[closing].mean()
    wanted = np.clip(state + np.clip(gain * u - leak * state, -rate, rate), -1, 1)
    found = law(common=common, gain=gain, leak=leak, rate=rate).advance(state, action)
    np.testing.assert_allclose(found, wanted, rtol=1e-12, atol=1e-9)


@given(state=commands)
def test_targets_lie_on_the_course(state):
    found = law()
    wanted = [np.interp(state[role], xs, ys) for role, xs, ys in zip(found.role, found.course.commands, found.course.targets, strict=True)]
    np.testing.assert_allclose(found.targets(state), wanted, atol=1e-12)


def test_progress_counts_from_the_preshape_to_closed():
    at = lambda s: law().progress(np.full(N, s))  # noqa: E731
    assert (at(-0.5), at(0.25), at(1.0)) == pytest.approx((-1.0, 0.0, 1.0)) and at(-1.0) < -1
    state = np.zeros(N)
    state[CLOSING[0]] = 1.0
    assert law().progress(state) == pytest.approx(2 * (1 / len(CLOSING) + 0.5) / 1.5 - 1), "the mean of the closing roles"


@pytest.mark.parametrize("name", sorted(ROBOTS))
def test_a_grippers_law_integrates_a_sign_and_a_hands_follows(name):
    """At the ends of the command stand the card's own targets."""
    gripper, found = ROBOTS[name].gripper, command_law(ROBOTS[name])
    state, action = np.full(N, 0.1), np.full(N, -0.4)
    if gripper.rate is None:
        wanted = state + np.clip(action - state, -found.rate, found.rate)
    else:
        wanted = np.maximum(state - gripper.rate, -1.0)
    np.testing.assert_allclose(found.advance(state, action), wanted, atol=1e-12)
    for command, ends in zip((-1.0, 1.0), np.array(list(gripper.targets.values())).T, strict=True):
        np.testing.assert_allclose(found.targets(np.full(N, command)), ends, atol=1e-12)


# -- the mass matrix ---------------------------------------------------------------------------------------------------


def test_addresses_are_the_full_matrix_entries():
    model = mujoco.MjModel.from_xml_string(HAND)
    data = mujoco.MjData(model)
    data.qpos[:3] = 0.1, -0.3, 0.2
    mujoco.mj_forward(model, data)
    full = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, full, data.qM)
    for names in (("lift",), ("lift", "thumb"), ("lift", "finger")):
        dofs = np.array([model.joint(name).dofadr[0] for name in names])
        np.testing.assert_allclose(data.qM[mass_addresses(model, dofs)], full[np.ix_(dofs, dofs)], rtol=0, atol=0)


@pytest.mark.parametrize("names, culprit", [(("thumb", "lift"), "thumb"), (("lift", "thumb", "finger"), "finger")])
def test_joints_that_are_no_chain_are_named(names, culprit):
    """Listed from the tip, or of two fingers: their entries of the matrix would be another joint's."""
    model = mujoco.MjModel.from_xml_string(HAND)
    dofs = np.array([model.joint(name).dofadr[0] for name in names])
    with pytest.raises(ToolkitError, match=f"joint '{culprit}' does not follow the arm's others along one chain"):
        mass_addresses(model, dofs)


# -- what counts as diverged -------------------------------------------------------------------------------------------


def test_a_simulation_that_was_reset_is_one_that_blew_up(log_elsewhere):
    model = mujoco.MjModel.from_xml_string(HAND)
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data)
    assert not blew_up(data)
    data.qvel[0] = np.nan
    mujoco.mj_step(model, data)
    assert np.isfinite(data.qvel).all() and blew_up(data), "MuJoCo has reset it, and only its warning tells"


@pytest.mark.parametrize("speed, blown", [(0.99 * SPEED_LIMIT, False), (-1.01 * SPEED_LIMIT, True), (np.nan, True), (np.inf, True)])
def test_no_joint_moves_faster_than_can_be(speed, blown):
    data = mujoco.MjData(mujoco.MjModel.from_xml_string(HAND))
    data.qvel[4] = speed
    assert blew_up(data) == blown


@given(values=st.lists(st.sampled_from([0.0, -1e300, np.nan, np.inf, -np.inf]), max_size=5), cut=st.integers(0, 5))
def test_all_finite_is_numpys(values, cut):
    first, second = np.array(values[:cut], float), np.array(values[cut:], float)
    assert all_finite(first, second) == bool(np.isfinite(values).all())

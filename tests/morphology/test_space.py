"""The evolution space: every robot is a point of it, and between them lies what can be built."""

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from robots import ROBOTS
from toolkit.errors import ToolkitError
from toolkit.morphology.arithmetic import directions
from toolkit.morphology.space import axis_to_tangent, gyration, tangent_basis

every_robot = pytest.mark.parametrize("name", list(ROBOTS))


def inertia_from_gyration(mass, root):
    """Inertias (n, 3, 3) by their definition: with the second moment S = m G G, I = tr(S) - S."""
    matrix = root[:, [0, 3, 4, 3, 1, 5, 4, 5, 2]].reshape(-1, 3, 3)
    moment = mass[:, None, None] * (matrix @ matrix)
    return np.trace(moment, axis1=1, axis2=2)[:, None, None] * np.eye(3) - moment


def entries(space, theta):
    """Parameter name -> value, for every entry of theta, spelled from the fields rather than from their offsets."""
    out = {}
    for f in space.fields.values():
        for row, item in enumerate(f.items):
            for column, component in enumerate(f.components):
                out[".".join(part for part in (item, f.name, component) if part)] = theta[f.name][row, column]
    return out


# -- every robot is a point of the space ---------------------------------------------------------------------


@every_robot
def test_theta_at_beta_is_the_robots_own(space, name):
    index = space.matching.names.index(name)
    theta = space.theta(space.beta(name))
    worst, where = 0.0, ""
    for f in space.fields.values():
        own = f.values[index]
        off = np.abs(theta[f.name] - own) / np.maximum(1.0, np.abs(own))
        if off.size and off.max() > worst:
            worst, where = float(off.max()), f.name
    assert worst < 1e-9, f"theta(beta_{name}).{where} is off by {worst:.1e}"


@every_robot
def test_theta_at_beta_is_what_the_matching_read(space, name):
    """By name and from the joints themselves, not from the space's own table."""
    system = space.matching.systems[space.matching.names.index(name)]
    theta = space.theta(space.beta(name))
    for row, joint in enumerate(system.joints):
        if joint is None:
            continue
        preshape = system.robot.gripper.preshape
        start_target = joint.target_open + 0.5 * (preshape + 1.0) * (joint.target_closed - joint.target_open)
        got = {key: theta[key][row] for key in ("anchor", "com", "mass", "limits", "damping", "armature", "start_target")}
        wanted = {
            "anchor": joint.screw.anchor, "com": joint.screw.com, "mass": joint.screw.mass, "limits": joint.limits,
            "damping": joint.damping, "armature": joint.armature, "start_target": start_target,
        }
        for key, value in wanted.items():
            np.testing.assert_allclose(
                got[key], value, rtol=1e-9, atol=1e-9, err_msg=f"{space.matching.slots[row].name}.{key}"
            )
        inertia = inertia_from_gyration(theta["mass"][row], theta["gyration"][row : row + 1])[0]
        np.testing.assert_allclose(
            inertia, joint.screw.inertia, rtol=1e-6, atol=1e-9, err_msg=space.matching.slots[row].name
        )
    axes = directions(theta["axis"], space.axis_references, space.axis_bases)
    for row, joint in enumerate(system.joints):
        if joint is not None:
            np.testing.assert_allclose(axes[row], joint.screw.axis, atol=1e-9, err_msg=space.matching.slots[row].name)


@every_robot
def test_what_a_robot_lacks_is_massless_frozen_and_without_shape(space, name):
    index = space.matching.names.index(name)
    system, theta = space.matching.systems[index], space.theta(space.beta(name))
    for row, slot in enumerate(space.matching.slots):
        if not system.present(row):
            for field, value in (("mass", 0.0), ("freeze", 1.0), ("stiffness", 0.0), ("friction_loss", 0.0)):
                got = theta[field][row, 0]
                assert got == value, f"{name} lacks {slot.name}, yet its {field} is {got}"
    for row, shape in enumerate(space.shape_slots):
        wanted = float(shape.owners[index] is not None)
        got = theta["shape_presence"][row, 0]
        assert got == wanted, f"{name}: {shape.name} has presence {got}, {wanted} expected"
    for row, coupling in enumerate(space.coupling_slots):
        if coupling.owners[index] is None:
            assert theta["coupling_held"][row, 0] == 0 == theta["coupling_stiffness"][row, 0], (
                f"{name}: {coupling.name} holds"
            )


def test_betas_are_corners_or_between_and_all_different(space):
    assert space.betas.min() >= 0 and space.betas.max() <= 1
    names = space.matching.names
    for i in range(len(names)):
        for j in range(i):
            assert np.abs(space.betas[i] - space.betas[j]).max() > 0.1, f"{names[i]} and {names[j]} are one point"


# -- and between them ----------------------------------------------------------------------------------------


@settings(max_examples=30)
@given(seed=st.integers(0, 2**32 - 1), corner=st.booleans())
def test_every_parameter_stays_within_its_bounds(space, seed, corner):
    rng = np.random.default_rng(seed)
    alpha = rng.integers(0, 2, space.size).astype(float) if corner else rng.random(space.size)
    values = entries(space, space.theta(alpha))
    for p in space.parameters:
        slack = 1e-12 * max(1.0, abs(p.low), abs(p.high))
        assert p.low - slack <= values[p.name] <= p.high + slack, (
            f"{p.name} = {values[p.name]} outside [{p.low}, {p.high}]"
        )


def test_each_dimension_moves_its_own_parameters_and_all_of_them(space):
    middle = np.full(space.size, 0.5)
    before = entries(space, space.theta(middle))
    for dimension in range(0, space.size, 7):
        alpha = middle.copy()
        alpha[dimension] = 0.75
        after = entries(space, space.theta(alpha))
        moved = {name for name in before if after[name] != before[name]}
        wanted = {p.name for p in space.parameters if p.dimension == dimension}
        assert moved == wanted, f"alpha[{dimension}] moves {sorted(moved ^ wanted)} against the record"
        for p in space.parameters:
            if p.dimension == dimension:
                share = (after[p.name] - before[p.name]) / (p.high - p.low)
                assert abs(share - (-0.25 if p.flipped else 0.25)) < 1e-9, f"{p.name} moves by {share} of its range"


def test_a_dimension_stays_within_one_element(space):
    for dimension in range(space.size):
        elements = {p.element for p in space.parameters if p.dimension == dimension}
        assert len(elements) == 1, f"alpha[{dimension}] moves {sorted(elements)} together"


def test_names_are_unique_and_say_where_each_robot_stands(space):
    described = space.describe()
    names = [d["name"] for d in described]
    twice = {n for n in names if names.count(n) > 1}
    assert not twice, f"{sorted(twice)} name more than one parameter"
    for d in described:
        assert list(d["values"]) == list(ROBOTS)
        assert d["low"] == min(d["values"].values()) < max(d["values"].values()) == d["high"], d["name"]
        assert d["unit"], f"{d['name']} has no unit"


@pytest.mark.parametrize(
    "value, sentence", [(1.5, r"alpha\[3\] = 1.5 lies outside \[0, 1\]"), (-0.1, r"alpha\[3\] = -0.1 lies"),
                        (np.nan, r"alpha\[3\] = nan"), (np.inf, r"alpha\[3\] = inf")],
)
def test_an_alpha_outside_the_space_is_named(space, value, sentence):
    alpha = np.full(space.size, 0.9)
    alpha[3] = value
    with pytest.raises(ToolkitError, match=sentence):
        space.theta(alpha)


def test_an_alpha_of_the_wrong_size_is_named(space):
    with pytest.raises(
        ToolkitError, match=rf"alpha has shape \(3,\); this evolution space has {space.size} dimensions"
    ):
        space.theta(np.zeros(3))
    with pytest.raises(ToolkitError, match="robot 'r2d2' is not in this evolution space; it has adroit"):
        space.beta("r2d2")


def test_beta_is_a_copy(space):
    space.beta("jaco")[:] = 7.0
    assert space.betas.max() <= 1.0


# -- coordinates ---------------------------------------------------------------------------------------------


finite = st.floats(-1.0, 1.0)
vectors = st.tuples(finite, finite, finite).map(np.array)


@given(mass=st.floats(1e-4, 20.0), radii=st.tuples(*[st.floats(0.0, 0.5)] * 3), turn=vectors)
def test_gyration_gives_the_inertia_back(mass, radii, turn):
    frame = Rotation.from_rotvec(3 * turn).as_matrix()
    moment = mass * frame @ np.diag(np.square(radii)) @ frame.T
    inertia = np.trace(moment) * np.eye(3) - moment
    back = inertia_from_gyration(np.array([mass]), gyration(mass, inertia)[None])[0]
    scale = max(np.abs(inertia).max(), 1e-12)
    off = np.abs(back - inertia).max() / scale
    assert off < 1e-9, f"inertia comes back {off:.1e} off"


@given(masses=st.tuples(*[st.floats(1e-3, 10.0)] * 2), roots=st.tuples(*[st.tuples(*[st.floats(-0.3, 0.3)] * 6)] * 2),
       share=st.floats(0.0, 1.0))
def test_between_two_links_lies_a_possible_link(masses, roots, share):
    """Principal moments are positive and obey the triangle inequality, wherever two gyrations are mixed."""
    mix = (1 - share) * np.array(roots[0]) + share * np.array(roots[1])
    mass = (1 - share) * masses[0] + share * masses[1]
    moments = np.linalg.eigvalsh(inertia_from_gyration(np.array([mass]), mix[None])[0])
    slack = 1e-12 * max(1.0, moments[-1])
    assert moments[0] >= -slack and moments[2] <= moments[0] + moments[1] + slack, f"principal moments {moments}"


@given(first=vectors, second=vectors)
def test_an_axis_comes_back_from_its_tangent(first, second):
    assume(min(np.linalg.norm(first), np.linalg.norm(second)) > 1e-3)
    reference, axis = first / np.linalg.norm(first), second / np.linalg.norm(second)
    assume(reference @ axis > -0.999)
    tangent = axis_to_tangent(axis, reference)
    angle = np.arctan2(np.linalg.norm(np.cross(reference, axis)), reference @ axis)
    assert abs(np.linalg.norm(tangent) - angle) < 1e-9, f"tangent {np.linalg.norm(tangent)} long, angle {angle} rad"
    back = directions(tangent[None], reference[None], np.array([tangent_basis(reference)]))[0]
    off = np.abs(back - axis).max()
    assert off < 1e-9, f"axis comes back {off:.1e} off"


@given(reference=vectors, tangent=st.tuples(st.floats(-3, 3), st.floats(-3, 3)).map(np.array))
def test_every_tangent_is_a_direction(reference, tangent):
    assume(np.linalg.norm(reference) > 1e-3)
    reference = reference / np.linalg.norm(reference)
    first, second = basis = np.array(tangent_basis(reference))
    np.testing.assert_allclose(
        np.array([reference, first, second]) @ np.array([reference, first, second]).T, np.eye(3), atol=1e-12
    )
    axis = directions(tangent[None], reference[None], basis[None])[0]
    assert abs(np.linalg.norm(axis) - 1) < 1e-12, f"axis of length {np.linalg.norm(axis)}"


def test_boxes_do_not_tumble_between_two_pads(space):
    """Every shape's turn between two robots that own it is the smallest that its symmetry allows: under 45 degrees here."""
    for slot, turns in zip(space.shape_slots, np.swapaxes(space.fields["shape_rotation"].values, 0, 1), strict=True):
        owned = [turn for turn, owner in zip(turns, slot.owners, strict=True) if owner is not None]
        assert all(np.linalg.norm(turn) < np.pi / 4 for turn in owned), slot.name

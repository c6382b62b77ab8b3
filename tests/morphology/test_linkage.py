"""Linkages as open chains: the springs that are fitted give back the torques that were measured."""

import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from robots import ROBOTS
from toolkit.errors import ToolkitError
from toolkit.morphology import linkage
from toolkit.morphology.linkage import become_box, closed_on_box, equivalent_linkages

FOUR_BAR = [name for name, robot in ROBOTS.items() if robot.gripper.four_bar]


def torques_by_hand(hold, stop, slack, gear, cost, curve, q, p):
    """The model in the module's docstring, one state at a time: the derivative of its energy, by differences."""

    def energy(q, p):
        way = curve[0] * q + curve[1] * q**2
        pushed = max(0.0, slack - (p - gear * q))
        return (
            0.5 * hold * (p - way) ** 2 + 0.5 * stop * pushed**2 + cost[0] * q + cost[1] * q**2 / 2 + cost[2] * q**3 / 3
        )

    step = 1e-6
    return np.array([
        -(energy(q + step, p) - energy(q - step, p)) / (2 * step),
        -(energy(q, p + step) - energy(q, p - step)) / (2 * step),
    ])


@given(q=st.floats(0.0, 0.8), p=st.floats(-0.6, 0.6))
def test_the_springs_are_one_energys_derivative(q, p):
    """So an open chain with them neither makes nor loses work."""
    parameters, curve = np.array([0.9, 5.0, 0.02, -0.2, 0.6, 15.0, -15.0]), np.array([-0.1, 2.2])
    got = linkage._torques(parameters, curve, np.array([q]), np.array([p]))[:, 0]
    wanted = torques_by_hand(*parameters[:4], parameters[4:], curve, q, p)
    np.testing.assert_allclose(got, wanted, atol=1e-6)


def recorded(truth, curve, q, p, speeds):
    """(n, 2, 3, 2) records of known springs and a known damper: moving at speeds (n,), then settled."""
    springs = linkage._torques(truth, curve, q, p)
    rows = []
    for speed in (speeds, np.zeros_like(speeds)):
        torques = springs - np.stack([truth[7] * speed, np.zeros_like(speed)])
        rows.append(np.stack([np.stack([q, p]), torques, np.stack([speed, np.zeros_like(speed)])]))
    return np.array(rows).transpose(3, 0, 1, 2)


@settings(max_examples=5)
@given(
    hold=st.floats(0.5, 5.0), stop=st.floats(1.0, 6.0), slack=st.floats(-0.05, -0.01), stiff=st.floats(5.0, 18.0),
    damping=st.floats(0.3, 1.6),
)
def test_a_known_linkage_is_found_again(hold, stop, slack, stiff, damping):
    """Records made from known springs and a known damper give their torques back, on states that were not recorded too."""
    curve, truth = np.array([0.1, 0.8]), np.array([hold, stop, slack, 0.0, 0.4, stiff, -3.0, damping])
    q = np.linspace(0.0, 0.4, 12)
    air = recorded(truth, curve, q, curve[0] * q + curve[1] * q**2, np.linspace(0.1, 0.8, 12))
    q, p = (grid.ravel() for grid in np.meshgrid(np.linspace(0.2, 0.5, 4), np.linspace(-0.4, 0.0, 3)))
    loaded = recorded(truth, curve, q, p, np.linspace(0.4, 0.1, 12))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(linkage, "STOP_WEIGHT", 0.0)  # which prefers no stop to a stop
        found, way = linkage._fitted(air, loaded)
    np.testing.assert_allclose(way, curve, atol=1e-9)
    assert found[7] == pytest.approx(damping, abs=0.02)
    q, p = np.array([0.15, 0.33, 0.45]), np.array([0.03, -0.2, -0.35])
    np.testing.assert_allclose(
        linkage._torques(found, way, q, p), linkage._torques(truth, curve, q, p), atol=0.02,
        err_msg=f"found {found}, true {truth}",
    )


@given(u=st.floats(-0.5, 1.0), a=st.floats(5.0, 20.0), b=st.floats(-16.0, 5.0), q=st.floats(0.1, 0.8))
def test_mujocos_spring_costs_what_the_linkage_did(u, a, b, q):
    stiffness, quadratic, rest = linkage._spring(u, a, b)
    spec = mujoco.MjSpec()
    spec.compiler.degree = False
    body = spec.worldbody.add_body(mass=1, inertia=[1, 1, 1], explicitinertial=True)
    body.add_joint(name="knuckle", stiffness=[stiffness, quadratic, 0], springref=rest)
    model = spec.compile()
    data = mujoco.MjData(model)
    data.qpos[0] = q
    mujoco.mj_forward(model, data)
    if rest < q:
        assert data.qfrc_passive[0] == pytest.approx(-(u + a * q + b * q * q), abs=1e-9)


def test_the_merged_robot_carries_what_was_measured(matching, space):
    for name in FOUR_BAR:
        system = matching.systems[matching.names.index(name)]
        assert len(system.curves) == len(system.couplings) == 2, f"{name} has {len(system.curves)} curves"
        theta = space.theta(space.beta(name))
        for slot, curve in zip(space.curve_slots, system.curves, strict=True):
            row = space.curve_slots.index(slot)
            np.testing.assert_allclose(theta["curve"][row], curve.coefficients, atol=1e-9)
            assert theta["curve_stiffness"][row, 0] == pytest.approx(curve.stiffness)
            spring = theta["spring_share"][curve.driven, 0] * theta["stiffness"][curve.driven, 0]
            assert spring == pytest.approx(system.joints[curve.driven].spring) != 0


def test_pads_are_held_as_softly_as_was_measured(merged, space):
    """The constraint's spring, felt by hand: torque over displacement at rest."""
    for name in FOUR_BAR:
        model, data = merged.new()
        merged.become(space.beta(name), model, data)
        index = space.matching.names.index(name)
        for slot in space.curve_slots:
            curve = slot.owners[index]
            equality = model.equality(slot.name).id
            pad = model.joint(space.matching.slots[slot.pad].name)
            mujoco.mj_resetData(model, data)
            data.qpos[pad.qposadr[0]] = -0.01
            model.dof_armature[:] = 1e9  # nothing moves, so that the force is that of the spring alone
            mujoco.mj_forward(model, data)
            row = [i for i in range(data.nefc) if data.efc_type[i] == 0 and data.efc_id[i] == equality]
            torque = float(data.efc_force[row[0]])
            merged.become(space.beta(name), model, data)
            assert torque == pytest.approx(0.01 * curve.stiffness, rel=0.02), f"{name} {slot.name}"


def test_jaws_that_start_closed_are_named(native, monkeypatch):
    own, robot = native(FOUR_BAR[0]), ROBOTS[FOUR_BAR[0]]
    monkeypatch.setattr(linkage, "WIDTHS", (0.3,))
    monkeypatch.setattr(linkage, "COMMANDS", (-1.0, 0.0, 0.2))
    signs = dict.fromkeys(robot.gripper.joints, 1.0)
    with pytest.raises(ToolkitError, match=f"gripper {robot.gripper.name}: its linkage cannot be measured"):
        equivalent_linkages(own.model, own.data, robot, signs, np.array(own.data.site("gripper0_right_grip_site").xpos))


def test_a_box_is_as_wide_as_asked(native):
    import copy

    model = copy.copy(native(FOUR_BAR[0]).model)
    free = next(j for j in range(model.njnt) if model.jnt_type[j] == mujoco.mjtJoint.mjJNT_FREE)
    become_box(model, int(model.jnt_bodyid[free]), 0.06)
    sizes = model.geom_size[model.geom_bodyid == model.jnt_bodyid[free]]
    assert (sizes[:, 1] == 0.03).all()


def test_a_box_is_slippery_and_the_linkage_is_not(native):
    """Where a finger's geom touches the box its friction is the box's; between the meshes of the linkage it stays robosuite's."""
    own, robot = native(FOUR_BAR[0]), ROBOTS[FOUR_BAR[0]]
    signs = dict.fromkeys(robot.gripper.joints, 1.0)
    bench = linkage._Bench(own.model, np.array(own.data.qpos), robot, signs, tuple(robot.gripper.targets))
    become_box(bench.model, bench.item, 0.06)
    bench.close(np.array(own.data.site("gripper0_right_grip_site").xpos), 1.0)
    touching = bench.model.geom_bodyid[bench.data.contact.geom] == bench.item
    frictions = bench.data.contact.friction[:, 0]
    assert np.any(touching) and np.all(frictions[touching.any(axis=1)] == linkage.SLIPPERY)
    inside = ~touching.any(axis=1) & (bench.model.geom_bodyid[bench.data.contact.geom] > 0).all(axis=1)
    assert np.any(inside) and np.all(frictions[inside] > 0.5)


def test_the_pads_feel_what_robosuites_do_while_they_close(merged, native, task):
    """Both grippers close on a box at their own rate: the force on it, step by step."""
    from toolkit.benchmarks.parity import _force_on, _merged_side, _native_side

    for name in FOUR_BAR:
        mine, own = _merged_side(merged, merged.space.matching.names.index(name)), _native_side(ROBOTS[name], task)
        forces = []
        for side in (mine, own):
            model, data = side.clamped()
            become_box(model, side.item, 0.05)
            address = int(model.jnt_qposadr[model.body_jntadr[side.item]])
            data.qpos[address : address + 7] = (*side.plant.data.site_xpos[side.site], 1.0, 0.0, 0.0, 0.0)
            law, row = side.plant.law, []
            for command in np.arange(law.preshape + law.rate, 1.01, law.rate):
                side.close_to(model, data, min(command, 1.0), 1.0 / side.plant.task.control_frequency)
                row.append(_force_on(model, data, side.item))
            forces.append(row)
        assert max(forces[1]) > 10, f"{name} grips with {max(forces[1]):.1f} N"
        assert np.abs(np.subtract(*forces)).max() < 0.35 * max(forces[1]), f"{name}: {np.round(forces, 1)} N"


def test_the_closed_bench_leaves_the_model_alone(pair):
    model, data = pair.merged.new()
    pair.merged.become(pair.space.beta("kinova3"), model, data)
    before = model.geom_friction.copy(), model.opt.gravity.copy()
    closed_on_box(model, model.qpos0, [0], model.body("object").id, [7], lambda command: np.zeros(1), -1.0)
    assert np.array_equal(before[0], model.geom_friction) and np.array_equal(before[1], model.opt.gravity)
    assert isinstance(model, mujoco.MjModel)

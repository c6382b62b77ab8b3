"""The audit tells sound robots from broken ones, and names what broke them; the robots in between keep the promise on a sample."""

import itertools
import json
from dataclasses import replace

import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from robots import ROBOTS
from tasks import TASKS
from tasks.pick import ACTION_SIZE, START_ROTATION
from toolkit.benchmarks import parity
from toolkit.capability.audit import LEADS, SIDES, Audit, Violation, Way, allowed, reserve, run_audit, verdict, violations, ways_of
from toolkit.capability.bench import Bench, Capability
from toolkit.capability.figure import ROWS, audit_figure, save_audit
from toolkit.errors import ToolkitError
from toolkit.morphology.lab import Lab
from toolkit.morphology.linkage import BOX_WIDTH, closed_on_box
from toolkit.simulation.laws import merged_plant


@pytest.fixture(scope="module")
def lab(task):
    """The three arms of the paper."""
    return Lab(ROBOTS["adroit"], [ROBOTS[name] for name in ("jaco", "kinova3", "iiwa")], task)


@pytest.fixture(scope="module")
def bench(lab):
    return Bench(lab.merged)


def robot(**numbers):
    base = {"grip_n": 20.0, "grip_by_width": {}, "balance": 0.9, "height_mm": 0.0, "askew_nmm": 0.0, "opening_mm": 80.0,
            "closing_steps": 8.0, "reach_mm": 20.0, "clearance_mm": 5.0}
    return Capability(**base | numbers)


# ---- the bench -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["adroit", "jaco", "kinova3", "iiwa"])
def test_the_grip_is_what_the_parity_measures(lab, bench, name):
    """By another route: its own plant, its own squeeze."""
    index = lab.space.matching.names.index(name)
    plant = merged_plant(lab.merged, lab.space.betas[index], *lab.merged.new())
    plant.begin(0)
    mine = bench.squeeze(plant, parity.WIDTH)[0].total
    assert mine == pytest.approx(parity.squeeze(parity._merged_side(lab.merged, index)), rel=0.02, abs=0.1)


def test_a_gripper_without_motors_grips_nothing(lab, bench, monkeypatch):
    plant = merged_plant(lab.merged, lab.space.beta("kinova3"), *lab.merged.new())
    plant.model.actuator_forcerange[:] = 0.0
    plant.begin(0)
    assert bench.squeeze(plant, 0.05)[0].total < 0.5


def test_forces_on_a_clamped_box_balance_with_its_own_constraint(lab, bench):
    """Sides, sum and place of the forces against MuJoCo's generalised force on the box."""
    plant = merged_plant(lab.merged, lab.space.beta("jaco"), *lab.merged.new())
    plant.begin(0)
    _, (model, data) = bench.squeeze(plant, 0.05)
    row = bench._forces(model, data)
    item = model.body("object").id
    dofs = model.jnt_dofadr[model.body_jntadr[item]] + np.arange(3)
    pushed = data.qfrc_constraint[dofs]
    across = row[2] - row[1]  # the fingers push along y, the thumb against it
    assert across == pytest.approx(pushed[1], abs=0.05)


@pytest.mark.slow
def test_what_the_script_holds_on_the_ends_is_measured(lab, bench):
    assert bench.script(lab.space.beta("kinova3"), 3) == 1.0
    limp = lab.space.beta("kinova3")
    far = replace(bench.merged.task, goal_tolerance=1e-9)
    other = Bench(lab.merged)
    other.merged = type("Elsewhere", (), {"task": far, "space": lab.space, "become": lab.merged.become, "driven": lab.merged.driven})()
    assert other.script(limp, 1) == 0.0


def test_an_alpha_outside_the_box_is_refused(lab, bench):
    with pytest.raises(ToolkitError, match=r"lies outside \[0, 1\]"):
        bench.measure(np.full(lab.space.size, 1.2))


# ---- the promise ---------------------------------------------------------------------------------------------------

sane = st.builds(
    robot, grip_n=st.floats(1, 100), balance=st.floats(0, 1), height_mm=st.floats(-20, 20), opening_mm=st.floats(20, 150),
    closing_steps=st.floats(1, 150),
)


@settings(max_examples=200)
@given(first=sane, last=sane, share=st.floats(0, 1))
def test_whatever_lies_between_the_ends_keeps_the_promise(first, last, share):
    mix = lambda name: (1 - share) * getattr(first, name) + share * getattr(last, name)  # noqa: E731
    names = ("grip_n", "balance", "height_mm", "opening_mm", "closing_steps")
    assert violations({0.0: first, 0.5: robot(**{name: mix(name) for name in names}), 1.0: last}) == []


@pytest.mark.parametrize("quantity, value", [
    ("grip_n", 15.9), ("grip_n", 25.1), ("balance", 0.79), ("height_mm", 5.1), ("height_mm", -5.1), ("opening_mm", 70.0),
    ("closing_steps", 10.0), ("closing_steps", None),
])
def test_whatever_lies_outside_breaks_it(quantity, value):
    found = violations({0.0: robot(), 0.4: robot(**{quantity: value}), 1.0: robot()})
    assert [(v.share, v.quantity) for v in found] == [(0.4, quantity)]
    json.dumps(found[0].to_json(), allow_nan=False)
    assert "asked" in found[0].sentence()


def test_a_script_must_hold_only_where_it_holds_at_both_ends():
    holds, fails = robot(script=1.0), robot(script=0.5)
    assert [v.quantity for v in violations({0.0: holds, 0.5: fails, 1.0: holds})] == ["script"]
    assert violations({0.0: holds, 0.5: fails, 1.0: fails}) == []
    assert allowed("script", robot(), holds) is None


def test_an_end_that_cannot_hold_promises_nothing():
    way = Way("hand", "jaw", np.zeros(1), np.ones(1))
    assert "grips the object with 0.00 N" in reserve(way, robot(), robot(grip_n=0.0), 0.05)
    assert "jaw opens by 40 mm and the object is 50 mm wide" in reserve(way, robot(), robot(opening_mm=40.0), 0.05)
    assert reserve(way, robot(), robot(), 0.05) is None


# ---- the audit -----------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_broken_motor_is_found_and_named(lab, monkeypatch):
    """A law that lets the thumb's motor vanish half way is a cliff: the audit must find it, and blame the thumb."""
    thumb, index = lab.merged.law.fingers.index("TH"), lab.space.matching.names.index("iiwa")
    dims = lab.merged.law._dimensions[thumb]
    first, last = lab.space.beta("kinova3"), lab.space.betas[index]
    moved = np.abs(last - first)[dims].sum()
    sound = type(lab.merged.law).motors

    def broken(self, alpha, p, model, data):
        motors = sound(self, alpha, p, model, data)
        share = np.abs(alpha - first)[dims].sum() / moved
        weak = np.where(self._finger_of == thumb, 0.02 if 0.3 < share < 0.7 else 1.0, 1.0)
        return replace(motors, limit=motors.limit * weak)

    monkeypatch.setattr(type(lab.merged.law), "motors", broken)
    way = Way("kinova3", "iiwa", first, last)
    audit = Audit(lab.merged, robots=5, episodes=0, brief=True, threads=2)
    edge = audit.along(way)
    audit.close()
    worst = next(v for v in edge.violations if v.quantity == "balance")
    assert 0.25 < worst.share < 0.75
    causes = [v.cause for v in edge.violations if v.cause is not None]
    assert any(cause.startswith("TH") for cause in causes), causes
    assert "worse robots" in verdict([edge])


@pytest.mark.slow
def test_nothing_is_wrong_between_two_linkages(lab, tmp_path):
    way = Way("kinova3", "iiwa", lab.space.beta("kinova3"), lab.space.beta("iiwa"))
    (edge,) = run_audit(lab.merged, [way], robots=5, episodes=1, causes=False, threads=2)
    grips = [robot.grip_n for robot in edge.robots.values()]
    assert not [v for v in edge.violations if v.quantity in ("grip_n", "script")], [v.sentence() for v in edge.violations]
    assert max(grips) <= 1.25 * max(r.grip_n for r in edge.ends), grips
    content = [edge.to_json()]
    assert set(content[0]) == {"from", "to", "first", "lead", "reserve", "robots", "violations"} and len(content[0]["robots"]) >= 5
    json.dumps(content, allow_nan=False)
    save_audit(content, tmp_path / "audit.png")
    assert (tmp_path / "audit.png").stat().st_size > 10_000
    with pytest.raises(ToolkitError, match="name a .png or .svg file"):
        save_audit(content, tmp_path / "audit.xyz")


@pytest.mark.slow
def test_where_both_sides_at_once_cannot_hold_one_goes_first(lab, tmp_path):
    """To the Jaco the script drops the object half way, unless the fingers have arrived before the thumb sets out."""
    tree = lab.tree("l1", "steiner")
    way = next(way for way in ways_of(tree) if way.end == "jaco")
    (straight,), (bent,) = (
        run_audit(lab.merged, [way], bend=bend, robots=3, episodes=3, scripted=1, causes=False, brief=True, threads=2)
        for bend in (False, True)
    )
    assert "script" in {v.quantity for v in straight.violations} and straight.way.ahead is None
    assert bent.way.ahead in SIDES and bent.robots[0.5].script == 1.0 and bent.broken < straight.broken
    assert "bent" in verdict([bent]) and bent.to_json()["first"] == bent.way.ahead


def test_a_bent_way_is_as_long_in_l1_and_goes_through_its_corner(lab):
    first, last = lab.space.beta("kinova3"), lab.space.beta("jaco")
    way = Way("kinova3", "jaco", first, last)
    for side, lead in itertools.product(SIDES, LEADS):
        bent = way.bent(lab.space, side, lead)
        places = np.array([bent.at(share) for share in np.linspace(0.0, 1.0, 101)])
        assert np.abs(np.diff(places, axis=0)).sum() == pytest.approx(np.abs(last - first).sum())
        np.testing.assert_allclose(places[[0, -1]], [first, last], atol=1e-12)
        mine = lab.space.side(side)
        others = np.setdiff1d(np.arange(lab.space.size), mine)
        settled = np.abs(places[:, mine] - last[mine]).max(axis=1) < 1e-9
        gone = np.abs(places[:, others] - first[others]).sum(axis=1) / np.abs(last - first)[others].sum()
        assert np.all(settled | (gone < 1.0 - lead + 1e-9)) and np.all(~settled | (gone > 1.0 - lead - 1e-9))
    assert Way("here", "here", first, first).bent(lab.space, "thumb") is None
    assert not set(lab.space.side("thumb")) & set(lab.space.side("fingers"))


@pytest.mark.slow
def test_the_grip_along_the_paper_s_tree_keeps_the_promise(lab):
    """The thin part of the promise that a test can afford: grip on every edge, brief."""
    edges = run_audit(lab.merged, ways_of(lab.tree("l1", "steiner")), robots=7, episodes=0, causes=False, brief=True, threads=2)
    broken = [(e.way.start, e.way.end, v.sentence()) for e in edges for v in e.violations if v.quantity == "grip_n"]
    assert not broken, broken


@pytest.mark.slow
def test_what_changes_on_a_short_way_is_told(lab):
    audit = Audit(lab.merged, brief=True, threads=2)
    told = audit.change(Way("here", "next", lab.space.beta("kinova3"), lab.space.beta("jaco")))
    assert told.startswith("grip force falls from") and "within" in told
    assert "hardly changes" in audit.change(Way("here", "next", lab.space.beta("jaco"), lab.space.beta("jaco")))
    audit.close()


def test_an_audit_of_too_few_robots_is_refused(lab):
    with pytest.raises(ToolkitError, match="2 robots per edge or more"):
        Audit(lab.merged, robots=1)


def test_a_violation_without_a_value_is_the_worst():
    assert Violation(0.5, "closing_steps", np.inf, (0.0, 10.0)).excess == np.inf


# ---- the law behind it ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", list(ROBOTS))
def test_at_a_robot_the_motors_are_its_own(merged, space, name):
    """The derived targets, over the whole closing command, and limits against the robot's own, read from its own model."""
    index, (model, data) = space.matching.names.index(name), merged.new()
    course = merged.become(space.betas[index], model, data)
    preshape = space.matching.systems[index].robot.gripper.preshape
    for row, slot in enumerate(merged.driven):
        joint = space.matching.systems[index].joints[slot]
        if joint is None or joint.stiffness == 0.0:
            continue
        actuator = model.actuator(space.matching.slots[slot].name).id
        for command in np.linspace(preshape, 1.0, 9):
            own = joint.target_open + (command + 1.0) / 2.0 * (joint.target_closed - joint.target_open)
            assert course(command)[row] == pytest.approx(own, abs=1e-6)
        assert model.actuator_forcerange[actuator, 1] == pytest.approx(joint.force_limit, rel=1e-6)
        assert model.actuator_gainprm[actuator, 0] == pytest.approx(joint.stiffness, rel=1e-9)


@settings(max_examples=15)
@given(seed=st.integers(0, 10**6), share=st.floats(0.05, 0.95))
def test_the_motors_move_evenly(lab, seed, share):
    """A thousandth of a way changes no motor's pull by more than the least that a motor may have, nor its limit by as much again."""
    rng = np.random.default_rng(seed)
    one, other = lab.space.betas[rng.choice(len(lab.space.betas), 2, replace=False)]
    model, data = lab.merged.new()
    found = []
    for at in (share, share + 1e-3):
        alpha = one + at * (other - one)
        p = lab.merged.write(alpha, model, data)
        found.append(lab.merged.law.motors(alpha, p, model, data))
    before, after = found
    pull = np.abs(after.course(1.0) * after.gain - before.course(1.0) * before.gain)
    assert pull.max() < 0.8, pull
    assert (np.abs(after.limit - before.limit) / np.maximum(before.limit, 0.5)).max() < 0.8


def _squeezed(lab, alpha):
    """The bench's model and data, gripper closed on the reference box, as the plant at ``alpha`` commands it."""
    bench = Bench(lab.merged)
    plant = merged_plant(lab.merged, alpha, bench._model, bench._data)
    plant.begin(0)
    return bench.squeeze(plant, BOX_WIDTH)[1]


def _leans(model, data):
    """How far [deg] the faces of the pads that touch the box lean from its own."""
    item, across, out = model.body("object").id, START_ROTATION[:, 0], []
    for pair in data.contact.geom:
        bodies = model.geom_bodyid[pair]
        if item in bodies:
            pad = pair[0] if bodies[1] == item else pair[1]
            if model.geom_type[pad] == mujoco.mjtGeom.mjGEOM_BOX and model.geom_bodyid[pad] != 0:
                facing = np.abs(data.geom_xmat[pad].reshape(3, 3).T @ across).max()
                out.append(np.degrees(np.arccos(min(facing, 1.0))))
    return out


def test_pads_lie_flat_between_linkages(lab):
    """Read from MuJoCo's own frames: neither at the tree's meta robots nor half way between two linkages does a pad touch with an edge."""
    metas = [node.alpha for node in lab.tree("l1", "steiner").nodes if node.name.startswith("meta")]
    assert metas
    for alpha in (*metas, 0.5 * (lab.space.beta("kinova3") + lab.space.beta("iiwa"))):
        leans = _leans(*_squeezed(lab, alpha))
        assert leans and max(leans) < 5.0, leans


def test_a_held_tendon_leads_its_pad_on_the_curve(lab):
    """The way that the space gives to the Jaco's pads, against where they go in free air."""
    index = lab.space.matching.names.index("jaco")
    model, data = lab.merged.new()
    plant = merged_plant(lab.merged, lab.space.beta("jaco"), model, data)
    plant.begin(0)
    for told in (1.0, 0.0):  # close, and come to rest there
        action = np.zeros(ACTION_SIZE)
        action[6:] = told
        for _ in range(40):
            plant.step(action)
    for curve in lab.space.curve_slots:
        way = curve.owners[index]
        driven, pad = (data.qpos[model.joint(lab.space.matching.slots[slot].name).qposadr[0]] for slot in (curve.driven, curve.pad))
        assert abs(driven) > 0.1
        assert pad == pytest.approx(way.coefficients[0] * driven + way.coefficients[1] * driven**2, abs=0.02)


def test_the_static_model_is_mujoco_s_own(merged, space):
    """What the law thinks that springs and constraints hold, against MuJoCo after it came to rest on the box."""
    law = merged.law
    for robot_index in range(len(space.betas)):
        error = space.betas[robot_index] @ law._slope + law._offset
        driven = [k for k, slot in enumerate(merged.driven)
                  if (joint := space.matching.systems[robot_index].joints[slot]) is not None and joint.stiffness > 0
                  and space.matching.slots[slot].name in ("FFJ2", "THJ4", "FFS", "THS")]
        off = np.abs(error[law._cuts["error"]])[driven]
        assert off.max() < 0.05, f"{space.matching.names[robot_index]}: {off}"


def test_boxes_do_not_tumble_between_two_pads(space):
    """Every shape's turn between two robots that own it is the smallest that its symmetry allows: under 45 degrees here."""
    for slot, turns in zip(space.shape_slots, np.swapaxes(space.fields["shape_rotation"].values, 0, 1), strict=True):
        owned = [turn for turn, owner in zip(turns, slot.owners, strict=True) if owner is not None]
        assert all(np.linalg.norm(turn) < np.pi / 4 for turn in owned), slot.name


def test_the_closed_bench_leaves_the_model_alone(lab):
    model, data = lab.merged.new()
    lab.merged.become(lab.space.beta("kinova3"), model, data)
    before = model.geom_friction.copy(), model.opt.gravity.copy()
    closed_on_box(model, model.qpos0, [0], model.body("object").id, [7], lambda command: np.zeros(1), -1.0)
    assert np.array_equal(before[0], model.geom_friction) and np.array_equal(before[1], model.opt.gravity)
    assert isinstance(model, mujoco.MjModel) and TASKS


def test_a_picture_has_rows_for_what_was_measured_alone():
    robot = dict.fromkeys(ROWS) | {"grip_n": 20.0}
    edges = [{"from": "s", "to": name, "first": None, "violations": [],
              "robots": [robot | {"share": share, "height_mm": 3.0 + share if name == "a" else None} for share in (0.0, 1.0)]}
             for name in ("a", "b")]
    panels = audit_figure(edges).axes
    assert len(panels) == 4 and [axes.get_ylabel() for axes in panels if axes.get_ylabel()] == ["grip [N]", "height [mm]"]
    assert [len(axes.lines) > 0 for axes in panels] == [True, True, True, False], "b was not measured for height"

"""The law of the fingers' motors: each robot's own at that robot, even in between, and pads that lie flat on what they hold."""

import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from robots import ROBOTS
from tasks.pick import ACTION_SIZE, START_ROTATION
from toolkit.capability.bench import Bench
from toolkit.morphology.contact import SLIP
from toolkit.morphology.linkage import BOX_WIDTH
from toolkit.simulation.laws import merged_plant


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
def test_the_motors_move_evenly(arms, seed, share):
    """A thousandth of a way changes no motor's pull by more than the least that a motor may have, nor its limit by as much again."""
    rng = np.random.default_rng(seed)
    one, other = arms.space.betas[rng.choice(len(arms.space.betas), 2, replace=False)]
    model, data = arms.merged.new()
    found = []
    for at in (share, share + 1e-3):
        alpha = one + at * (other - one)
        p = arms.merged.write(alpha, model, data)
        found.append(arms.merged.law.motors(alpha, p, model, data))
    before, after = found
    pull = np.abs(after.course(1.0) * after.gain - before.course(1.0) * before.gain)
    assert pull.max() < 0.8, pull
    assert (np.abs(after.limit - before.limit) / np.maximum(before.limit, 0.5)).max() < 0.8


def _squeezed(arms, alpha):
    """The bench's model and data, gripper closed on the reference box, as the plant at ``alpha`` commands it."""
    bench = Bench(arms.merged)
    plant = merged_plant(arms.merged, alpha, bench._model, bench._data)
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


def test_pads_lie_flat_between_linkages(arms):
    """Read from MuJoCo's own frames: neither at the tree's meta robots nor half way between two linkages does a pad touch with an edge."""
    metas = [node.alpha for node in arms.tree("l1", "steiner").nodes if node.name.startswith("meta")]
    assert metas
    for alpha in (*metas, 0.5 * (arms.space.beta("kinova3") + arms.space.beta("iiwa"))):
        leans = _leans(*_squeezed(arms, alpha))
        assert leans and max(leans) < 5.0, leans


def test_a_held_tendon_leads_its_pad_on_the_curve(arms):
    """The way that the space gives to the Jaco's pads, against where they go in free air."""
    index = arms.space.matching.names.index("jaco")
    model, data = arms.merged.new()
    plant = merged_plant(arms.merged, arms.space.beta("jaco"), model, data)
    plant.begin(0)
    for told in (1.0, 0.0):  # close, and come to rest there
        action = np.zeros(ACTION_SIZE)
        action[6:] = told
        for _ in range(40):
            plant.step(action)
    for curve in arms.space.curve_slots:
        way = curve.owners[index]
        driven, pad = (data.qpos[model.joint(arms.space.matching.slots[slot].name).qposadr[0]] for slot in (curve.driven, curve.pad))
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


@pytest.mark.parametrize("name", ["panda", "sawyer"])
def test_a_slide_is_asked_for_no_more_than_its_lock_lets_its_motor(merged, space, name):
    """Where a jaw's slide wakes or freezes, the posture on the box leaves it where 20 N hold it: the other joints have to get there."""
    law, (model, data) = merged.law, merged.new()
    slides = np.flatnonzero(law._sliding)
    for share in (0.02, 0.05, 0.1, 0.15):
        alpha = space.beta("adroit") + share * (space.beta(name) - space.beta("adroit"))
        patch = merged.write(alpha, model, data)
        motors = law.motors(alpha, patch, model, data)  # leaves the posture on the box in data
        way = data.qpos[law._qpos[slides]]
        lock = model.jnt_stiffness[law._joints[slides]]
        assert (np.abs(way) * lock < 1.5 * motors.limit[slides]).all(), (share, way, lock, motors.limit[slides])


def test_a_grip_acts_between_where_it_does_at_the_ends(arms):
    """Measured on MuJoCo's contacts, on the way to a jaw, where all of the thumb's joints freeze but two: while their motors were relieved
    of what only the jaw's own locks bear, its pad leaned, and the grip was up to 4 mm lower than at either end."""
    bench, (hand, jaw) = Bench(arms.merged), (arms.space.beta(name) for name in ("adroit", "kinova3"))
    first, *between, last = (bench.measure(hand + share * (jaw - hand), 0, "closed") for share in (0.0, 0.25, 0.5, 0.75, 1.0))
    for robot in between:
        assert first.height_mm - 1.0 < robot.height_mm < last.height_mm + 1.0
    assert between[1].askew_nmm < 0.6 * first.askew_nmm


def test_a_robot_s_own_pads_are_not_moved(merged, space):
    """They are only where no robot's own posture is: at a robot, every shape stands where its patch says."""
    model, data = merged.new()
    for beta in space.betas:
        p = merged.write(beta, model, data)
        assert np.abs(merged.law.motors(beta, p, model, data).slips).max() < 1e-7
    between = 0.5 * (space.betas[0] + space.beta("iiwa"))
    slips = np.linalg.norm(merged.law.motors(between, merged.write(between, model, data), model, data).slips, axis=1)
    assert 1e-3 < slips.max() <= SLIP + 1e-9

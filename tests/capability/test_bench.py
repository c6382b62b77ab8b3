"""The bench measures a grip as the parity does, and its forces balance."""

from dataclasses import replace

import numpy as np
import pytest

from toolkit.benchmarks import parity
from toolkit.capability.bench import Bench
from toolkit.capability.ways import leading, ways_of
from toolkit.errors import ToolkitError
from toolkit.simulation.laws import merged_plant


@pytest.fixture(scope="module")
def bench(arms):
    return Bench(arms.merged)


@pytest.mark.parametrize("name", ["adroit", "jaco", "kinova3", "iiwa"])
def test_the_grip_is_what_the_parity_measures(arms, bench, name):
    """By another route: its own plant, its own squeeze."""
    index = arms.space.matching.names.index(name)
    plant = merged_plant(arms.merged, arms.space.betas[index], *arms.merged.new())
    plant.begin(0)
    mine = bench.squeeze(plant, parity.WIDTH)[0].total
    assert mine == pytest.approx(parity.squeeze(parity._merged_side(arms.merged, index)), rel=0.02, abs=0.1)


def test_a_gripper_without_motors_grips_nothing(arms, bench, monkeypatch):
    plant = merged_plant(arms.merged, arms.space.beta("kinova3"), *arms.merged.new())
    plant.model.actuator_forcerange[:] = 0.0
    plant.begin(0)
    assert bench.squeeze(plant, 0.05)[0].total < 0.5


def test_forces_on_a_clamped_box_balance_with_its_own_constraint(arms, bench):
    """Sides, sum and place of the forces against MuJoCo's generalised force on the box."""
    plant = merged_plant(arms.merged, arms.space.beta("jaco"), *arms.merged.new())
    plant.begin(0)
    _, (model, data) = bench.squeeze(plant, 0.05)
    row = bench._forces(model, data)
    item = model.body("object").id
    dofs = model.jnt_dofadr[model.body_jntadr[item]] + np.arange(3)
    pushed = data.qfrc_constraint[dofs]
    across = row[2] - row[1]  # the fingers push along y, the thumb against it
    assert across == pytest.approx(pushed[1], abs=0.05)


@pytest.mark.slow
def test_what_the_script_holds_on_the_ends_is_measured(arms, bench):
    assert bench.script(arms.space.beta("kinova3"), 3) == 1.0
    limp = arms.space.beta("kinova3")
    far = replace(bench.merged.task, goal_tolerance=1e-9)
    other = Bench(arms.merged)
    other.merged = type("Elsewhere", (), {"task": far, "space": arms.space, "become": arms.merged.become, "driven": arms.merged.driven})()
    assert other.script(limp, 1) == 0.0


@pytest.mark.slow
def test_a_script_that_holds_is_no_tolerance(arms, bench):
    """Half way from a jaw to the Jaco one finger of two has moved aside before the other presses, and spins the object, unless the other is
    there first: no policy was seen to lift anything on the one, every one does on the other."""
    way = next(way for way in ways_of(arms.tree("l1", "steiner")) if way.end == "jaco")
    bent = way.bent(arms.space, leading(["RF", "TH"]))
    ends = [bench.tolerance(alpha, 1) for alpha in (way.first, way.last)]
    assert min(ends) > 0.8
    assert bench.tolerance(way.at(0.5), 1) < 0.4 < 0.8 * min(ends) < bench.tolerance(bent.at(0.5), 1)


def test_an_alpha_outside_the_box_is_refused(arms, bench):
    with pytest.raises(ToolkitError, match=r"lies outside \[0, 1\]"):
        bench.measure(np.full(arms.space.size, 1.2))

"""What the merge keeps of each robot: F(beta) beside the unmodified robosuite robot, measured."""

import json

import mujoco
import numpy as np
import pytest

from robots import ROBOTS
from toolkit.benchmarks import parity as measure
from toolkit.benchmarks.parity import parity
from toolkit.errors import ToolkitError
from toolkit.morphology.matching import CUBE

KEYS = [
    "name", "arm_fk_error_m", "arm_mass_matrix_rel_error", "pad_position_error_m", "pad_angle_error_deg",
    "pad_force_rel_error", "closing_time_difference_steps", "grasp_frame_drift_m",
]
LIMITS = {
    "arm_fk_error_m": 1e-6, "arm_mass_matrix_rel_error": 1e-6, "pad_position_error_m": 2e-3, "pad_angle_error_deg": 2.0,
    "pad_force_rel_error": 0.1, "closing_time_difference_steps": 1.0, "grasp_frame_drift_m": 1e-3,
}


@pytest.fixture(scope="module")
def figures(merged):
    measured = {}

    def of(name):
        if name not in measured:
            measured[name] = parity(merged, ROBOTS[name])
        return measured[name]

    return of


@pytest.mark.slow
@pytest.mark.parametrize("figure", LIMITS)
@pytest.mark.parametrize("name", ROBOTS)
def test_the_merge_keeps(figures, name, figure, record_property):
    value = figures(name)[figure]
    record_property(figure, value)
    print(f"{name}: {figure} = {value:.3g}")
    assert value <= LIMITS[figure], f"{name}: {figure} is {value:.3g}, the limit {LIMITS[figure]:g}"


@pytest.mark.slow
def test_figures_are_json_with_the_agreed_keys(figures):
    record = figures("adroit")
    assert list(record) == KEYS
    assert json.loads(json.dumps(record, allow_nan=False)) == record


@pytest.mark.slow
def test_the_same_figures_every_time(figures, merged):
    assert parity(merged, ROBOTS["jaco"]) == figures("jaco")


def test_another_robots_merge_would_be_noticed(merged):
    """kinova3's pads and arm beside jaco's: the measurement tells robots apart."""
    names = merged.space.matching.names
    mine = measure._merged_side(merged, names.index("kinova3"))
    own = measure._native_side(ROBOTS["jaco"], merged.task)
    fk, mass = measure.arm_errors(mine, own, merged.space.matching.systems[names.index("jaco")])
    assert fk > 0.05 and mass > 0.01, f"another arm is only {fk:.3f} m and {mass:.3f} away"
    assert measure.drift(mine, own) > 1e-4


@pytest.mark.parametrize("name", list(ROBOTS))
def test_pads_are_as_large_as_the_robots_and_start_where_they_do(merged, name):
    index = merged.space.matching.names.index(name)
    mine, own = measure._merged_side(merged, index), measure._native_side(ROBOTS[name], merged.task)
    assert set(mine.pads) == set(own.pads) >= {"FF", "TH"}
    poses = [side.pad_poses(side.plant.data) for side in (mine, own)]
    for finger in own.pads:
        got, wanted = (side.plant.model.geom_size[side.pads[finger]] for side in (mine, own))
        # The same solid may be described by other axes of its own: a box in 24 ways, each with its sizes in another order.
        turn = min(CUBE.as_matrix(), key=lambda t: np.linalg.norm(poses[1][finger][1] @ t - poses[0][finger][1]))
        if mine.plant.model.geom_type[mine.pads[finger]] == mujoco.mjtGeom.mjGEOM_BOX:
            np.testing.assert_allclose(got, np.abs(turn.T) @ wanted, rtol=1e-9)
            np.testing.assert_allclose(poses[0][finger][1], poses[1][finger][1] @ turn, atol=1e-6)
        else:
            np.testing.assert_allclose(got, wanted, rtol=1e-9)
            np.testing.assert_allclose(np.abs(poses[0][finger][1][:, 2] @ poses[1][finger][1][:, 2]), 1.0, atol=1e-9)
        np.testing.assert_allclose(poses[0][finger][0], poses[1][finger][0], atol=1e-6)


def test_the_clamped_arm_and_the_box_stay_where_they_are(merged):
    side = measure._merged_side(merged, merged.space.matching.names.index("kinova3"))
    model, data = side.clamped()
    before = np.array(side.plant.data.site_xpos[side.site])
    side.close_to(model, data, 1.0, 2.0)
    moved = float(np.linalg.norm(data.site_xpos[side.site] - before))
    assert moved < 1e-3, f"the clamped grasp frame moved {1e3 * moved:.2f} mm in 2 s"
    assert measure.squeeze(side) > 1.0


def test_a_robot_that_was_not_merged_is_refused(merged):
    class Stranger:
        name = "spot"

    with pytest.raises(ToolkitError, match="'spot' is not in this merged robot; it has adroit"):
        parity(merged, Stranger())

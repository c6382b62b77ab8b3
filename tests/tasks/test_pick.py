"""Picks: starts are drawn from the seed within their noise, and records say what is observed."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from tasks import TASKS
from tasks.pick import ACTION, ACTION_SIZE, GOAL_OFFSET, OBJECT_XY, OBSERVATION, OBSERVATION_SIZE, START_ROTATION, is_lost, observe
from tasks.table import TABLE_TOP

every_task = pytest.mark.parametrize("task", TASKS.values(), ids=list(TASKS))
seeds = st.integers(0, 2**63)


def test_lost_is_measured_below_the_table():
    assert is_lost(np.array([0.0, 0.0, TABLE_TOP - 0.05]))
    assert not is_lost(np.array([0.0, 0.0, TABLE_TOP + 0.001]))


@every_task
@given(seed=seeds)
def test_a_start_lies_within_its_noise(task, seed):
    pose, goal = task.sample_start(np.random.default_rng(seed))
    shift = np.abs(pose[:2] - OBJECT_XY).max()
    assert shift <= task.noise_xy, f"seed {seed}: object {shift} m from its place, noise {task.noise_xy} m"
    assert abs(pose[2] - TABLE_TOP - task.object.half_height) < 1e-12, (
        f"seed {seed}: object floats or sinks, z {pose[2]}"
    )
    turned = Rotation.from_quat(pose[3:], scalar_first=True).as_rotvec()
    assert np.abs(turned[:2]).max() < 1e-12 and abs(turned[2]) <= task.noise_yaw + 1e-12, (
        f"seed {seed}: turned {turned} rad"
    )
    np.testing.assert_allclose(goal - pose[:3], GOAL_OFFSET, atol=1e-12)


@every_task
@given(seed=seeds)
def test_a_start_is_the_seeds_alone(task, seed):
    first, second = (np.concatenate(task.sample_start(np.random.default_rng(seed))) for _ in range(2))
    np.testing.assert_array_equal(first, second)


def test_starts_fill_their_noise():
    task = TASKS["061_foam_brick-wide"]
    poses = np.array([task.sample_start(np.random.default_rng(seed))[0] for seed in range(300)])
    shift = (poses[:, :2] - OBJECT_XY) / task.noise_xy
    yaw = 2 * np.arctan2(poses[:, 6], poses[:, 3]) / task.noise_yaw
    for values in (*shift.T, yaw):
        assert values.min() < -0.9 and values.max() > 0.9 and abs(values.mean()) < 0.15, (
            "300 starts do not fill the noise"
        )


def test_records_add_up():
    assert OBSERVATION_SIZE == sum(OBSERVATION.values()) == len(OBSERVATION.numbers("scale"))
    assert ACTION_SIZE == sum(ACTION.values())
    assert (OBSERVATION.numbers("scale") > 0).all()
    assert all(name == task.name for name, task in TASKS.items())


@given(vector=st.tuples(*[st.floats(-1.8, 1.8)] * 3))
def test_rotations_are_observed_as_axis_times_sine(vector):
    vector = np.array(vector)
    wanted = vector * np.sinc(np.linalg.norm(vector) / np.pi)
    turned = Rotation.from_rotvec(vector).as_matrix()
    zero = np.zeros(3)
    seen = observe(np.zeros(22), 0.0, zero, turned @ START_ROTATION, zero, turned, zero, zero, START_ROTATION)
    entries = np.split(seen, np.cumsum(list(OBSERVATION.values()))[:-1])
    for name in ("grasp_rotation", "object_rotation"):
        np.testing.assert_allclose(entries[list(OBSERVATION).index(name)], wanted, atol=1e-12, err_msg=name)

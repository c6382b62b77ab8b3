"""The ant's symmetry: an ant that runs in some direction moves as one that runs east and is shown what it would see."""

import mujoco
import numpy as np
import pytest

from robots import MODEL_ROBOTS
from tasks.ant_maze import CARDS
from tasks.ant_symmetry import WIDEST, eastwards, given_back

TASK = CARDS["ant-maze"].practice()


@pytest.fixture(scope="module")
def model():
    return TASK.spec(MODEL_ROBOTS["ant"]).compile()


@pytest.mark.parametrize("heading, yaw", [(0.3, -0.2), (1.7, 2.0), (-2.5, 0.2), (3.0, 1.5), (-1.2, -3.1)])
def test_the_turned_ant_moves_alike(model, heading, yaw):
    """By simulation: two ants, one as it is and one as it would see itself, under the same actions for the legs that match."""
    rng = np.random.default_rng(0)
    data, twin = mujoco.MjData(model), mujoco.MjData(model)
    scene = TASK.scene(model, data)
    scene.begin(rng)
    turn = np.empty(4)
    mujoco.mju_mulQuat(turn, np.array([np.cos(yaw / 2), 0, 0, np.sin(yaw / 2)]), data.qpos[3:7].copy())
    data.qpos[3:7] = turn
    seen, quarters = eastwards(scene.observe()[None, :27], np.array([heading]))
    c, s = np.cos(-heading), np.sin(-heading)
    world = np.array([[c, -s], [s, c]])
    twin.qpos[:] = np.concatenate([world @ data.qpos[:2], seen[0, :13]])
    twin.qvel[:] = seen[0, 13:]
    assert abs(2 * np.arctan2(twin.qpos[6], twin.qpos[3])) < WIDEST + 0.1
    for _ in range(15):
        action = rng.uniform(-1, 1, (1, 8))
        twin.ctrl[:], data.ctrl[:] = action[0], given_back(action, quarters)[0]
        for each in (data, twin):
            mujoco.mj_step(model, each, TASK.substeps)
        np.testing.assert_allclose(world @ data.qpos[:2], twin.qpos[:2], atol=1e-9)
        np.testing.assert_allclose([data.qpos[2], data.qvel[2]], [twin.qpos[2], twin.qvel[2]], atol=1e-9)


def test_rows_are_turned_each_by_itself():
    rng = np.random.default_rng(1)
    observations, headings = rng.standard_normal((40, 27)), rng.uniform(-np.pi, np.pi, 40)
    observations[:, 1:5] /= np.linalg.norm(observations[:, 1:5], axis=1, keepdims=True)
    seen, quarters = eastwards(observations, headings)
    actions = given_back(observations[:, :8], quarters)
    assert set(quarters) == {0, 1, 2, 3}
    for row in range(40):
        alone, quarter = eastwards(observations[row : row + 1], headings[row : row + 1])
        np.testing.assert_array_equal(alone[0], seen[row])
        np.testing.assert_array_equal(given_back(observations[row : row + 1, :8], quarter)[0], actions[row])

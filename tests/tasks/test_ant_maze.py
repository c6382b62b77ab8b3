"""The ant's maze: gymnasium's own step agrees with plain mj_step, the opening is the only way out, and only it is success."""

import itertools
from collections import deque

import gymnasium
import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from robots import MODEL_ROBOTS
from tasks.ant_maze import CARDS, LOOK_AHEAD, START_SHIFT
from tasks.maze import CELL, OUT_EAST, OUT_NORTH, START, WayEast, WayOut

TASK = CARDS["ant-maze"]
EXIT = (-OUT_EAST - 0.1, -3.0)
every_ant = pytest.mark.parametrize("name", [name for name, robot in MODEL_ROBOTS.items() if robot.family.name == TASK.family])


@pytest.fixture
def ant():
    """The source in its maze: model, data, scene."""
    return played("ant")


def played(name):
    model = TASK.spec(MODEL_ROBOTS[name]).compile()
    data = mujoco.MjData(model)
    return model, data, TASK.scene(model, data)


def begin(model, data, scene, seed):
    mujoco.mj_resetData(model, data)
    scene.begin(np.random.default_rng(seed))


def at(data, x, y, upright=True):
    data.qpos[:7] = [x, y, 0.6, *([1.0, 0.0, 0.0, 0.0] if upright else [0.0, 1.0, 0.0, 0.0])]


# -- parity --------------------------------------------------------------------------------------------------


@every_ant
def test_gymnasiums_step_is_mujocos(name):
    """Also beyond the motors' range, against walls, and wherever the ant has fallen."""
    model, data, scene = played(name)
    env = TASK.environment(MODEL_ROBOTS[name])
    assert type(env).step is gymnasium.envs.mujoco.ant_v5.AntEnv.step, "the environment's step is not gymnasium's own"
    seen, _ = env.reset(seed=5)
    begin(model, data, scene, 5)
    np.testing.assert_array_equal(seen, scene.observe())
    rng = np.random.default_rng(0)
    for step in range(60):
        action = rng.uniform(-1.5, 1.5, model.nu)
        seen, reward, over, cut, _ = env.step(action)
        data.ctrl[:] = np.clip(action, -1.0, 1.0)
        for _ in range(TASK.substeps):
            mujoco.mj_step(model, data)
        apart = np.abs(seen - scene.observe()).max()
        assert apart < 1e-9, f"{name}: {apart:.1e} apart after {step + 1} steps"
        assert (reward, over, cut) == (scene.at_goal(), scene.at_goal() or scene.lost(), False)


def test_far_from_walls_the_source_is_ant_v5(ant):
    model, data, scene = ant
    env = gymnasium.make("Ant-v5", include_cfrc_ext_in_observation=False, terminate_when_unhealthy=False).unwrapped
    env.reset(seed=0)
    begin(model, data, scene, 3)
    there = data.qpos.copy()
    there[:2] = 0.0
    data.qpos[:2] = START
    mujoco.mj_forward(model, data)
    env.set_state(there, data.qvel.copy())
    rng = np.random.default_rng(2)
    for _ in range(15):
        data.ctrl[:] = rng.uniform(-0.4, 0.4, model.nu)
        mujoco.mj_step(model, data, nstep=TASK.substeps)
        seen, *_ = env.step(data.ctrl.copy())
        assert np.abs(np.concatenate([data.qpos[2:], data.qvel]) - seen).max() < 1e-9
    assert np.abs(data.qpos[:2] - START).max() < 0.3, "the ant came near a wall"
    assert TASK.control_frequency == pytest.approx(1 / env.dt)


# -- the start -----------------------------------------------------------------------------------------------


def test_a_start_is_the_seeds_alone_and_fills_its_noise(ant):
    model, data, _ = ant
    starts = []
    for seed in range(200):
        begin(*ant, seed)
        starts.append(data.qpos.copy())
    begin(*ant, 0)
    np.testing.assert_array_equal(data.qpos, starts[0])
    shift = (np.array(starts)[:, :2] - START) / START_SHIFT
    assert shift.min() > -1 and shift.max() < 1 and shift.min() < -0.9 and shift.max() > 0.9 and np.abs(shift.mean(axis=0)).max() < 0.15
    np.testing.assert_allclose(np.linalg.norm(np.array(starts)[:, 3:7], axis=1), 1.0, atol=1e-12)
    assert model.nu == len(TASK.action.names) and data.qpos.size + data.qvel.size == len(TASK.observation.names)


@every_ant
def test_every_robot_starts_clear_of_the_walls_and_on_its_feet(name):
    model, data, scene = played(name)
    walls = {model.geom(wall).id for wall in ("north", "east", "south", "west", "middle")}
    for seed in range(200):
        begin(model, data, scene, seed)
        deepest = min((c.dist for c in data.contact if walls & {c.geom1, c.geom2}), default=0.0)
        assert deepest > -0.002, f"{name}, seed {seed}: starts {-deepest:.3f} m deep in a wall"
        assert not scene.lost() and not scene.at_goal()


# -- the walls -----------------------------------------------------------------------------------------------


def test_the_opening_is_the_only_way_out(ant):
    """Flood the plane between the compiled walls from the start: where it leaves the maze there is success, and nowhere else."""
    model, data, scene = ant
    walls = [(model.geom(w).pos[:2], model.geom(w).size[:2]) for w in ("north", "east", "south", "west", "middle")]
    pitch, torso = 0.1, 0.2  # [m]; a little less than the torso's radius

    def free(cell):
        point = np.array(cell) * pitch
        return all((np.abs(point - centre) > half + torso).any() for centre, half in walls)

    seen, queue, left = {(-10, 30)}, deque([(-10, 30)]), set()
    while queue:
        i, j = queue.popleft()
        for cell in ((i + 1, j), (i - 1, j), (i, j + 1), (i, j - 1)):
            if cell in seen or not free(cell):
                continue
            seen.add(cell)
            outside = abs(cell[0]) * pitch > OUT_EAST or abs(cell[1]) * pitch > OUT_NORTH
            at(data, cell[0] * pitch, cell[1] * pitch)
            assert scene.at_goal() == outside and not scene.lost(), f"at {cell} [dm]"
            left |= {cell} if outside else set()
            if not outside:
                queue.append(cell)
    assert len(left) > 20 and max(i for i, _ in left) <= -33, "the only way out is not to the west"
    assert (15, 0) in seen and (-15, -30) in seen and (-15, 0) not in seen


def test_walls_stop_every_part_of_an_ant(ant):
    model, _, _ = ant
    for wall in ("north", "east", "south", "west", "middle"):
        shape = model.geom(wall)
        assert shape.conaffinity[0] & 1 and shape.size[2] * 2 == 1.0 and shape.pos[2] == 0.5
    assert (model.geom_contype[1:14] & 1).all()


# -- success -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "x, y, upright, goal, lost",
    [
        (*START, True, False, False),
        (*START, False, False, True),
        (*EXIT, True, True, False),
        (EXIT[0], 3.0, True, False, True),  # over the west wall
        (0.0, OUT_NORTH + 0.1, True, False, True),  # over the north wall
        (-OUT_EAST + 0.1, -3.0, True, False, False),  # in the opening
    ],
)
def test_what_counts_as_outside_and_as_lost(ant, x, y, upright, goal, lost):
    _, data, scene = ant
    at(data, x, y, upright)
    assert (scene.at_goal(), scene.lost()) == (goal, lost)
    assert TASK.judge().tell(scene.at_goal()) == goal, "one step outside is a success"


@pytest.mark.parametrize("place, reward", [(EXIT, 1.0), ((EXIT[0], 3.0), 0.0)])
def test_an_episode_ends_outside_and_is_rewarded_at_the_opening_alone(place, reward):
    env = TASK.environment(MODEL_ROBOTS["ant"])
    env.reset(seed=0)
    assert env.step(np.zeros(8))[1:3] == (0.0, False)
    qpos = env.data.qpos.copy()
    qpos[:2] = place
    env.set_state(qpos, 0 * env.data.qvel)
    assert env.step(np.zeros(8))[1:3] == (reward, True)


# -- the way -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("way", [WayOut(), WayEast()], ids=["out", "east"])
def test_coordinates_are_arc_length_and_distance(way):
    """Against a fine polyline, on the line and beside it."""
    along = np.linspace(0, way.length, 2001)
    points = np.array([way.point(s) for s in along])
    polyline = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    np.testing.assert_allclose(polyline, along, atol=1e-5)
    for s, point in zip(along[1:-1], points[1:-1], strict=True):
        left = way.direction(s) + np.pi / 2
        for aside in (-1.4, 0.0, 1.4):
            place = point + aside * np.array([np.cos(left), np.sin(left)])
            np.testing.assert_allclose(way.coordinates(*place), (s, aside), atol=1e-5)
    np.testing.assert_allclose(points[0], START)


def test_the_way_out_ends_outside():
    np.testing.assert_allclose(WayOut().point(WayOut().length), (-OUT_EAST, -CELL), atol=1e-12)


def test_starts_to_learn_from_lie_all_along_the_way():
    task = TASK.scattered()
    model = task.spec(MODEL_ROBOTS["ant"]).compile()
    data = mujoco.MjData(model)
    scene = task.scene(model, data)
    along, yaws, at_start = [], [], 0
    for seed in range(400):
        begin(model, data, scene, seed)
        seen = scene.observe()
        along.append(WayOut().length - task.miss(seen))
        yaws.append(2 * np.arctan2(seen[4], seen[1]))
        at_start += (np.abs(data.qpos[:2] - START) <= START_SHIFT).all()
        assert not scene.lost() and not scene.at_goal()
    counts = np.histogram(along, bins=6, range=(0, WayOut().length - 1.5))[0]
    assert counts.min() > 15, f"{counts} starts in sixths of the way"
    assert 0.18 < at_start / 400 < 0.36 and np.std(yaws) > 0.3


# -- what is seen --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(6))
def test_the_observation_is_ant_v5s_in_the_frame_of_the_way(seed):
    """Against rotations by SciPy, at places all along the way."""
    task = TASK.scattered()
    model = task.spec(MODEL_ROBOTS["ant"]).compile()
    data, way = mujoco.MjData(model), WayOut()
    scene = task.scene(model, data)
    begin(model, data, scene, seed)
    seen = scene.observe()
    along, aside = way.coordinates(*data.qpos[:2])
    towards = np.array([*way.point(along + LOOK_AHEAD), 0.0]) - [*data.qpos[:2], 0.0]
    x = towards / np.linalg.norm(towards)
    frame = Rotation.from_matrix(np.column_stack([x, np.cross([0, 0, 1], x), [0, 0, 1]]))
    orientation = frame.inv() * Rotation.from_quat(data.qpos[3:7], scalar_first=True)
    np.testing.assert_allclose(seen[1:5], orientation.as_quat(canonical=True, scalar_first=True), atol=1e-12)
    np.testing.assert_allclose(seen[13:16], frame.inv().apply(data.qvel[:3]), atol=1e-12)
    np.testing.assert_array_equal(seen[[0, *range(5, 13), *range(16, 27)]], [data.qpos[2], *data.qpos[7:], *data.qvel[3:]])
    np.testing.assert_allclose(seen[27:], [aside / CELL, (way.length - along) / CELL], atol=1e-12)


def test_gains_are_the_way_and_what_turning_to_it_is_worth(ant):
    model, data, scene = ant
    begin(*ant, 0)
    seen = [scene.observe()]
    for _ in range(8):
        data.ctrl[:] = 0.5
        mujoco.mj_step(model, data, TASK.substeps)
        seen.append(scene.observe())
    seen = np.array(seen)
    yaws = Rotation.from_quat(seen[:, 1:5], scalar_first=True).as_euler("ZYX")[:, 0]
    moved = [TASK.miss(before) - TASK.miss(after) for before, after in itertools.pairwise(seen)]
    np.testing.assert_allclose(TASK.gains(seen), moved + 0.2 * np.diff(np.cos(yaws)), atol=1e-12)


def test_on_the_floor_nothing_is_in_the_way():
    task = TASK.practice()
    model = task.spec(MODEL_ROBOTS["ant"]).compile()
    data = mujoco.MjData(model)
    scene = task.scene(model, data)
    begin(model, data, scene, 0)
    assert model.ngeom == 14 and not scene.lost() and task.observation.names == TASK.observation.names
    at(data, 300.0, -20.0)
    assert not scene.lost() and not scene.at_goal()
    at(data, 0.0, 0.0, upright=False)
    assert scene.lost()

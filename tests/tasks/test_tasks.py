"""Tasks: objects weigh and measure what they say, success needs patience, starts are drawn from the seed."""

import os
import subprocess
import sys
from pathlib import Path

import mujoco
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from robots import ROBOTS
from tasks import TASKS
from tasks.objects import OBJECTS, PickObject
from tasks.pick import (
    ACTION,
    ACTION_SIZE,
    GOAL_OFFSET,
    OBJECT_XY,
    OBSERVATION,
    OBSERVATION_SIZE,
    START_ROTATION,
    PickTask,
    is_lost,
    observe,
)
from tasks.table import TABLE_TOP
from toolkit.morphology.build import MergedRobot
from toolkit.morphology.posture import native_env
from toolkit.simulation.laws import merged_plant
from toolkit.simulation.rollout import play

every_object = pytest.mark.parametrize("name", sorted(OBJECTS))
every_task = pytest.mark.parametrize("task", TASKS.values(), ids=list(TASKS))
seeds = st.integers(0, 2**63)


def object_geom(model):
    """The colliding geom of the object."""
    body = next(b for b in range(model.nbody) if model.body(b).name in ("object", "object_main"))
    (geom,) = [g for g in range(model.ngeom) if model.geom_bodyid[g] == body and model.geom_contype[g]]
    return body, geom


def table_geom(model):
    (geom,) = [g for g in range(model.ngeom) if model.geom(g).name in ("table", "table_collision")]
    return geom


# -- objects -------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def scenes(pair):
    """object name -> (robosuite's scene, the merged scene)."""
    loaded = {}

    def load(name):
        if name not in loaded:
            task = PickTask(OBJECTS[name])
            loaded[name] = native_env(ROBOTS["kinova3"], task), MergedRobot(pair.space, task).template
        return loaded[name]

    return load


@pytest.mark.parametrize("name", ["061_foam_brick", "005_tomato_soup_can"])
def test_the_distance_from_an_object_is_mujocos(name):
    """Of a speck outside it; inside, no point of the surface is nearer, and one is as near."""
    item, speck = OBJECTS[name], 1e-6
    kind = "box" if item.shape == "box" else "cylinder"
    size = " ".join(map(str, item.half_size))
    model = mujoco.MjModel.from_xml_string(
        f'<mujoco><worldbody><geom name="a" type="{kind}" size="{size}"/><body mocap="true"><geom name="b" size="{speck}"/></body>'
        "</worldbody></mujoco>"
    )
    data, rng = mujoco.MjData(model), np.random.default_rng(0)
    points = rng.uniform(-0.1, 0.1, (400, 3))
    found = item.distance(points)
    assert (found > 0).any() and (found < 0).any()
    grid = np.stack(np.meshgrid(*[np.linspace(-0.06, 0.06, 61)] * 3), axis=-1).reshape(-1, 3)
    outer = grid[item.distance(grid) > 0]
    for point, distance in zip(points, found, strict=True):
        if distance > 0:
            data.mocap_pos[0] = point
            mujoco.mj_forward(model, data)
            assert distance == pytest.approx(mujoco.mj_geomDistance(model, data, 0, 1, 1.0, None) + speck, abs=1e-5)
        else:
            nearest = np.linalg.norm(outer - point, axis=1).min()
            assert nearest - 0.004 < -distance <= nearest, f"{point} is {distance} deep, the nearest point outside is {nearest} away"


@every_object
def test_an_object_in_robosuite_has_the_cards_size_and_mass(scenes, name):
    item, model = OBJECTS[name], scenes(name)[0].sim.model._model
    body, geom = object_geom(model)
    mass = float(model.body_mass[body])
    assert abs(mass - item.mass) < 1e-6 * item.mass, f"{name}: {mass} kg in robosuite, {item.mass} kg on its card"
    np.testing.assert_allclose(model.geom_size[geom][: len(item.half_size)], item.half_size, err_msg=name)
    kind = {"box": mujoco.mjtGeom.mjGEOM_BOX, "cylinder": mujoco.mjtGeom.mjGEOM_CYLINDER}[item.shape]
    assert model.geom_type[geom] == kind


def assert_same_contact(what, merged_model, mine, model, theirs):
    """What decides a contact is equal in robosuite's scene and in the merged one."""
    for field in ("type", "size", "friction", "solref", "solimp", "solmix", "condim", "margin", "gap", "priority"):
        a, b = getattr(merged_model, f"geom_{field}")[mine], getattr(model, f"geom_{field}")[theirs]
        np.testing.assert_allclose(a, b, rtol=1e-9, err_msg=f"{what}: geom_{field}, merged against robosuite")


@every_object
def test_both_scenes_hold_the_same_object(scenes, name):
    env, merged_model = scenes(name)
    model = env.sim.model._model
    assert_same_contact(name, merged_model, object_geom(merged_model)[1], model, object_geom(model)[1])


def test_both_scenes_hold_the_same_table(scenes):
    env, merged_model = scenes("061_foam_brick")
    model = env.sim.model._model
    mine, theirs = table_geom(merged_model), table_geom(model)
    assert_same_contact("table", merged_model, mine, model, theirs)
    data, merged_data = mujoco.MjData(model), mujoco.MjData(merged_model)
    mujoco.mj_kinematics(model, data)
    mujoco.mj_kinematics(merged_model, merged_data)
    np.testing.assert_allclose(merged_data.geom_xpos[mine], data.geom_xpos[theirs], atol=1e-9)
    np.testing.assert_allclose(merged_data.geom_xmat[mine], data.geom_xmat[theirs], atol=1e-9)


@every_object
def test_both_scenes_give_the_object_the_same_inertia_and_free_joint(scenes, name):
    env, merged_model = scenes(name)
    model = env.sim.model._model
    mine, theirs = object_geom(merged_model)[0], object_geom(model)[0]
    for field in ("mass", "inertia", "ipos", "iquat", "gravcomp"):
        a, b = getattr(merged_model, f"body_{field}")[mine], getattr(model, f"body_{field}")[theirs]
        np.testing.assert_allclose(
            a, b, rtol=1e-6, atol=1e-12, err_msg=f"body_{field} of {name}, merged against robosuite"
        )
    dofs = [m.jnt_dofadr[m.body_jntadr[b]] + np.arange(6) for m, b in ((merged_model, mine), (model, theirs))]
    for field in ("damping", "armature", "frictionloss"):
        a, b = getattr(merged_model, f"dof_{field}")[dofs[0]], getattr(model, f"dof_{field}")[dofs[1]]
        np.testing.assert_allclose(a, b, err_msg=f"dof_{field} of {name}, merged against robosuite")


OPTIONS = (
    "timestep", "impratio", "density", "cone", "integrator", "solver", "gravity", "wind", "magnetic", "tolerance",
    "iterations", "ls_iterations", "noslip_iterations", "jacobian", "ccd_iterations", "ccd_tolerance",
)


@pytest.mark.parametrize("option", [*OPTIONS, "viscosity"])
def test_both_scenes_have_the_same_physics(scenes, option):
    env, merged_model = scenes("061_foam_brick")
    mine, theirs = getattr(merged_model.opt, option), getattr(env.sim.model._model.opt, option)
    np.testing.assert_allclose(mine, theirs, err_msg=f"option {option}, merged against robosuite")


@pytest.mark.parametrize(
    "shape, half_size, mass",
    [("sphere", (0.1,), 0.1), ("box", (0.1, 0.1), 0.1), ("cylinder", (0.1, -0.1), 0.1), ("box", (0.1, 0.1, 0.1), 0.0)],
)
def test_an_impossible_object_is_refused(shape, half_size, mass):
    with pytest.raises(ValueError, match="object thing: bad shape"):
        PickObject("thing", shape, half_size, mass)


def test_a_cards_friction_is_that_of_both_scenes(pair):
    waxed = PickObject("waxed", "box", (0.03, 0.02, 0.02), 0.05, friction=(0.2, 0.001, 0.0003))
    slick = PickTask(waxed)
    native, merged_model = native_env(ROBOTS["kinova3"], slick).sim.model._model, MergedRobot(pair.space, slick).template
    for model in (native, merged_model):
        np.testing.assert_allclose(model.geom_friction[object_geom(model)[1]], waxed.friction)


@pytest.mark.parametrize("friction", [(0.2, 0.001), (0.2, -0.001, 0.0)])
def test_an_impossible_friction_is_refused(friction):
    with pytest.raises(ValueError, match="object thing: bad friction"):
        PickObject("thing", "box", (0.1, 0.1, 0.1), 0.1, friction)


# -- success -------------------------------------------------------------------------------------------------


def place(robot, position):
    """Put the object somewhere, at rest."""
    robot.data.qpos[-7:] = [*position, 1, 0, 0, 0]
    robot.data.qvel[-6:] = 0
    robot.env.sim.forward()


def test_success_in_robosuite_needs_consecutive_steps(native, task):
    robot = native("kinova3")
    goal, steps = robot.env.goal, task.hold_steps
    place(robot, goal)
    rewards = [robot.env.reward() for _ in range(steps - 1)]
    place(robot, goal + [0, 0, 1.1 * task.goal_tolerance])
    rewards.append(robot.env.reward())
    assert not any(rewards), f"rewarded after {np.flatnonzero(rewards) + 1} of {steps} steps at the goal"
    place(robot, goal + [0, 0, 0.9 * task.goal_tolerance])
    rewards = [robot.env.reward() for _ in range(steps)]
    assert rewards == [0.0] * (steps - 1) + [1.0], f"rewards {rewards}, expected one on step {steps}"
    assert robot.env.succeeded and not robot.env.lost


def test_an_object_below_the_table_is_lost_for_good(native):
    robot = native("kinova3")
    place(robot, [1.0, 0.0, TABLE_TOP - 0.1])
    assert robot.env.reward() == 0.0 and robot.env.lost
    place(robot, robot.env.goal)
    robot.env.reward()
    assert robot.env.lost, "an object that fell off the table was forgiven"


def carried(plant, places):
    """An actor that does nothing while the object is put at each of the places in turn."""
    steps = iter(places)
    address = plant.model.joint("object").qposadr[0]

    def act(observation, rng):
        place = next(steps, None)
        if place is not None:
            plant.data.qpos[address : address + 7] = [*(plant.goal if place == "goal" else place), 1, 0, 0, 0]
            plant.data.qvel[-6:] = 0
        return np.zeros(ACTION_SIZE)

    return act


def test_success_in_a_rollout_needs_consecutive_steps(pair, task):
    plant = merged_plant(pair.merged, pair.space.beta("kinova3"), *pair.merged.new())
    steps, aside = task.hold_steps, [0.3, 0.3, 0.9]
    act = carried(plant, ["goal"] * (steps - 1) + [aside] + ["goal"] * steps)
    episode = play(plant, act, 0, pair.space.beta("kinova3"))
    assert episode.success and episode.terminated
    assert episode.steps == 2 * steps, f"ended after {episode.steps} steps, {2 * steps} expected"
    assert episode.rewards.tolist() == [0.0] * (2 * steps - 1) + [1.0], "one reward, on the last step"


def test_a_lost_object_ends_a_rollout_as_a_failure(pair):
    plant = merged_plant(pair.merged, pair.space.beta("kinova3"), *pair.merged.new())
    episode = play(plant, carried(plant, [None, None, [1.5, 0.0, 0.5]]), 0, pair.space.beta("kinova3"))
    assert (episode.steps, episode.success, episode.diverged, episode.terminated) == (3, False, False, True)
    assert episode.total_reward == 0.0


def test_lost_is_measured_below_the_table():
    assert is_lost(np.array([0.0, 0.0, TABLE_TOP - 0.05]))
    assert not is_lost(np.array([0.0, 0.0, TABLE_TOP + 0.001]))


# -- starts --------------------------------------------------------------------------------------------------


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


@pytest.mark.parametrize("seed", [0, 3, 10**9])
def test_engine_and_robosuite_start_from_the_same_seed_alike(native, native_fast, pair, seed):
    robot, fast = native("kinova3"), native_fast("kinova3")
    plant = merged_plant(pair.merged, pair.space.beta("kinova3"), *pair.merged.new())
    observations = [robot.begin(seed), fast.begin(seed), plant.begin(seed)]
    for label, other in zip(("native engine", "merged engine"), observations[1:], strict=True):
        apart = np.abs(other - observations[0]).max()
        assert apart < 1e-7, f"seed {seed}: the {label}'s first observation is {apart:.1e} from robosuite's"


# -- records -------------------------------------------------------------------------------------------------


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


# -- found by themselves -------------------------------------------------------------------------------------


def test_a_task_is_one_file_found_by_itself(tmp_path):
    """A file in tasks/ adds its tasks, and one that does not load is named and costs the others nothing."""
    (tmp_path / "carry.py").write_text(
        "from tasks.objects import OBJECTS\nfrom tasks.pick import PickTask\n"
        "CARRY = PickTask(OBJECTS['061_foam_brick'], goal_offset=(0.0, 0.3, 0.1), title='carry')\n"
    )
    (tmp_path / "spoilt.py").write_text(
        "from tasks.objects import OBJECTS\nfrom tasks.pick import PickTask\nBAD = PickTask(OBJECTS['061_foam_brick'], title='a/b')\n"
    )
    code = (
        "import sys, tasks\ntasks.__path__.append(sys.argv[1])\nfrom toolkit.cli.names import broken_cards, find_task\n"
        "assert find_task('carry').goal_offset[1] == 0.3 and 'carry' in tasks.TASKS and '061_foam_brick' in tasks.TASKS\n"
        "(broken,) = broken_cards()\nassert 'a card in tasks/ does not load' in broken and 'tasks/spoilt.py' in broken, broken\n"
    )
    environment = os.environ | {"PYTHONPATH": str(Path(__file__).parents[2])}
    done = subprocess.run([sys.executable, "-c", code, str(tmp_path)], capture_output=True, text=True, env=environment)
    assert done.returncode == 0, done.stderr

"""Ants: the source is gymnasium's own, the others are what their parameters say, and their trees are as short as can be."""

import pickle
from importlib.util import find_spec
from pathlib import Path

import mujoco
import numpy as np
import pytest
from scipy.sparse.csgraph import minimum_spanning_tree
from scipy.spatial.distance import cdist

from robots import MODEL_ROBOTS
from robots.ant import gymnasium_ant
from toolkit.evolution import Terminal, evolution_tree

NAMES = ["ant", *(f"ant-{i}" for i in range(1, 7)), "ant-1b"]
every_ant = pytest.mark.parametrize("name", NAMES)
TORSO, SHOULDER, HIP, FRONT, HIND = range(5)
SHARES = {
    "ant": (0, 0, 0, 0, 0), "ant-1": (0.5, 0, 0, 0.5, 0.5), "ant-2": (1, 0.5, 0, 0.5, 0.5), "ant-3": (1, 1, 0, 0.5, 0.5),
    "ant-4": (0.5, 0, 1, 1, 0.5), "ant-5": (0.5, 0.5, 1, 1, 0.5), "ant-6": (0.5, 0, 1, 1, 1), "ant-1b": (0.5, 0, 0, 0.5, 0),
}
"""Torso, shoulder, hip, front and hind legs of each robot, 1 the greatest change."""
PRESET_A, PRESET_B = NAMES[:7], ["ant", "ant-1b", *NAMES[2:7]]


def compiled(name):
    spec = gymnasium_ant()
    MODEL_ROBOTS[name].change(spec)
    return spec.compile()


def gymnasiums():
    path = Path(find_spec("gymnasium").origin).parent / "envs" / "mujoco" / "assets" / "ant.xml"
    return mujoco.MjModel.from_xml_path(str(path))


def numbers(model):
    """Every array of numbers of a model, by name."""
    return {name: value for name in dir(model) if not name.startswith("_") and isinstance(value := getattr(model, name), np.ndarray)}


# -- the source ----------------------------------------------------------------------------------------------


def test_the_source_is_gymnasiums_but_for_names_and_the_torsos_type():
    ours, theirs = numbers(compiled("ant")), numbers(gymnasiums())
    differ = {name for name, array in theirs.items() if not np.array_equal(array, ours[name])}
    named = {name for name in differ if name.startswith("name") or name in ("paths",)}
    # geom_aabb is the box's half sizes, geom_size the radii: a ball has one where an ellipsoid has three.
    assert differ - named <= {"geom_type", "geom_size", "geom_aabb"}, f"{sorted(differ - named)} differ from gymnasium's ant.xml"
    np.testing.assert_array_equal(np.flatnonzero(ours["geom_type"] != theirs["geom_type"]), [1])
    np.testing.assert_array_equal(ours["geom_size"][1], theirs["geom_size"][1, 0])
    np.testing.assert_array_equal(np.delete(ours["geom_size"], 1, 0), np.delete(theirs["geom_size"], 1, 0))


@pytest.mark.parametrize("on_its_back", [False, True])
def test_the_source_moves_like_gymnasiums(on_its_back):
    """Also where the torso touches the floor: a capsule of no length would meet it at two points, and be 1e-4 m off at once."""
    states = []
    for model in (compiled("ant"), gymnasiums()):
        data, rng = mujoco.MjData(model), np.random.default_rng(0)
        if on_its_back:
            data.qpos[3:7] = [0.05, 0.99, 0.02, 0.01]
        touched, path = False, []
        for _ in range(40):
            data.ctrl[:] = rng.uniform(-1, 1, model.nu)
            mujoco.mj_step(model, data, nstep=5)
            path.append(np.concatenate([data.qpos, data.qvel]))
            touched |= any({0, 1} == {c.geom1, c.geom2} for c in data.contact)
        assert touched or not on_its_back, "the torso never met the floor, so that nothing was compared"
        states.append(np.array(path))
    apart = np.abs(states[0] - states[1]).max()
    assert apart < 1e-9, f"{apart:.1e} from gymnasium's ant after 2 s"


# -- the others ----------------------------------------------------------------------------------------------


def volume_of_capsule(radius, half_length):
    return np.pi * radius**2 * (2 * half_length + 4 / 3 * radius)


@every_ant
def test_a_robot_is_what_its_parameters_say(name):
    share, model = SHARES[name], compiled(name)
    long, front, hind = 0.25 + 0.5 * share[TORSO], 0.08 - 0.045 * share[FRONT], 0.08 + 0.06 * share[HIND]
    volume = 4 / 3 * np.pi * long * 0.25**2
    for radius in (front, hind):
        for half_length in (np.hypot(0.1, 0.1), np.hypot(0.1, 0.1), np.hypot(0.2, 0.2)):
            volume += 2 * volume_of_capsule(radius, half_length)
    assert model.body_mass.sum() == pytest.approx(5.0 * volume, rel=1e-9)
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    width = {1: 0.25 * share[SHOULDER], -1: 0.25 * share[HIP]}
    for joint in ("hip_1", "hip_2", "hip_3", "hip_4"):
        at = data.xpos[model.jnt_bodyid[model.joint(joint).id]] - data.body("torso").xpos
        along, aside = np.sign(at[:2])
        wanted = [along * (0.2 + 0.5 * share[TORSO]), aside * (0.2 + width[along]), 0.0]
        np.testing.assert_allclose(at, wanted, atol=1e-12, err_msg=f"{name}: where {joint} turns")


@every_ant
def test_robots_have_the_same_bodies_joints_geoms_and_motors(name):
    model, source = compiled(name), compiled("ant")
    for count in ("nbody", "njnt", "ngeom", "nu", "nq", "nv"):
        assert getattr(model, count) == getattr(source, count)
    for fields in ("body_parentid", "jnt_type", "geom_type", "geom_bodyid", "actuator_trnid"):
        np.testing.assert_array_equal(getattr(model, fields), getattr(source, fields))
    named = [model.body(i).name for i in range(model.nbody)] + [model.actuator(i).name for i in range(model.nu)]
    assert all(named) and MODEL_ROBOTS[name].family is MODEL_ROBOTS["ant"].family


@every_ant
def test_a_robot_stands_and_comes_to_rest(name):
    model = compiled(name)
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data, nstep=2500)
    upright = 1 - 2 * (data.qpos[4] ** 2 + data.qpos[5] ** 2)
    speed = np.abs(data.qvel).max()
    assert upright > 0.99 and speed < 0.01, f"{name}: upright {upright:.2f}, speed {speed:.2f} after 25 s"
    assert 0.26 < data.qpos[2] < 0.5, f"{name}: stands at {data.qpos[2]:.2f} m, with its torso on the floor or in the air"


@every_ant
def test_a_robot_stays_finite_under_any_torque(name):
    model = compiled(name)
    data, rng = mujoco.MjData(model), np.random.default_rng(1)
    for _ in range(200):
        data.ctrl[:] = rng.choice([-1.0, 1.0], model.nu)
        mujoco.mj_step(model, data, nstep=5)
    assert np.isfinite(data.qpos).all() and np.abs(data.qvel).max() < 100 and not data.warning.number.any()


@every_ant
def test_a_robot_can_be_handed_to_another_process(name):
    """Evaluations play in processes of their own, to which a card goes as bytes."""
    other = pickle.loads(pickle.dumps(MODEL_ROBOTS[name]))  # noqa: S301 - our own bytes
    spec = gymnasium_ant()
    other.change(spec)
    np.testing.assert_array_equal(spec.compile().geom_size, compiled(name).geom_size)
    assert other.family.element("torso", "size") == "ant"


# -- their trees ---------------------------------------------------------------------------------------------


def patterns(names):
    """(len(names), D) each parameter's values as shares of its range, equal columns once; read from the compiled models."""
    models = [compiled(name) for name in names]
    values = np.array([np.concatenate([model.geom_size.ravel(), model.body_pos.ravel()]) for model in models])
    values = values[:, np.ptp(values, axis=0) > 1e-12]
    shares = (values - values.min(axis=0)) / np.ptp(values, axis=0)
    return np.unique(np.round(np.where(shares[0] > 0.5, 1 - shares, shares), 9), axis=1)


def tree_of(names, kind="steiner"):
    source, *targets = (Terminal(name, alpha) for name, alpha in zip(names, patterns(names), strict=True))
    return evolution_tree(source, targets, "l1", kind)


@pytest.mark.parametrize("names", [PRESET_A, PRESET_B], ids=["A", "B"])
def test_ants_differ_in_five_dimensions(names):
    found = patterns(names)
    assert found.shape == (7, 5)
    wanted = np.unique([SHARES[name] for name in names], axis=1)
    np.testing.assert_allclose(found, wanted, atol=1e-9)


def spanning_length(names):
    return minimum_spanning_tree(cdist(patterns(names), patterns(names), "cityblock")).sum()


def test_no_meta_robot_shortens_the_tree_of_the_six():
    tree = tree_of(PRESET_A)
    assert tree.optimal and tree.length == pytest.approx(5.5) and tree.lower_bound == pytest.approx(5.5)
    assert spanning_length(PRESET_A) == pytest.approx(5.5)
    assert [node.name for node in tree.nodes if node.kind == "meta"] == []
    edges = {(tree.nodes[edge.start].name, tree.nodes[edge.end].name): edge.length for edge in tree.edges}
    assert edges == pytest.approx({("ant", "ant-1"): 1.5, ("ant-1", "ant-2"): 1.0, ("ant-2", "ant-3"): 0.5, ("ant-1", "ant-4"): 1.5,
                                   ("ant-4", "ant-5"): 0.5, ("ant-4", "ant-6"): 0.5})
    assert tree_of(PRESET_A, "independent").length == pytest.approx(17.0)


def test_a_meta_robot_shortens_the_tree_with_another_first():
    tree = tree_of(PRESET_B)
    assert tree.optimal and tree.length == pytest.approx(5.5)
    assert spanning_length(PRESET_B) == pytest.approx(6.0)
    (meta,) = [node for node in tree.nodes if node.kind == "meta"]
    first, second = (patterns(PRESET_A)[i] for i in (1, 2))
    assert sorted(meta.alpha) == pytest.approx(sorted(first)), f"{meta.alpha} is not where ant-1 stands, on the way to {second}"
    assert tree_of(PRESET_B, "independent").length == pytest.approx(16.5)

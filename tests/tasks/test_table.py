"""Table and object: robosuite's scene and the merged one hold the same, of the size and weight on its card."""

import mujoco
import numpy as np
import pytest

from robots import ROBOTS
from tasks.objects import OBJECTS, PickObject
from tasks.pick import PickTask
from toolkit.morphology.build import MergedRobot
from toolkit.morphology.posture import native_env

every_object = pytest.mark.parametrize("name", sorted(OBJECTS))


def object_geom(model):
    """The colliding geom of the object."""
    body = next(b for b in range(model.nbody) if model.body(b).name in ("object", "object_main"))
    (geom,) = [g for g in range(model.ngeom) if model.geom_bodyid[g] == body and model.geom_contype[g]]
    return body, geom


def table_geom(model):
    (geom,) = [g for g in range(model.ngeom) if model.geom(g).name in ("table", "table_collision")]
    return geom


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


def test_a_cards_friction_is_that_of_both_scenes(pair):
    waxed = PickObject("waxed", "box", (0.03, 0.02, 0.02), 0.05, friction=(0.2, 0.001, 0.0003))
    slick = PickTask(waxed)
    native, merged_model = native_env(ROBOTS["kinova3"], slick).sim.model._model, MergedRobot(pair.space, slick).template
    for model in (native, merged_model):
        np.testing.assert_allclose(model.geom_friction[object_geom(model)[1]], waxed.friction)

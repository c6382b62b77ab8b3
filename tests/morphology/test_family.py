"""Families of one model: matched by name, and F in place against robots that MuJoCo compiled itself."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest
from toys import CRAWL, CRAWLER_ROBOTS, HAND_ROBOTS, LIFT, crawler, hand

from robots.model_robot import Family
from toolkit.errors import ToolkitError
from toolkit.morphology.family import FamilySpace, MergedModel

FAMILIES = {"crawler": (CRAWLER_ROBOTS, CRAWL), "hand": (HAND_ROBOTS, LIFT)}
either = pytest.mark.parametrize("family", list(FAMILIES))
CAPSULE = mujoco.mjtGeom.mjGEOM_CAPSULE
COMPARED = (
    "body_pos", "body_quat", "body_mass", "body_ipos", "geom_pos", "geom_quat", "geom_size", "geom_rbound", "geom_aabb", "jnt_range",
    "actuator_ctrlrange", "dof_armature", "dof_M0", "dof_invweight0", "body_subtreemass", "body_invweight0", "site_pos",
)


def merge(family):
    robots, task = FAMILIES[family]
    space = FamilySpace(robots, task)
    return space, MergedModel(space, task), task


def tensor(model, body):
    """Inertia (3, 3) about the centre of mass in the body's frame."""
    frame = np.empty(9)
    mujoco.mju_quat2Mat(frame, model.body_iquat[body])
    frame = frame.reshape(3, 3)
    return frame @ np.diag(model.body_inertia[body]) @ frame.T


def same(mine, own, tolerance=1e-9):
    """Every number that the simulation uses agrees, however MuJoCo names a principal frame or a ball."""
    for array in COMPARED:
        a, b = np.array(getattr(mine, array), float), np.array(getattr(own, array), float)
        if array in ("geom_size", "geom_quat"):  # a ball is a capsule of hardly any length, however turned
            balls = (own.geom_type == mujoco.mjtGeom.mjGEOM_SPHERE) | ((own.geom_type == CAPSULE) & (own.geom_size[:, 1] == 0))
            a, b = (a[~balls], b[~balls]) if array == "geom_quat" else (a, np.where(balls[:, None], [1, 0, 0], 1) * b)
        if array.endswith("quat"):
            a = a * np.sign(np.sum(a * b, axis=1, keepdims=True))
        np.testing.assert_allclose(a, b, rtol=tolerance, atol=tolerance, err_msg=array)
    for body in range(1, own.nbody):
        np.testing.assert_allclose(tensor(mine, body), tensor(own, body), rtol=1e-7, atol=1e-12, err_msg=own.body(body).name)


@either
def test_f_of_beta_is_the_robot(family):
    space, merged, _ = merge(family)
    model, data = merged.new()
    for name, reading in zip(space.names, space.readings, strict=True):
        merged.become(space.beta(name), model, data)
        same(model, reading.model)


@pytest.mark.parametrize("share", [0.25, 0.6])
def test_f_halfway_is_what_mujoco_compiles_there(share):
    """A crawler whose torso and leg have grown by a share is a robot that a card can describe as well."""
    space, merged, task = merge("crawler")
    model, data = merged.new()
    merged.become(share * space.beta("thick"), model, data)
    same(model, task.spec(crawler("between", long=0.5 * share, thick=share)).compile())


@either
def test_there_and_back(family):
    space, merged, _ = merge(family)
    model, data = merged.new()
    merged.become(space.beta(space.names[-1]), model, data)
    merged.become(space.beta(space.names[0]), model, data)
    same(model, space.readings[0].model)


@either
def test_the_same_motion_as_the_unmodified_robot(family):
    space, merged, task = merge(family)
    model, data = merged.new()
    for name, reading in zip(space.names, space.readings, strict=True):
        merged.become(space.beta(name), model, data)
        own, rng = mujoco.MjData(reading.model), np.random.default_rng(1)
        for _ in range(20):
            limits = reading.model.actuator_ctrlrange
            ctrl = limits.mean(axis=1) + rng.uniform(-0.2, 0.2, model.nu) * np.ptp(limits, axis=1)
            for m, d in ((model, data), (reading.model, own)):
                d.ctrl[:] = ctrl
                mujoco.mj_step(m, d, task.substeps)
        np.testing.assert_allclose(data.qpos, own.qpos, atol=1e-6, err_msg=name)


def test_one_element_moves_as_one():
    """Two changes of one element are two dimensions, however many numbers each changes."""
    space, _, _ = merge("crawler")
    assert space.size == 2 and len(space.parameters) == 5
    assert sorted(space.betas.tolist()) == [[0.0, 0.0], [0.5, 1.0], [1.0, 0.0]]
    elements = {p.element for p in FamilySpace(HAND_ROBOTS, LIFT).parameters}
    assert elements == {"finger.size", "finger.mass", "finger.joint", "finger.site", "thumb.mount"}


def other_hand(change):
    return replace(hand("other"), change=change)


BOX = mujoco.mjtGeom.mjGEOM_BOX
BIRD = replace(hand("bird", short=0.5), family=Family("birds", lambda body, quantity: body, "palm"))
ARMLESS = other_hand(lambda spec: spec.delete(spec.body("thumb")))
BOXY = other_hand(lambda spec: setattr(spec.geom("finger"), "type", BOX))
BROKEN = other_hand(lambda spec: setattr(spec.joint("finger"), "range", [1, 0]))


@pytest.mark.parametrize(
    ("robots", "task", "words"),
    [
        ((CRAWLER_ROBOTS[0],), CRAWL, "at least two different robots"),
        ((CRAWLER_ROBOTS[0], CRAWLER_ROBOTS[0]), CRAWL, "at least two different robots"),
        ((CRAWLER_ROBOTS[0], crawler("twin")), CRAWL, "do not differ"),
        ((HAND_ROBOTS[0], BIRD), LIFT, "families toy-hand and birds"),
        ((HAND_ROBOTS[0], ARMLESS), LIFT, "thumb"),
        ((HAND_ROBOTS[0], BOXY), LIFT, "finger"),
        ((HAND_ROBOTS[0], BROKEN), LIFT, "does not compile"),
    ],
)
def test_what_cannot_become_one_another_is_named(robots, task, words):
    with pytest.raises(ToolkitError, match=words):
        FamilySpace(robots, task)

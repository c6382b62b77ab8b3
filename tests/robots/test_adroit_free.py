"""The free ADROIT and its targets: one joint per finger moves, vanished fingers are out of the way, nothing blows up."""

import pickle
from dataclasses import replace
from functools import partial

import mujoco
import numpy as np
import pytest

from robots import MODEL_ROBOTS
from robots.adroit_free import FAMILY, REMNANT, SWING, become
from tasks import MODEL_TASKS
from toolkit.errors import ToolkitError
from toolkit.morphology.lab import Lab

HANDS = {"two-finger": ("ff",), "three-finger": ("ff", "lf"), "four-finger": ("ff", "mf", "lf")}
every_hand = pytest.mark.parametrize("name", HANDS)
TASKS = {name: task for name, task in MODEL_TASKS.items() if task.family == FAMILY.name and not task.staged}
every_task = pytest.mark.parametrize("task", TASKS.values(), ids=list(TASKS))


def models(task, *names):
    return [task.spec(MODEL_ROBOTS[name]).compile() for name in names]


def hand_joints(model):
    return [j for j in range(model.njnt) if model.joint(j).name[:2] in ("FF", "MF", "RF", "LF", "TH")]


def of_finger(model, letters):
    return [b for b in range(model.nbody) if model.body(b).name.startswith(letters)]


@every_hand
@every_task
def test_one_joint_moves_per_finger(task, name):
    (model,) = models(task, name)
    width = {model.joint(j).name: np.ptp(model.jnt_range[j]) for j in hand_joints(model)}
    moving = {joint for joint, size in width.items() if size > 1e-6}
    expected = {f"{finger.upper()}J2" for finger in HANDS[name]} | {"THJ3"}
    assert moving == expected, f"{name} moves {sorted(moving)} instead of {sorted(expected)}"
    for joint in expected:
        np.testing.assert_allclose(model.joint(joint).range, SWING)


@every_hand
def test_fingers_that_vanish_take_their_masses_along_and_lie_in_the_palm(name):
    source, model = models(MODEL_TASKS["relocate"], "adroit-free", name)
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    palm = model.geom("C_palm0").id
    for finger in ("ff", "mf", "rf", "lf"):
        bodies = [b for b in of_finger(model, finger) if "metacarpal" not in model.body(b).name]
        share = model.body_mass[bodies].sum() / source.body_mass[bodies].sum()
        assert share == pytest.approx(1.0 if finger in HANDS[name] else REMNANT), f"{name}: {finger} weighs {share} of itself"
        if finger in HANDS[name]:
            continue
        where = (data.xpos[bodies] - data.geom_xpos[palm]) @ data.geom_xmat[palm].reshape(3, 3)
        deep = (model.geom_size[palm] - np.abs(where)).min()
        assert deep > 0.002, f"{name}: {finger} ends {1000 * deep:.1f} mm inside the palm"


@every_hand
def test_nothing_of_a_target_touches_itself_at_rest(name):
    task = MODEL_TASKS["relocate"]
    (model,) = models(task, name)
    data = mujoco.MjData(model)
    for share in np.linspace(0, 0.75, 7):  # bent over further, four fingers meet where they close
        mujoco.mj_resetData(model, data)
        for finger in HANDS[name]:
            data.joint(f"{finger.upper()}J2").qpos = SWING[0] + share * np.ptp(SWING)
        data.joint("THJ3").qpos = SWING[1]
        mujoco.mj_forward(model, data)
        pairs = [(model.geom(c.geom1).name, model.geom(c.geom2).name) for c in data.contact]
        own = [pair for pair in pairs if all(geom.startswith("C_") for geom in pair)]
        assert not own, f"{name} bent over by {share:.0%}: {own} touch"


def test_the_two_fingers_meet_the_thumb():
    """Closed, the index's and the thumb's tips cross: there is something to pinch with."""
    (model,) = models(MODEL_TASKS["relocate"], "two-finger")
    data = mujoco.MjData(model)

    def gap(index, thumb):
        data.joint("FFJ2").qpos, data.joint("THJ3").qpos = index, thumb
        mujoco.mj_kinematics(model, data)
        axes = data.body("palm").xmat.reshape(3, 3)
        return ((data.site("S_fftip").xpos - data.site("S_thtip").xpos) @ axes)[2]

    assert gap(SWING[0], SWING[1]) > 0.15 and gap(SWING[1], SWING[0]) < 0, "opened and closed"


@every_hand
@every_task
def test_all_hands_have_the_same_parts(task, name):
    """What changes is sizes alone; and nothing but the hand's."""
    source, model = models(task, "adroit-free", name)
    for size in ("nbody", "njnt", "ngeom", "nu", "ntendon", "nsite", "nsensor", "npair", "nv", "nq"):
        assert getattr(source, size) == getattr(model, size), size
    for field in ("geom_type", "geom_contype", "geom_conaffinity", "jnt_type", "jnt_axis", "actuator_gainprm", "actuator_biasprm",
                  "tendon_range", "pair_geom1", "dof_damping", "dof_armature"):
        np.testing.assert_array_equal(getattr(source, field), getattr(model, field), field)
    hand = {b for b in range(source.nbody) if source.body(source.body_weldid[b]).name != "world"}
    changed = np.flatnonzero((source.body_pos != model.body_pos).any(1) | (source.body_mass != model.body_mass))
    names = {source.body(b).name for b in changed}
    assert names and set(changed) <= hand and not names & {"forearm", "wrist", "palm", "Object", "nail", "door", "latch", "frame"}


@pytest.mark.parametrize("name", ["adroit-free", *HANDS])
@every_task
def test_random_actions_leave_the_simulation_finite(task, name):
    (model,) = models(task, name)
    data, rng = mujoco.MjData(model), np.random.default_rng(0)
    scene = task.scene(model, data)
    low, high = model.actuator_ctrlrange.T
    for _ in range(2):
        mujoco.mj_resetData(model, data)
        scene.begin(rng)
        for _ in range(task.horizon // 2):
            data.ctrl[:] = rng.uniform(low, high)
            mujoco.mj_step(model, data, task.substeps)
            assert np.isfinite(scene.observe()).all() and np.abs(data.qvel).max() < 1000
        assert not any(warning.number for warning in data.warning), f"{name} in {task.name}: MuJoCo warns"


@every_hand
def test_the_sources_joints_begin_at_zero_and_a_targets_at_their_stop(name):
    task = MODEL_TASKS["door"]
    (model,) = models(task, name)
    data = mujoco.MjData(model)
    task.scene(model, data).begin(np.random.default_rng(0))
    for joint in ("FFJ2", "THJ3"):
        assert data.joint(joint).qpos[0] == pytest.approx(SWING[0])
    assert data.joint("FFJ1").qpos[0] == 0 and data.joint("ARRz").qpos[0] == 0


def test_elements_put_together_what_belongs_together():
    element = FAMILY.element
    assert element("mfmiddle", "mount") == element("mfproximal", "size") == element("mfproximal", "site")
    assert element("mfknuckle", "mass") == element("mfproximal", "mass") != element("mfmiddle", "mass")
    assert element("palm", "size") == element("lfmetacarpal", "size")
    assert element("thhub", "mount") == element("thproximal", "size") and element("thdistal", "mount") == element("thmiddle", "size")
    assert len({element(f"{finger}distal", "joint") for finger in ("ff", "mf", "rf", "lf", "th")}) == 5


@pytest.mark.parametrize("name", ["adroit-free", *HANDS])
def test_hands_go_to_other_processes(name):
    """Evaluations play in worker processes."""
    assert pickle.dumps(MODEL_ROBOTS[name]) and pickle.dumps(MODEL_TASKS["door"])


@pytest.mark.parametrize("fingers", [(), ("mf",), ("ff", "sixth")])
def test_a_hand_without_the_finger_that_meets_the_thumb_is_refused(fingers):
    odd = replace(MODEL_ROBOTS["two-finger"], name="odd", change=partial(become, fingers=fingers))
    with pytest.raises(ToolkitError, match="robot odd does not compile in task door: fingers are .*; name the index") as caught:
        Lab(MODEL_ROBOTS["adroit-free"], [odd], MODEL_TASKS["door"])
    assert "\n" not in str(caught.value)


def test_the_space_has_as_many_dimensions_as_the_papers():
    robots = [MODEL_ROBOTS[name] for name in HANDS]
    for task in TASKS.values():
        assert Lab(MODEL_ROBOTS["adroit-free"], robots, task).space.size == 65, task.name

"""Who can play which task, and by which law."""

from dataclasses import replace

import numpy as np
import pytest
from toys import CRAWLER_ROBOTS, HAND_ROBOTS, LIFT

from grippers.gripper import COMMANDED_ROLES
from robots import ROBOTS
from tasks import TASKS
from toolkit.errors import ToolkitError
from toolkit.morphology.lab import Lab
from toolkit.simulation.laws import LAWS, law_of, native_plant

BRICK = TASKS["061_foam_brick"]


def test_who_cannot_play_is_named():
    with pytest.raises(ToolkitError, match="'kinova3' cannot play task 'lift'.*family toy-hand"):
        Lab(HAND_ROBOTS[0], [ROBOTS["kinova3"]], LIFT)
    with pytest.raises(ToolkitError, match="'crawler' cannot play task 'lift'"):
        Lab(CRAWLER_ROBOTS[0], HAND_ROBOTS[1:], LIFT)
    with pytest.raises(ToolkitError, match="'short' cannot play task '061_foam_brick'.*arms with grippers"):
        Lab(ROBOTS["adroit"], [HAND_ROBOTS[1]], BRICK)
    odd = replace(LIFT, name="odd")
    object.__setattr__(odd, "control_law", "telepathy")
    with pytest.raises(ToolkitError, match=f"'telepathy'; there are: {', '.join(LAWS)}"):
        law_of(odd)


def test_only_the_jaco_sees_objects_from_elsewhere():
    """14 mm towards the thumb, along world y at the start, and part of it on the way there; counted from where the source holds."""
    adroit, jaco, kinova3 = (ROBOTS[name] for name in ("adroit", "jaco", "kinova3"))
    lab = Lab(adroit, [jaco, kinova3], BRICK)
    aside = Lab(replace(adroit, gripper=replace(adroit.gripper, grasp_offset=0.01)), [kinova3], BRICK)
    where, there = BRICK.observation.slice("object_from_grasp"), np.array([0.0, -jaco.gripper.grasp_offset, 0.0])
    betas = {name: lab.space.beta(name) for name in lab.space.names}
    for name, place in {"adroit": 0.0 * there, "kinova3": 0.0 * there, "jaco": there}.items():
        sight = lab.sight(betas[name], retargeted=False)
        np.testing.assert_allclose(sight.constant[where], place, atol=1e-12)
        np.testing.assert_array_equal(lab.sight(betas[name]).constant[where], sight.constant[where])
        assert not np.delete(sight.constant, np.arange(where.start, where.stop)).any()
        np.testing.assert_array_equal(sight.matrix, np.eye(BRICK.observation.size))
    half = lab.sight(0.5 * (betas["adroit"] + betas["jaco"]))
    np.testing.assert_allclose(half.constant[where], 0.5 * there, atol=1e-12)
    np.testing.assert_allclose(aside.sight(aside.space.beta("kinova3")).constant[where], [0.0, 0.01, 0.0], atol=1e-12)
    assert lab.sight(betas["adroit"]).is_plain and aside.sight(aside.space.beta("adroit")).is_plain
    assert Lab(HAND_ROBOTS[0], HAND_ROBOTS[1:], LIFT).sight(np.zeros(1)).is_plain


def closed_on_air(robot):
    """The observation of an unmodified robot whose gripper has closed in the air, and of its start."""
    plant = native_plant(robot, BRICK)
    start = plant.begin(0)
    action = np.zeros(BRICK.action.size)
    action[6:] = 1.0
    lift = np.array([0.0, 0.0, 1.0])
    for _ in range(10):
        plant.step(np.concatenate([lift, np.zeros(3), -np.ones(len(action) - 6)]))
    for _ in range(200):
        last = plant.step(action)
    return start, last


def test_a_gripper_is_seen_to_close_as_the_source_does():
    """On the unmodified robots: joints that a gripper lacks are seen open at the start, and closed on the box when it has closed; what
    the joints that it has do beyond that, as in the air, is seen as it is."""
    adroit, targets = ROBOTS["adroit"], [ROBOTS[name] for name in ("jaco", "kinova3")]
    lab = Lab(adroit, targets, BRICK)
    law, record = lab.merged.law, BRICK.observation
    fingers = slice(0, len(COMMANDED_ROLES))
    own = np.array([law.posture(lab.space.beta("adroit"))[role] for role in COMMANDED_ROLES])
    for robot in targets:
        beta = lab.space.beta(robot.name)
        sight, posture = lab.sight(beta), law.posture(beta)
        box = np.array([posture[role] for role in COMMANDED_ROLES])
        lacking = np.array([robot.gripper.joints.get(role) is None for role in COMMANDED_ROLES])
        assert 10 < lacking.sum() < len(COMMANDED_ROLES)
        start, closed = closed_on_air(robot)
        np.testing.assert_allclose(sight(start)[fingers], 0.0, atol=1e-6)
        assert closed[record.slice("closing_progress")] == pytest.approx(1.0)
        np.testing.assert_allclose(sight(closed)[fingers][lacking], own[lacking], atol=1e-12)
        np.testing.assert_allclose((sight(closed)[fingers] - own)[~lacking], (closed[fingers] - box)[~lacking], atol=1e-12)
        assert np.abs(box[~lacking]).max() > 0.3 and np.abs(own[lacking]).max() > 0.5

"""Who can play which task, and by which law."""

from dataclasses import replace

import numpy as np
import pytest
from toys import CRAWLER_ROBOTS, HAND_ROBOTS, LIFT

from toolkit.errors import ToolkitError
from toolkit.morphology.lab import Lab
from toolkit.simulation.laws import LAWS, law_of


def test_who_cannot_play_is_named():
    from robots import ROBOTS
    from tasks import TASKS

    with pytest.raises(ToolkitError, match="'kinova3' cannot play task 'lift'.*family toy-hand"):
        Lab(HAND_ROBOTS[0], [ROBOTS["kinova3"]], LIFT)
    with pytest.raises(ToolkitError, match="'crawler' cannot play task 'lift'"):
        Lab(CRAWLER_ROBOTS[0], HAND_ROBOTS[1:], LIFT)
    with pytest.raises(ToolkitError, match="'short' cannot play task '061_foam_brick'.*arms with grippers"):
        Lab(ROBOTS["adroit"], [HAND_ROBOTS[1]], TASKS["061_foam_brick"])
    odd = replace(LIFT, name="odd")
    object.__setattr__(odd, "control_law", "telepathy")
    with pytest.raises(ToolkitError, match=f"'telepathy'; there are: {', '.join(LAWS)}"):
        law_of(odd)


def test_only_the_jaco_sees_objects_from_elsewhere():
    """14 mm towards the thumb, along world y at the start, and part of it on the way there; counted from where the source holds."""
    from robots import ROBOTS
    from tasks import TASKS

    adroit, jaco, kinova3 = (ROBOTS[name] for name in ("adroit", "jaco", "kinova3"))
    task = TASKS["061_foam_brick"]
    lab = Lab(adroit, [jaco, kinova3], task)
    aside = Lab(replace(adroit, gripper=replace(adroit.gripper, grasp_offset=0.01)), [kinova3], task)
    where, there = task.observation.slice("object_from_grasp"), np.array([0.0, jaco.gripper.grasp_offset, 0.0])
    betas = {name: lab.space.beta(name) for name in lab.space.names}
    for name, place in {"adroit": 0.0 * there, "kinova3": 0.0 * there, "jaco": there}.items():
        offset = lab.offset(betas[name])
        np.testing.assert_allclose(offset[where], place, atol=1e-12)
        assert not np.delete(offset, np.arange(where.start, where.stop)).any()
    np.testing.assert_allclose(lab.offset(0.5 * (betas["adroit"] + betas["jaco"]))[where], 0.5 * there, atol=1e-12)
    np.testing.assert_allclose(aside.offset(aside.space.beta("kinova3"))[where], [0.0, -0.01, 0.0], atol=1e-12)
    assert not aside.offset(aside.space.beta("adroit")).any()
    assert not Lab(HAND_ROBOTS[0], HAND_ROBOTS[1:], LIFT).offset(np.zeros(1)).any()

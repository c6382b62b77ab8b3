"""The script: what it looks at, and where it grasps."""

import numpy as np

from tasks.objects import OBJECTS
from tasks.pick import OBSERVATION, OBSERVATION_SIZE
from toolkit.demonstrations.scripts import FINGER_DEPTH, PickScript, pick_script


def test_the_script_does_not_look_at_fingers():
    """So that one hand's posture never becomes part of the label."""
    rng, script = np.random.default_rng(0), PickScript()
    fingers = sum(name.startswith("finger/") for name in OBSERVATION)
    for _ in range(50):
        observation = 0.1 * rng.standard_normal(OBSERVATION_SIZE)
        other = observation.copy()
        other[:fingers] += 0.3 * rng.standard_normal(fingers)
        np.testing.assert_array_equal(script(observation), script(other))


def test_a_tall_object_is_grasped_below_its_top_not_at_its_centre():
    """At the can's centre the palm would rest on its top and the fingers would never close."""
    for item in OBJECTS.values():
        grasped = item.half_height + pick_script(item).object_from_grasp[2]
        assert grasped <= FINGER_DEPTH + 1e-12, f"{item.name} is grasped {grasped:.4f} m below its top"
    assert pick_script(OBJECTS["061_foam_brick"]).object_from_grasp[2] == 0.0

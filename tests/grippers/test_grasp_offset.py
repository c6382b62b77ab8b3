"""Where a gripper says that it holds an object, against where an object goes that its unmodified robot closes on."""

from dataclasses import replace

import numpy as np
import pytest

from tasks.objects import OBJECTS
from tasks.pick import OBSERVATION, START_ROTATION, PickTask
from toolkit.cli.names import find_robot
from toolkit.demonstrations.scripts import pick_script
from toolkit.simulation.laws import native_plant
from toolkit.simulation.rollout import play

TASK = PickTask(OBJECTS["061_foam_brick"])
CLOSE_TO = 0.006
"""[m] of the stated place; a jaw's linkage lets an object shift by some millimetres."""


@pytest.mark.parametrize(
    "name", ["jaco", "kinova3", *(pytest.param(name, marks=pytest.mark.slow) for name in ("iiwa", "panda", "ur5e", "sawyer"))]
)
def test_what_a_gripper_closes_on_comes_to_lie_where_its_card_says(name):
    """Wherever between the fingers the brick was, 12 mm to either side of the grasp frame: at the lift, and at the end."""
    robot, plant, places = find_robot(name), native_plant(find_robot(name), TASK), []
    item, progress = OBSERVATION.slice("object_from_grasp"), OBSERVATION.slice("closing_progress").start
    for aside in (-0.012, 0.0, 0.012):
        script = pick_script(TASK.object)
        begun = replace(script, object_from_grasp=tuple(aside * START_ROTATION[:, 0] + [0.0, 0.0, script.object_from_grasp[2]]))
        episode = play(plant, begun, 20_000_000, np.zeros(1))
        assert episode.success
        lifted = int(np.argmax(episode.observations[:, progress] > script.lift_from))
        across = episode.observations[:, item] @ START_ROTATION[:, 0]
        places.append((across[lifted] + across[-1]) / 2)
    assert np.mean(places) == pytest.approx(robot.gripper.grasp_offset, abs=CLOSE_TO), np.round(places, 4)

"""Where an arm would come to rest, against sums by hand."""


import mujoco
import numpy as np
import pytest

from tasks.pick import ACTION_SIZE
from toolkit.bundle.manifest import Braking, BrakingDistance
from toolkit.bundle.reading import load_bundle
from toolkit.deploy.arm import FORMS
from toolkit.export.braking import lowest_rest
from toolkit.export.datasheet import Played
from toolkit.export.packing import gripper_action_map


@pytest.fixture(scope="module")
def manifest():
    return load_bundle("kinova3").manifest


def falling(heights, actions=None):
    """One episode of a grasp frame that goes straight down with the gripper's lowest point."""
    heights = np.array(heights, float)
    grasp, steps = np.zeros((len(heights), 6)), len(heights) - 1
    grasp[:, 2] = heights + 0.9
    actions = np.zeros((steps, ACTION_SIZE)) if actions is None else actions
    return Played([np.zeros((steps, 28))], [actions], [np.zeros((steps + 1, 20))], [], [], [grasp], [heights], 1.0)


def test_the_lowest_rest_is_the_height_less_the_answer_and_the_braking_distance(manifest):
    """20 mm a tick are 0.4 m/s, from which the worst form brakes in 16 mm; only states with an answer count."""
    braking = Braking(tuple(BrakingDistance(form, 0.4, reach, 0.2) for form, reach in zip(FORMS, (0.010, 0.016, 0.012), strict=True)), 0.0)
    heights, step = [0.14, 0.12, 0.10, 0.08, 0.06], 1.0 / manifest.policy_hz
    assert 0.02 / step == pytest.approx(0.4)
    rest = lambda played, delay: lowest_rest(played, delay, braking, manifest, gripper_action_map())  # noqa: E731
    assert rest(falling(heights), 0) == pytest.approx(0.08 - 0.016)
    assert rest(falling(heights), 1) == pytest.approx(0.10 - 0.016), "the state at 80 mm is answered by no step of the episode"
    actions = np.zeros((4, ACTION_SIZE))
    actions[2, 2], actions[3, 2] = -0.5, 0.5
    answer = 0.5 * manifest.controller.translation_m * manifest.controller.response.steady[2]
    assert rest(falling(heights, actions), 0) == pytest.approx(min(0.10 - answer, 0.08 + answer) - 0.016)
    assert rest(falling(heights, actions), 1) == pytest.approx(min(0.12 - answer, 0.10 + answer) - 0.016)
    assert rest(falling(heights[::-1]), 0) == pytest.approx(0.08), "what rises would not come lower"
    half = rest(falling([0.14, 0.13, 0.12]), 0)
    assert half == pytest.approx(0.13 - 0.008), "between rest and the slowest speed measured, in proportion"


@pytest.mark.slow
def test_braking_distances_are_those_of_robosuites_own_step(alone, native):
    robot, braking = native("panda"), alone("panda")[1]["braking"]
    for form in ("osc", "pose", "joint"):
        rows = [row for row in braking["distances"] if row["form"] == form]
        assert len(rows) == 3 and all(a["speed_m_s"] < b["speed_m_s"] and a["distance_m"] < b["distance_m"]
                                      for a, b in zip(rows, rows[1:], strict=False))
        assert 0.15 < rows[-1]["speed_m_s"] < 0.4 and rows[-1]["distance_m"] < 0.06 and 0 < rows[-1]["time_s"] <= 0.8
    site = robot.model.site("gripper0_right_grip_site").id
    says, speeds, gone = next(row for row in braking["distances"][::-1] if row["form"] == "osc"), [], []
    for direction in ((1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1)):
        robot.begin(0)
        places = []
        for step in range(24):
            robot.apply((step < 8) * np.array([*direction, 0, 0, 0, -1.0]))  # held, a gripper does not go on either
            mujoco.mj_kinematics(robot.model, robot.data)  # after a step, poses are a substep older than angles
            places.append(robot.data.site_xpos[site].copy())
        speeds.append(np.linalg.norm(places[7] - places[6]) * 20)
        gone.append(max(np.linalg.norm(place - places[7]) for place in places[8:]))
    assert max(speeds) == pytest.approx(says["speed_m_s"], abs=1e-4)
    assert max(gone) == pytest.approx(says["distance_m"], abs=3e-4)  # its limits let the deltas grow from rest, here they are whole at once
    assert says["distance_m"] > 0.005, "robosuite's arm yields"

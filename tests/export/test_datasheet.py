"""What is measured on robosuite's robot: how far it moves, how its gripper opens, which delays a policy bears."""


import numpy as np
import pytest
from exported_targets import TARGETS

from robots import ROBOTS
from tasks.pick import ACTION_SIZE, OBSERVATION
from toolkit.export.datasheet import BRUSHING, Played, borne_delays


@pytest.mark.parametrize("name", TARGETS)
def test_the_response_says_how_far_robosuites_own_step_moves(exported, native, name):
    """One delta through robosuite's env.step: the grasp frame moves by the measured share of it."""
    response, robot = exported(name)[1].controller.response, native(name)
    site = robot.model.site("gripper0_right_grip_site").id
    for axis in range(3):
        robot.begin(0)
        before, native_action = robot.data.site_xpos[site].copy(), np.zeros(7)
        for step in range(len(response.impulse[axis])):
            native_action[axis], native_action[6] = (response.amplitude if step == 0 else 0.0), -1.0
            robot.apply(native_action)
        moved = (robot.data.site_xpos[site] - before)[axis]
        wanted = response.steady[axis] * response.amplitude * 0.05
        assert moved == pytest.approx(wanted, abs=2e-5), f"{name}, axis {axis}: {moved:.5f} m, the manifest says {wanted:.5f} m"
        assert 0.1 < response.steady[axis] < 0.4


@pytest.mark.parametrize("name", TARGETS)
def test_the_gripper_opens_and_closes(exported, name):
    gripper = exported(name)[1].gripper
    assert gripper.opening_m[0] > 0.06 and gripper.opening_m[-1] < 0.01, f"{name}: {gripper.opening_m[0]} to {gripper.opening_m[-1]} m"


@pytest.mark.parametrize("name", TARGETS)
def test_the_finger_map_gives_the_observation(exported, native, name):
    """sign * (angle - start) from robosuite's own joint angles is what the policy sees."""
    robot = native(name)
    action = np.ones(ACTION_SIZE)
    action[:6] = (0, 0, 0.5, 0, 0, 0)
    for _ in range(8):
        observation = robot.step(action)
    manifest, seen = exported(name)[1], {}
    for entry, row in manifest.fingers.items():
        angle = float(robot.data.joint("gripper0_right_" + row.joint).qpos[0])
        seen[entry] = row.sign * (angle - row.start_rad)
    wanted = dict(zip(OBSERVATION.names, observation, strict=True))
    fingers = {key: wanted[key] for key in OBSERVATION if key.startswith("finger/")}
    assert {key: seen.get(key, 0.0) for key in fingers} == pytest.approx(fingers, abs=1e-12)
    hinges = [role for role in ROBOTS[name].gripper.joints if f"finger/{role}" in OBSERVATION]
    assert len(seen) == len(hinges) and (not hinges or max(map(abs, seen.values())) > 0.01)


def late(success, lowest):
    return Played([], [], [], [], [], [], [np.array([0.1, lowest])], success)


@pytest.mark.parametrize("calm, of_delay, longest, borne", [
    (0.008, [(1.0, 0.001), (1.0, -0.001)], 2, 1),  # the second comes on the table
    (0.008, [(1.0, 0.001), (1.0, -0.001)], 0, 0),
    (0.008, [(0.8, 0.005), (1.0, 0.005)], 2, 0),  # what fails a little late is not tried later
    (0.008, [(0.9, 0.0), (1.0, 0.004)], 2, 2),
    (-0.001, [(1.0, -0.001 - BRUSHING), (1.0, -0.006)], 2, 1),  # brushes the table undisturbed
])
def test_a_delay_is_borne_if_the_policy_succeeds_and_the_gripper_stays_off_the_table(calm, of_delay, longest, borne):
    tried = []

    def play(delay):
        tried.append(delay)
        return late(*of_delay[delay - 1])

    found = borne_delays(late(1.0, calm), play, longest)
    assert len(found) == borne + 1 and tried == list(range(1, min(longest, borne + 1) + 1))

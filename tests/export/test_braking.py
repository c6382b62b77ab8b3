"""Where an arm would come to rest, against sums by hand."""

import numpy as np
import pytest

from tasks.pick import ACTION_SIZE
from toolkit.bundle.manifest import Braking, BrakingDistance
from toolkit.bundle.reading import load_bundle
from toolkit.deploy.arm import FORMS
from toolkit.export.braking import lowest_rest
from toolkit.export.datasheet import BRUSHING, Played, borne_delays
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

"""The script that follows a recorded track: beside the object it comes back, and what it holds it carries to the goal."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from grippers.gripper import COMMANDED_ROLES
from tasks.pick import ACTION_SIZE, OBSERVATION_SIZE
from toolkit.demonstrations.scripts import entry
from toolkit.demonstrations.tracks import Track, TrackScript, _stretch
from toolkit.simulation.plant import CLOSING

points = st.tuples(*[st.floats(-0.1, 0.1)] * 3).map(np.array)


def straight_track(round_=False):
    T = 30
    down = np.linspace(0.1, 0.0, T)
    commands = np.full((T, len(COMMANDED_ROLES)), -1.0)
    commands[12:] = 1.0
    goal = np.zeros((T, 3))
    goal[:, 1:] = np.outer(np.r_[np.ones(15), np.linspace(1, 0, 15)], [0.1, 0.2])
    return Track("straight", np.stack([0 * down, 0 * down, -down], axis=1), np.zeros((T, 3)), commands, goal, 14, round_)


def observation_of(**entries):
    observation = np.zeros(OBSERVATION_SIZE)
    for name, value in entries.items():
        entry(observation, name)[...] = value
    return observation


def test_the_track_turns_with_the_object():
    script = TrackScript(straight_track(), np.array([0.0, 0.1, 0.2]), CLOSING)
    offset, yaw = np.array([0.02, -0.01, -0.05]), 0.4
    R = Rotation.from_rotvec([0, 0, yaw]).as_matrix()
    plain = script(observation_of(object_from_grasp=offset, closing_progress=-1))
    turned = script(observation_of(object_from_grasp=R @ offset, closing_progress=-1, object_rotation=[0, 0, np.sin(yaw)]))
    np.testing.assert_allclose(turned[:3], np.clip(R @ plain[:3], -1, 1), atol=1e-9)
    assert turned[5] > plain[5], "the hand does not turn with the object"
    assert turned.shape == (ACTION_SIZE,)


def test_a_can_has_no_yaw():
    script = TrackScript(straight_track(True), np.array([0.0, 0.1, 0.2]), CLOSING)
    seen = dict(object_from_grasp=[0.02, -0.01, -0.05], closing_progress=-1)
    np.testing.assert_array_equal(script(observation_of(**seen)), script(observation_of(**seen, object_rotation=[0, 0, 0.5])))


def test_fingers_close_where_the_hand_is_aligned_and_not_beside_it():
    script = TrackScript(straight_track(), np.array([0.0, 0.1, 0.2]), CLOSING)
    there = script._offset[-1]
    aligned = script(observation_of(object_from_grasp=there, closing_progress=-1))
    beside = script(observation_of(object_from_grasp=there + [0.03, 0, 0], closing_progress=-1))
    assert (aligned[6:] == 1).all() and (beside[6:] == -1).all()
    assert beside[2] > aligned[2], "a hand beside the object comes down"


def test_fingers_that_closed_beside_the_object_open_and_come_back_over_it():
    """A hand overshoots: without this it lifts nothing for the rest of the episode."""
    script = TrackScript(straight_track(), np.array([0.0, 0.1, 0.2]), CLOSING)
    beside = script._offset[-1] + [-0.045, 0.0, -0.02]
    for progress in (1.0, 0.5, 0.0):
        action = script(observation_of(object_from_grasp=beside, closing_progress=progress, goal_from_object=[0.0, 0.1, 0.2]))
        assert (action[6:] == -1).all(), f"at progress {progress} the fingers stay closed on nothing"
        assert action[0] < 0 < action[2], "the hand does not go back, above the object"
    held = script(observation_of(object_from_grasp=script._offset[-1] + [0.0, 0.01, -0.01], closing_progress=1.0,
                                 goal_from_object=[0.0, 0.1, 0.2]))
    assert (held[6:] == 1).all() and held[2] > 0.5, "what is held, if a little off, is let go"


def test_a_held_object_is_carried_to_the_tasks_goal():
    offset = np.array([0.0, 0.1, 0.2])
    script = TrackScript(straight_track(), offset, CLOSING)
    held = dict(closing_progress=1, object_from_grasp=script._offset[-1])
    at_goal = script(observation_of(**held))
    np.testing.assert_allclose(at_goal[:3], 0, atol=1e-9)
    lifted = script(observation_of(**held, goal_from_object=offset))
    assert lifted[2] > 0.5 and (lifted[6:] == 1).all()


@given(recorded=points, wanted=points)
def test_the_way_is_stretched_to_the_goal(recorded, wanted):
    S = _stretch(recorded, wanted)
    if np.hypot(*recorded[:2]) > 0.02:
        np.testing.assert_allclose((S @ recorded)[:2], wanted[:2], atol=1e-9)
    if abs(recorded[2]) > 0.02:
        np.testing.assert_allclose((S @ recorded)[2], wanted[2], atol=1e-9)

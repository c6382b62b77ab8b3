"""From an arm's state to the policy's observation."""

import numpy as np

from toolkit.deploy.arm import State
from toolkit.deploy.kinematics import Kinematics
from toolkit.deploy.observer import Observer
from toolkit.deploy.runtime import replay_golden

TURN = 2 * np.pi


def endless(bundle):
    return np.array([joint.low is None for joint in bundle.manifest.joints])


def test_the_observation_and_the_recorded_episode_do_not_see_turns(bundle):
    kinematics = Kinematics.of(bundle.manifest, bundle.mjcf)
    g, seen = bundle.golden, []
    for shift in (0.0, TURN * 5):
        observer = Observer(bundle.manifest, kinematics)
        rows = zip(*(g[f"episode_{key}"][:20] for key in ("joints", "object_position", "object_quaternion", "fingers")), strict=True)
        states = [State(0.0, arm + shift * endless(bundle), place, turn, g["episode_goal"], fingers) for arm, place, turn, fingers in rows]
        seen.append([observer(state, -1.0) for state in states])
    np.testing.assert_allclose(seen[0], seen[1], atol=1e-9)
    assert max(replay_golden(bundle).values()) < 1e-5


def test_an_endless_joint_may_turn_on_and_on(bundle):
    """More than half a turn from the start, slowly: it is followed, not folded back."""
    observer, g = Observer(bundle.manifest, Kinematics.of(bundle.manifest, bundle.mjcf)), bundle.golden
    for step in range(60):
        true = g["episode_joints"][0] + 0.3 * step * endless(bundle)
        read = (true + np.pi) % TURN - np.pi if step % 2 else true
        read = np.where(endless(bundle), read, true)
        state = State(0.0, read, g["episode_object_position"][0], g["episode_object_quaternion"][0], g["episode_goal"],
                      g["episode_fingers"][0])
        np.testing.assert_allclose(observer.arm(state), true, atol=1e-9)
        observer(state, -1.0)

"""From an arm's state to the policy's observation: by name, in the manifest's order, whatever the arm reports and however it counts."""

import dataclasses

import numpy as np
import pytest

from toolkit.bundle.reading import load_bundle
from toolkit.deploy.arm import ArmInfo, State
from toolkit.deploy.kinematics import Kinematics
from toolkit.deploy.observer import Observer
from toolkit.deploy.runtime import replay_golden
from toolkit.errors import ToolkitError

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


@pytest.fixture
def kinematics(bundle):
    return Kinematics.of(bundle.manifest, bundle.mjcf)


def state_of(bundle, tick=10, **changes):
    g = bundle.golden
    seen = {key: g[f"episode_{key}"][tick] for key in ("joints", "object_position", "object_quaternion", "fingers")}
    return State(0.0, **seen | {"goal": g["episode_goal"]} | changes)


def test_an_arm_may_report_its_joints_and_fingers_in_its_own_order(bundle, kinematics):
    manifest, rng = bundle.manifest, np.random.default_rng(1)
    arm, hand = rng.permutation(len(manifest.joints)), rng.permutation(len(manifest.gripper.joints))
    assert (np.diff(arm) < 0).any() and (np.diff(hand) < 0).any()
    names = tuple(manifest.joints[i].name for i in arm), tuple(manifest.gripper.joints[i] for i in hand)
    other, plain = Observer(manifest, kinematics, ArmInfo(manifest.robot.name, *names, ("joint",), 40.0)), Observer(manifest, kinematics)
    state = state_of(bundle)
    turned = dataclasses.replace(state, joints=state.joints[arm], fingers=state.fingers[hand])
    np.testing.assert_array_equal(other(turned, -0.5), plain(state, -0.5))
    np.testing.assert_array_equal(other.in_order(np.arange(len(arm))[arm]), np.arange(len(arm)))


def test_distances_are_those_that_the_cameras_report(bundle, kinematics):
    observer, state = Observer(bundle.manifest, kinematics), state_of(bundle)
    seen = observer(state, 0.25)
    names = [entry.name for entry in bundle.manifest.observation]
    ends = np.cumsum([entry.size for entry in bundle.manifest.observation])
    told = dict(zip(names, np.split(seen, ends[:-1]), strict=True))
    np.testing.assert_allclose(seen[observer.goal], state.goal - state.object_position, atol=1e-12)
    np.testing.assert_array_equal(seen[observer.goal], told["goal_from_object"])
    np.testing.assert_allclose(told["object_from_grasp"] + kinematics.position, state.object_position, atol=1e-12)
    np.testing.assert_allclose(told["grasp_position"] + bundle.manifest.start.grasp_position_m, kinematics.position, atol=1e-12)


@pytest.mark.parametrize("share", [0.0, 0.3, 1.0])
def test_a_gripper_that_reports_its_opening_alone_has_the_tables_fingers(bundle, kinematics, share):
    """Between the rows of the manifest's table whose openings enclose it."""
    openings, table = np.array(bundle.manifest.gripper.opening_m), np.array(bundle.manifest.gripper.joint_positions)
    found = Observer(bundle.manifest, kinematics).fingers(state_of(bundle, fingers=None, opening=share))
    wide = share * openings[0]
    rows = table[(openings >= openings[openings <= wide].max()) & (openings <= openings[openings >= wide].min())]
    assert (found >= rows.min(axis=0) - 1e-9).all() and (found <= rows.max(axis=0) + 1e-9).all()
    assert np.ptp(table, axis=0).max() > 0.5 > 2 * np.ptp(rows, axis=0).max(), "the test should see a difference"


def test_a_gripper_that_reports_nothing_is_seen_as_nothing(bundle, kinematics):
    observer = Observer(bundle.manifest, kinematics)
    assert np.isnan(observer.fingers(state_of(bundle, fingers=None))).all()


@pytest.mark.parametrize("name", ["kinova3", "jaco"])
def test_progress_goes_from_the_preshape_to_closed(name):
    """The Jaco starts half closed."""
    shipped = load_bundle(name)
    observer, start = Observer(shipped.manifest, Kinematics.of(shipped.manifest, shipped.mjcf)), shipped.manifest.gripper.preshape
    assert [observer.progress(at) for at in (start, (start + 1) / 2, 1.0)] == pytest.approx([-1.0, 0.0, 1.0])


def test_an_entry_that_this_release_cannot_assemble_is_named(bundle, kinematics):
    entries = list(bundle.manifest.observation)
    at = next(k for k, entry in enumerate(entries) if entry.name == "object_from_grasp")
    entries[at] = dataclasses.replace(entries[at], name="object_in_camera")
    with pytest.raises(ToolkitError, match=f"the bundle observes '{entries[at].name}' of size {entries[at].size}, which this release"):
        Observer(dataclasses.replace(bundle.manifest, observation=tuple(entries)), kinematics)

"""Angles that repeat themselves: an endless joint a turn off, or wrapping in mid-episode, is where it is.

Places: observation, guard, motion and solver (all see what the observer makes of a reading), the command that goes out, the
twin's servo, and the drivers of arms that have endless joints.
"""

import dataclasses
import time

import numpy as np
import pytest

from robots import ROBOTS
from toolkit.bundle.reading import load_bundle
from toolkit.deploy.arm import ArmInfo, Command, State
from toolkit.deploy.drivers.kortex import Kortex
from toolkit.deploy.runtime import Runtime
from toolkit.export.twin import Twin

TURN = 2 * np.pi
TICKS = 30


@pytest.fixture(scope="module")
def bundle():
    """Of the Gen3, every other joint of which has no end; those of the other two arms have limits."""
    return load_bundle("kinova3")


def endless(bundle):
    return np.array([joint.low is None for joint in bundle.manifest.joints])


def info_of(bundle, joints=None):
    names = tuple(joint.name for joint in bundle.manifest.joints)
    return ArmInfo(bundle.manifest.robot.name, joints or names, bundle.manifest.gripper.joints, ("osc", "pose", "joint"), 100.0)


def played(bundle, form, turns=lambda tick: 0.0, order=None):
    """What an arm that moves as in the golden episode (told joint targets: that follows them exactly), and counts turns in its own way, is
    sent; angles as it reports them.

    Args:
        turns: tick -> whole turns (n,) by which its readings differ.
        order: of its joints, if not the bundle's.
    """
    n = len(bundle.manifest.joints)
    order = np.arange(n) if order is None else order
    names = tuple(bundle.manifest.joints[i].name for i in order)
    runtime, g = Runtime(bundle, info_of(bundle, names), form), bundle.golden
    angles, sent, read = g["episode_joints"][0].copy(), [], []
    for tick in range(TICKS):
        shift = TURN * turns(tick) * endless(bundle)
        angles = angles if form == "joint" else g["episode_joints"][tick]
        state = State(0.05 * tick, (angles + shift)[order], g["episode_object_position"][tick], g["episode_object_quaternion"][tick],
                      g["episode_goal"], g["episode_fingers"][tick])
        if tick == 0:
            assert runtime.begin(state, state.stamp) is None
        done = runtime.tick(state, state.stamp)
        assert done.fault is None, f"tick {tick}: {done.fault}"
        read.append(state.joints)
        sent.append(done.command)
        if form == "joint":
            back = np.argsort(order)
            angles = done.command.target[back] - TURN * turns(0) * endless(bundle)
    return sent, np.array(read)


def alike(form, tick, found, wanted):
    """To the last bits; the joint form only until its solver sees the table, whose nearest points jump with the last bit of a pose."""
    np.testing.assert_allclose(found, wanted, atol=1e-9 if form != "joint" or tick < 6 else 0.1)


def plain(bundle, form):
    return played(bundle, form)[0]


def test_there_are_endless_joints(bundle):
    assert endless(bundle).tolist() == [True, False, True, False, True, False, True]


@pytest.mark.parametrize("form", ["osc", "pose", "joint"])
@pytest.mark.parametrize("turns", [1, -1, 3, -40])
def test_an_endless_joint_some_turns_off_stands_where_it_stands(bundle, form, turns):
    """Driven back, the wrist of the Gen3 once made a whole turn with the object in the hand."""
    usual, (sent, read) = plain(bundle, form), played(bundle, form, lambda tick: turns)
    for tick, (one, other) in enumerate(zip(usual, sent, strict=True)):
        shift = TURN * turns * endless(bundle) if form == "joint" else 0.0
        alike(form, tick, other.target, one.target + shift)
        if form == "joint":
            alike(form, tick, other.waypoints, one.waypoints + shift)
    if form == "joint":
        away = np.abs([command.target - row for command, row in zip(sent, read, strict=True)])
        assert away.max() < 0.2, f"a target lies {away.max():.2f} rad from the arm's own reading"


@pytest.mark.parametrize("form", ["osc", "pose", "joint"])
def test_a_reading_that_wraps_in_mid_episode_is_no_jump(bundle, form):
    """Forth and back, and for each joint at another moment; once it was a tracking fault of 6.28 rad. What is sent does not jump."""
    n = len(bundle.manifest.joints)
    wrap = lambda tick: np.where(tick >= 3 + np.arange(n) % 4, -1, 0) + (tick >= 20)  # noqa: E731
    usual, (sent, _) = plain(bundle, form), played(bundle, form, wrap)
    for tick, (one, other) in enumerate(zip(usual, sent, strict=True)):
        alike(form, tick, other.target, one.target)


def test_a_hold_stands_in_the_arms_own_turn(bundle):
    runtime, g = Runtime(bundle, info_of(bundle), "joint"), bundle.golden
    shift = TURN * 2 * endless(bundle)
    state = State(0.0, g["episode_joints"][0] + shift, g["episode_object_position"][0], g["episode_object_quaternion"][0],
                  g["episode_goal"], g["episode_fingers"][0])
    assert runtime.begin(state, 0.0) is None
    tick = runtime.tick(dataclasses.replace(state, fault="protective stop"), 0.0)
    assert tick.command.hold and np.abs(tick.command.target - state.joints).max() < 1e-9
    assert np.abs(tick.command.waypoints - state.joints).max() < 1e-9


def test_a_joint_with_limits_is_not_turned(bundle):
    """A turn off, it stands elsewhere: beyond its limits, or at a place that only looks alike."""
    limited = np.flatnonzero(~endless(bundle))
    runtime, g = Runtime(bundle, info_of(bundle), "joint"), bundle.golden
    joints = g["episode_joints"][0].copy()
    joints[limited[0]] += TURN
    state = State(0.0, joints, g["episode_object_position"][0], g["episode_object_quaternion"][0], g["episode_goal"],
                  g["episode_fingers"][0])
    fault = runtime.begin(state, 0.0)
    assert fault is not None and fault.kind in ("joint_limit", "start_pose")


@pytest.mark.parametrize("reading", [1e5, -1e12, 1e300])
def test_turns_that_no_encoder_counts_are_nonsense(bundle, reading):
    """Taken modulo a turn, any number would pass for an angle."""
    runtime, g = Runtime(bundle, info_of(bundle), "osc"), bundle.golden
    joints = g["episode_joints"][0].copy()
    joints[np.flatnonzero(endless(bundle))[0]] = reading
    state = State(0.0, joints, g["episode_object_position"][0], g["episode_object_quaternion"][0], g["episode_goal"],
                  g["episode_fingers"][0])
    fault = runtime.begin(state, 0.0)
    assert fault is not None and fault.kind == "joint_limit" and "no encoder counts" in fault.detail


def test_commands_are_in_the_arms_own_order_of_joints(bundle):
    """State and command speak of the same joint by the same place, turns included."""
    n = len(bundle.manifest.joints)
    order = np.random.default_rng(3).permutation(n)
    usual, (sent, _) = plain(bundle, "joint"), played(bundle, "joint", lambda tick: 1, order)
    for tick, (one, other) in enumerate(zip(usual, sent, strict=True)):
        alike("joint", tick, other.target, (one.target + TURN * endless(bundle))[order])
        alike("joint", tick, other.waypoints, (one.waypoints + TURN * endless(bundle))[:, order])
        alike("joint", tick, other.rate / 10, one.rate[order] / 10)


def test_the_twins_servo_takes_the_shorter_way(task):
    twin = Twin(ROBOTS["kinova3"], task, "lockstep")
    ends = []
    for turns in (0, 1, -3):
        twin.begin(0)
        start = np.array(twin.read()["joints"])
        target = start + 0.02 + TURN * turns * twin._endless
        command = Command("joint", False, target, np.zeros(7), 0.0, 1.0, 0.1, np.repeat(target[None], 5, axis=0))
        for _ in range(6):
            twin.send(command)
        ends.append(np.array(twin.read()["joints"]) - start)
    assert twin._endless.sum() == 4
    np.testing.assert_allclose(ends[1], ends[0], atol=1e-9)
    np.testing.assert_allclose(ends[2], ends[0], atol=1e-9)


def test_kortex_drives_the_shorter_way_whatever_turn_is_asked_for(gen3):
    gen3.angles = np.radians(np.full(7, 359.0))
    for turns in (0, 1, -2):
        gen3.rate, gen3.angles, gen3.speeds[:] = np.zeros(7), np.radians(np.full(7, 359.0)), []
        arm = Kortex("here", "kinova3", [f"j{i}" for i in range(7)], lambda: (np.zeros(3), np.array([1.0, 0, 0, 0]), np.zeros(3), 0.0),
                     ("user", "secret"))
        arm.connect()
        arm.read()
        target = np.radians(1.0) + np.full(7, TURN * turns)
        arm.send(Command("joint", False, target, np.zeros(7), 0.0, 1.0, 0.1, target[None]))
        while not gen3.speeds:
            time.sleep(0.001)
        arm.stop("seen")
        np.testing.assert_allclose(np.degrees(gen3.speeds[0][1]), 2.0 * 2.0, atol=1e-6)

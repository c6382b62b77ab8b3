"""No unsafe command: whatever policy and observations do, commands stay within the manifest, and a fault holds the arm.

The suite plays 1500 ticks per form. A million per form take about an hour of an idle core:

    META_EVOLVE_SAFETY_TICKS=1000000 python -m pytest tests/deploy/test_safety.py -k adversarial
"""

import dataclasses
import os
import re

import mujoco
import numpy as np
import pytest

from toolkit.bundle.reading import load_bundle
from toolkit.deploy.arm import ArmInfo, State
from toolkit.deploy.kinematics import Kinematics, rotation_of, vector_of
from toolkit.deploy.motion import Expected, Track
from toolkit.deploy.runtime import Runtime
from toolkit.deploy.safety import OVERSHOOT, PASSING

TICKS = int(os.environ.get("META_EVOLVE_SAFETY_TICKS", 1500))
ROUNDING = 1e-9


@pytest.fixture(scope="module")
def bundle():
    return load_bundle("kinova3")


def info_of(manifest, **changes):
    joints = tuple(joint.name for joint in manifest.joints)
    facts = {"robot": manifest.robot.name, "joints": joints, "fingers": manifest.gripper.joints, "forms": ("osc", "pose", "joint"),
             "rate_hz": 100.0, "model_sha256": manifest.robot.model_sha256}
    return ArmInfo(**facts | changes)


def start_state(bundle, now=0.0):
    """What the recorded episode's arm reported first."""
    g = bundle.golden
    return State(now, g["episode_joints"][0].copy(), g["episode_object_position"][0].copy(), g["episode_object_quaternion"][0].copy(),
                 g["episode_goal"].copy(), g["episode_fingers"][0].copy(), speeds=np.zeros(len(bundle.manifest.joints)),
                 efforts=np.zeros(len(bundle.manifest.joints)))


def changed(state, **changes):
    return State(**{**{key: getattr(state, key) for key in State.__dataclass_fields__}, **changes})


# -- the limiter -------------------------------------------------------------------------------------------------------


def test_a_track_never_leaves_its_limits_in_a_million_ticks():
    """1000 coordinates with limits of their own, 1000 ticks of adversarial wishes; checked between ticks, too."""
    rng = np.random.default_rng(0)
    n, period = 1000, 0.05
    low = rng.uniform(-3, 0, n)
    high = low + 10.0 ** rng.uniform(-3, 1, n)
    speed, push = 10.0 ** rng.uniform(-2, 1, n), 10.0 ** rng.uniform(-1, 2, n)
    low[::7], high[::11] = -np.inf, np.inf
    track = Track(low, high, speed, push, period)
    track.begin(rng.uniform(np.maximum(low, -3), np.minimum(high, 10)))
    mood = rng.uniform(-1, 1, n)
    for tick in range(1000):
        if tick % 20 == 0:
            mood = rng.choice([-1.0, 0.0, 1.0], n)
        wanted = np.where(rng.random(n) < 0.2, rng.choice([np.nan, np.inf, -np.inf, 1e30, 0.0], n), mood * 2 * speed * rng.random(n))
        place, rate = track.place, track.rate
        track.advance(wanted)
        assert np.isfinite(track.place).all() and np.isfinite(track.rate).all()
        assert (np.abs(track.rate) <= speed * (1 + ROUNDING)).all()
        assert (np.abs(track.rate - rate) <= push * period * (1 + 1e-6) + ROUNDING).all(), "acceleration"
        between = track.waypoints(place, rate, 5)
        assert ((between >= low - ROUNDING) & (between <= high + ROUNDING)).all(), "left its limits"
        moved = place + 0.5 * period * (rate + track.rate)
        assert np.abs(moved - track.place).max() < 1e-7, "a clip hid that braking came too late"
        np.testing.assert_allclose(between[-1], track.place, atol=1e-9)


def test_a_track_reaches_what_it_is_asked_for():
    """A steady wish inside the limits comes true: the limiter does not creep."""
    rng, n, period = np.random.default_rng(1), 500, 0.05
    speed, push, room = 10.0 ** rng.uniform(-2, 1, n), 10.0 ** rng.uniform(-1, 2, n), 10.0 ** rng.uniform(-2, 1, n)
    track = Track(np.zeros(n), room, speed, push, period)
    track.begin(0.5 * room)
    goal = room * rng.uniform(0.02, 0.98, n)
    for _ in range(int((20 * (room / speed + 2 * np.sqrt(room / push) + speed / push)).max()) + 400):
        track.advance(0.5 * (goal - track.place) / period)
    assert (np.abs(track.place - goal) <= np.maximum(1e-3 * room, 3 * push * period**2)).all()


# -- adversarial episodes ----------------------------------------------------------------------------------------------


class Checker:
    """The manifest's limits, read again and checked without the code under test."""

    def __init__(self, bundle, form):
        m = self.m = bundle.manifest
        self.form, self.period, self.last = form, 1 / m.policy_hz, None
        self.model = mujoco.MjModel.from_xml_string(bundle.mjcf)
        self.data = mujoco.MjData(self.model)
        self.address = [int(self.model.joint(joint.name).qposadr[0]) for joint in m.joints]
        self.start = rotation_matrix(m.start.grasp_quaternion)
        self.base = rotation_matrix(m.robot.base_quaternion)

    def begin(self):
        self.last = None

    def check(self, command, joints):
        gripper = [command.grip, command.opening, command.opening_m]
        numbers = np.concatenate([command.target, command.rate, command.waypoints.ravel(), gripper])
        assert np.isfinite(numbers).all() and command.form == self.form
        assert command.grip in (-1, 0, 1) and 0 <= command.opening <= 1
        if command.hold:
            assert not np.any(command.rate) and command.grip == 0
        getattr(self, f"check_{self.form}")(command, joints)
        self.last = command

    def check_osc(self, command, joints):
        m, action = self.m, command.target
        limits = [(entry.low, entry.high, entry.step) for entry in m.action[:6]]
        before = np.zeros(6) if self.last is None else self.last.target
        for i, (low, high, step) in enumerate(limits):
            assert low <= action[i] <= high
            # Slowing down may be as quick as the workspace asks for; speeding up may not.
            if abs(action[i]) > abs(before[i]) or action[i] * before[i] < 0:
                assert abs(action[i] - before[i]) <= step + ROUNDING
        if command.hold:
            assert not action.any()
            return
        scale = np.repeat([m.controller.translation_m, m.controller.rotation_rad], 3)
        expected = np.abs(action) * scale * np.abs(m.controller.response.steady) * m.policy_hz
        assert (expected <= np.array(m.cartesian.speed) + ROUNDING).all()
        here = self.coordinates(joints)
        goal = here + action * scale
        outside = np.maximum(np.array(m.cartesian.low) - goal, goal - np.array(m.cartesian.high))
        already = np.maximum(np.array(m.cartesian.low) - here, here - np.array(m.cartesian.high))
        assert (outside <= np.maximum(already, 0) + 1e-6).all(), "the goal leaves the workspace box"

    def check_pose(self, command, joints):
        m = self.m
        for row in command.waypoints:
            assert abs(np.linalg.norm(row[3:]) - 1) < 1e-9
            place = self.from_base(row)
            low, high = np.array(m.cartesian.low), np.array(m.cartesian.high)
            assert (place >= low - 1e-6).all() and (place <= high + 1e-6).all(), "outside the workspace box"
        assert (np.abs(command.rate[:3]) <= np.array(m.cartesian.speed[:3]) + ROUNDING).all()
        if self.last is not None and not command.hold:
            assert np.abs(command.rate - self.last.rate).max() <= max(m.cartesian.acceleration) * self.period + ROUNDING
            moved = np.abs(self.from_base(command.target) - self.from_base(self.last.target))
            assert (moved <= np.array(m.cartesian.speed) * self.period + 1e-6).all()
        if self.last is not None and command.hold:  # the same place, but for the last bit of a product of another shape
            np.testing.assert_allclose(command.target, self.last.target, atol=1e-12)

    def check_joint(self, command, joints):
        low = np.array([-np.inf if j.low is None else j.low for j in self.m.joints])
        high = np.array([np.inf if j.high is None else j.high for j in self.m.joints])
        speed, push = (np.array([getattr(j, key) for j in self.m.joints]) for key in ("speed", "acceleration"))
        assert ((command.waypoints >= low) & (command.waypoints <= high)).all()
        assert (np.abs(command.rate) <= speed + ROUNDING).all()
        if self.last is not None:
            steps = np.diff(np.vstack([self.last.target, command.waypoints]), axis=0) / (self.period / len(command.waypoints))
            assert (np.abs(steps) <= speed + 1e-6).all(), "speed between waypoints"
            if command.hold:
                np.testing.assert_array_equal(command.target, self.last.target)
            else:
                assert (np.abs(command.rate - self.last.rate) <= push * self.period + ROUNDING).all()
        place = self.coordinates(command.target)
        reach = np.full(6, OVERSHOOT + 1e-9)
        assert (place >= np.array(self.m.cartesian.low) - reach).all() and (place <= np.array(self.m.cartesian.high) + reach).all()

    def coordinates(self, joints):
        self.data.qpos[self.address] = joints
        mujoco.mj_kinematics(self.model, self.data)
        site = self.model.site("grasp").id
        return np.append(self.data.site_xpos[site], vector_of(self.data.site_xmat[site].reshape(3, 3) @ self.start.T))

    def from_base(self, row):
        position = np.array(self.m.robot.base_position_m) + self.base @ row[:3]
        return np.append(position, vector_of(self.base @ rotation_matrix(row[3:]) @ self.start.T))


def rotation_matrix(quaternion):
    w, x, y, z = quaternion
    return np.array([[1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
                     [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
                     [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)]])


class Puppet:
    """An arm that obeys, more or less, in a world that lies now and then."""

    HARMS = ("nan joint", "inf joint", "nan object", "stale", "future", "jump", "teleport", "fast", "effort", "fault", "lost", "short",
             "late")

    def __init__(self, bundle, rng):
        self.bundle, self.rng, m = bundle, rng, bundle.manifest
        self.kinematics = Kinematics.of(m, bundle.mjcf)
        self.expected, self.base = Expected(m), rotation_matrix(m.robot.base_quaternion)
        self.dofs = [int(self.kinematics.model.joint(joint.name).dofadr[0]) for joint in m.joints]
        self.low = np.array([-np.inf if joint.low is None else joint.low for joint in m.joints])
        self.high = np.array([np.inf if joint.high is None else joint.high for joint in m.joints])

    def begin(self, now):
        self.state = start_state(self.bundle, now)
        self.expected.begin()

    def obey(self, command):
        """Commands come true, but for a tenth and some noise."""
        joints = self.state.joints
        if command.form == "joint":
            joints = joints + 0.9 * (command.target - joints)
        else:
            joints = joints + 0.9 * self.joint_step(command)
        self.state = changed(self.state, joints=np.clip(joints, self.low, self.high) + self.rng.normal(0, 2e-4, len(joints)))

    def joint_step(self, command):
        """(n,) [rad] towards a pose, or as robosuite's controller answers a delta."""
        model, data = self.kinematics.model, self.kinematics.data
        self.kinematics.place(self.state.joints, self.state.fingers)
        if command.form == "osc":
            motion = self.expected.step(command.target)
        else:
            place = self.base @ command.target[:3] + np.array(self.bundle.manifest.robot.base_position_m)
            turn = self.base @ rotation_matrix(command.target[3:]) @ self.kinematics.rotation.T
            motion = np.concatenate([place - self.kinematics.position, vector_of(turn)])
        mujoco.mj_comPos(model, data)
        jacobian = np.zeros((6, model.nv))
        mujoco.mj_jacSite(model, data, jacobian[:3], jacobian[3:], model.site("grasp").id)
        jacobian = jacobian[:, self.dofs]
        return jacobian.T @ np.linalg.solve(jacobian @ jacobian.T + 1e-3 * np.eye(6), motion)

    def read(self, now, harm):
        state, rng, n = changed(self.state, stamp=now - 0.002), self.rng, len(self.state.joints)
        spoilt, which = state.joints.copy(), rng.integers(n)
        spoilt[which] = np.nan if harm == "nan joint" else np.inf if harm == "inf joint" else spoilt[which] + 2.0
        shift = state.object_position + rng.choice([-1, 1], 3) * 0.5
        return {
            "nan joint": lambda: changed(state, joints=spoilt), "inf joint": lambda: changed(state, joints=spoilt),
            "teleport": lambda: changed(state, joints=spoilt), "nan object": lambda: changed(state, object_position=np.full(3, np.nan)),
            "stale": lambda: changed(state, stamp=now - 1), "future": lambda: changed(state, stamp=now + 1),
            "jump": lambda: changed(state, object_position=np.abs(shift) + 0.8),
            "fast": lambda: changed(state, speeds=np.full(n, 50.0)), "effort": lambda: changed(state, efforts=np.full(n, 1e4)),
            "fault": lambda: changed(state, fault="protective stop"), "lost": lambda: changed(state, outcome="lost"),
            "short": lambda: changed(state, joints=state.joints[:-1]),
        }.get(harm, lambda: state)()


def wild_policy(rng):
    """A policy whose temper changes: uniform, bang-bang, steady pushes, huge, and now and then not finite."""
    temper = {"kind": "uniform", "push": np.zeros(7)}

    def act(observation):
        if rng.random() < 0.05:
            temper["kind"] = rng.choice(["uniform", "bang", "steady", "huge"])
            temper["push"] = rng.choice([-1.0, 1.0], 7)
        action = {"uniform": lambda: rng.uniform(-1, 1, 7), "bang": lambda: rng.choice([-1.0, 1.0], 7),
                  "steady": lambda: temper["push"], "huge": lambda: 1e30 * rng.uniform(-1, 1, 7)}[temper["kind"]]()
        if rng.random() < 0.005:
            action = action.copy()
            action[rng.integers(7)] = rng.choice([np.nan, np.inf, -np.inf])
        return action

    return act


@pytest.mark.parametrize("form", ["osc", "pose", "joint"])
def test_no_adversarial_tick_leaves_the_limits_and_every_fault_holds(bundle, form):
    rng = np.random.default_rng(7)
    runtime = Runtime(bundle, info_of(bundle.manifest), form, policy=wild_policy(rng))
    puppet, checker, watch = Puppet(bundle, rng), Checker(bundle, form), bundle.manifest.watch
    now, played, faults, latched, held = 0.0, 0, set(), False, 0
    alive, deck = False, []
    while played < TICKS:
        now += 0.05
        if not alive:
            puppet.begin(now)
            checker.begin()
            assert runtime.begin(puppet.state, now) is None
            alive, latched, held = True, False, 0
        harm = ""
        if rng.random() < 0.03:
            deck = deck or list(rng.permutation(Puppet.HARMS))
            harm = str(rng.choice(Puppet.HARMS)) if latched else str(deck.pop())  # every harm comes to an arm that still moves
        state = puppet.read(now, harm)
        tick = runtime.tick(state, now, late=harm == "late")
        checker.check(tick.command, puppet.state.joints)
        if harm not in ("", "late"):
            assert tick.fault is not None, f"{harm} went unnoticed"
        if not np.isfinite(tick.action).all() and tick.fault is None:
            pytest.fail("a command without an action")
        assert tick.command.hold == (tick.fault is not None)
        if tick.fault is not None:
            faults.add(tick.fault.kind)
            latched, held = latched or tick.fault.kind not in PASSING, held + 1
        else:
            assert not latched, "the arm went on after a fault that does not pass"
            held = 0
        assert tick.stop == (held > watch.hold_ticks)
        alive = not tick.stop
        puppet.obey(tick.command)
        played += 1
    wanted = {"not_finite", "stale_state", "observation_jump", "joint_speed", "effort", "arm", "object_lost", "state_shape"}
    assert wanted <= faults, f"never seen: {wanted - faults}"


# -- one fault at a time -----------------------------------------------------------------------------------------------


def started(bundle, form="osc", policy=None, **changes):
    runtime = Runtime(bundle, info_of(bundle.manifest), form, policy or (lambda observation: np.zeros(7)))
    assert runtime.begin(start_state(bundle), 0.0) is None
    return runtime


@pytest.mark.parametrize("form", ["osc", "pose", "joint"])
@pytest.mark.parametrize("change, kind, culprit", [
    ({"joints": np.full(7, np.nan)}, "not_finite", "Actuator1"),
    ({"object_quaternion": np.array([1, 0, 0, np.inf])}, "not_finite", "object_quaternion"),
    ({"stamp": -1.0}, "stale_state", "1050 ms old"),
    ({"stamp": 5.0}, "stale_state", "ms old"),
    ({"speeds": np.array([0, 9.0, 0, 0, 0, 0, 0])}, "joint_speed", "Actuator2: 9"),
    ({"efforts": np.array([0, 0, 0, 0, 0, 0, 13.5])}, "effort", "Actuator7: 13.5, limit 13"),
    ({"efforts": np.full(7, np.nan)}, "effort", "Actuator1"),
    ({"fault": "protective stop"}, "arm", "protective stop"),
    ({"goal": np.array([5.0, 0, 1])}, "observation_jump", "goal_from_object"),
    ({"object_position": np.array([-0.1, 0, 0.7])}, "object_lost", "0.700 m"),
    ({"joints": np.zeros(6)}, "state_shape", r"\(6,\), not \(7,\)"),
])
def test_a_fault_holds_in_its_own_tick_and_is_named(bundle, form, change, kind, culprit):
    runtime = started(bundle, form)
    good = start_state(bundle, 0.05)
    first = runtime.tick(good, 0.05)
    assert first.fault is None and not first.command.hold
    tick = runtime.tick(changed(good, **change), 0.05)
    assert tick.fault is not None and tick.fault.kind == kind and tick.command.hold
    assert re.search(culprit, tick.fault.detail), tick.fault.detail


def test_slow_joints_and_toppling_objects_are_no_faults():
    """The Jaco's third joint has a limit of 0.2 rad/s, which poses on a stiff arm pass; an object may topple as fast as one falls."""
    jaco = load_bundle("jaco")
    good = start_state(jaco)

    def seen(**changes):
        runtime = started(jaco)
        assert runtime.tick(changed(good, stamp=0.0), 0.0).fault is None
        fault = runtime.tick(changed(good, stamp=0.05, **changes), 0.05).fault
        return fault.kind if fault else ""

    assert jaco.manifest.joints[2].speed < 0.21
    assert seen(speeds=np.array([0, 0, 0.35, 0, 0, 0, 0])) == "" and seen(speeds=np.array([0, 0, 0.45, 0, 0, 0, 0])) == "joint_speed"
    tipped = lambda angle: np.array([np.cos(angle / 2), np.sin(angle / 2), 0, 0])  # noqa: E731
    assert seen(object_quaternion=tipped(0.8)) == "" and seen(object_quaternion=tipped(1.2)) in ("implausible", "observation_jump")


def test_a_policy_that_is_not_finite_never_reaches_the_arm(bundle):
    runtime = started(bundle, policy=lambda observation: np.array([0, 0, np.nan, 0, 0, 0, 1]))
    tick = runtime.tick(start_state(bundle, 0.05), 0.05)
    assert tick.fault.kind == "not_finite" and "grasp_translation_z" in tick.fault.detail and not tick.command.target.any()


def test_a_late_state_passes_and_a_jump_does_not(bundle):
    runtime = started(bundle)
    good = start_state(bundle)
    assert runtime.tick(changed(good, stamp=0.05), 0.05).fault is None
    assert runtime.tick(changed(good, stamp=0.05), 0.30).fault.kind == "stale_state"
    back = runtime.tick(changed(good, stamp=0.35), 0.35)
    assert back.fault is None and not back.command.hold
    assert runtime.tick(changed(good, stamp=0.40, object_position=good.object_position + 0.3), 0.40).fault.kind == "observation_jump"
    for tick in range(1, bundle.manifest.watch.hold_ticks + 1):
        after = runtime.tick(changed(good, stamp=0.40 + 0.05 * tick), 0.40 + 0.05 * tick)
        assert after.command.hold and after.stop == (tick == bundle.manifest.watch.hold_ticks)


def test_a_state_that_stays_away_stops_the_arm(bundle):
    runtime = started(bundle)
    stale = start_state(bundle)
    ticks = [runtime.tick(stale, 0.2 + 0.05 * i) for i in range(bundle.manifest.watch.hold_ticks + 1)]
    assert all(tick.command.hold for tick in ticks) and ticks[-1].stop and not ticks[-2].stop


def test_ticks_that_run_late_hold_the_arm(bundle):
    runtime, good = started(bundle), start_state(bundle)
    late = bundle.manifest.watch.late_ticks
    ticks = [runtime.tick(changed(good, stamp=0.05 * i), 0.05 * i, late=True) for i in range(late)]
    assert [tick.command.hold for tick in ticks] == [False] * (late - 1) + [True]
    assert ticks[-1].fault.kind == "late_ticks"


@pytest.mark.parametrize("form", ["osc", "pose", "joint"])
def test_an_arm_away_from_its_start_is_not_moved(bundle, form):
    runtime = Runtime(bundle, info_of(bundle.manifest), form)
    state = start_state(bundle)
    state.joints[3] += 0.06
    fault = runtime.begin(state, 0.0)
    assert fault.kind == "start_pose" and "Actuator4" in fault.detail and not fault.passing
    whole_turn = start_state(bundle)
    whole_turn.joints[0] += 2 * np.pi
    assert runtime.begin(whole_turn, 0.0) is None, "Actuator1 turns without end"


def test_an_object_that_slips_out_of_the_lifted_gripper_stops_the_arm(bundle):
    """Replay the recorded episode; halfway up the object stays behind, slowly enough to be no jump."""
    g, m = bundle.golden, bundle.manifest
    runtime = Runtime(bundle, info_of(m), "osc")
    behind, found = 0.0, None
    for row in range(m.golden.steps):
        height = g["episode_object_position"][row, 2] - g["episode_object_position"][0, 2]
        behind += 0.01 if height > 0.05 else 0.0
        position = g["episode_object_position"][row] - (0, 0, behind)
        state = State(0.05 * row, g["episode_joints"][row], position, g["episode_object_quaternion"][row], g["episode_goal"],
                      g["episode_fingers"][row])
        if row == 0:
            assert runtime.begin(state, 0.0) is None
        found = runtime.tick(state, 0.05 * row).fault
        if found:
            break
    assert found is not None and found.kind == "object_lost", found
    assert behind <= m.watch.held_m + 0.02


@pytest.mark.parametrize("form", ["osc", "pose"])
def test_the_recorded_episode_passes_the_filter_untouched(bundle, form):
    """What the label was measured with is not slowed down by the limits: no hold, and under osc the very same actions."""
    g, m = bundle.golden, bundle.manifest
    runtime = Runtime(bundle, info_of(m), form)
    for row in range(m.golden.steps):
        state = State(0.05 * row, g["episode_joints"][row], g["episode_object_position"][row], g["episode_object_quaternion"][row],
                      g["episode_goal"], g["episode_fingers"][row])
        if row == 0:
            assert runtime.begin(state, 0.0) is None
        tick = runtime.tick(state, 0.05 * row)
        assert tick.fault is None and not tick.warning, (row, tick.fault, tick.warning)
        if form == "osc":
            np.testing.assert_allclose(tick.command.target, g["episode_actions"][row, :6], atol=1e-5)
        # What the closing command meant in the recording, a tick later.
        if row + 1 < m.golden.steps:
            assert runtime.motion.grip.command == pytest.approx(g["episode_command"][row + 1])


# -- a commanded metre is a metre --------------------------------------------------------------------------------------


def test_the_response_foretells_the_recorded_motion(bundle):
    """Summed impulse responses of the recorded actions, without any feedback, against where the recorded arm went over two
    seconds: within 5 cm, where deltas taken for displacements are off by more than eight times that."""
    g, m = bundle.golden, bundle.manifest
    kinematics = Kinematics.of(m, bundle.mjcf)
    expected, place, naive = Expected(m), None, None
    worst, worst_naive = np.zeros(6), 0.0
    for joints, fingers, action in zip(g["episode_joints"], g["episode_fingers"], g["episode_actions"], strict=True):
        kinematics.place(joints, fingers)
        here = kinematics.coordinates()
        place, naive = (here, here) if place is None else (place, naive)
        worst, worst_naive = np.maximum(worst, np.abs(place - here)), max(worst_naive, np.abs(naive - here)[:3].max())
        place = place + expected.step(action[:6])
        naive = naive + action[:6] * expected.scale
    assert worst[:3].max() < 0.05, f"{worst[:3]} m"
    assert worst_naive > 8 * worst[:3].max(), f"naive {worst_naive} m, foretold {worst[:3].max()} m"


@pytest.mark.parametrize("form", ["pose", "joint"])
def test_a_steady_action_commands_the_metres_that_the_arm_would_make(bundle, form):
    """0.3 upwards for 20 ticks: steady response times delta times ticks, less what starting up takes."""
    m = bundle.manifest
    runtime = Runtime(bundle, info_of(m), form, lambda observation: np.array([0, 0, 0.2, 0, 0, 0, -1.0]))
    state, puppet = start_state(bundle), Puppet(bundle, np.random.default_rng(0))
    assert runtime.begin(state, 0.0) is None
    kinematics = Kinematics.of(m, bundle.mjcf)
    kinematics.place(state.joints, state.fingers)
    low = kinematics.position[2]
    for i in range(20):
        tick = runtime.tick(changed(state, stamp=0.05 * i), 0.05 * i)
        assert tick.fault is None, tick.fault
        if form == "joint":
            state = changed(state, joints=tick.command.target)
        else:
            runtime.motion.lead = np.full(6, 1.0)
            puppet.state = state
            puppet.obey(tick.command)
            state = puppet.state
    if form == "joint":
        kinematics.place(tick.command.target, state.fingers)
        height = kinematics.position[2]
    else:
        height = tick.command.target[2] + m.robot.base_position_m[2]
    wanted = 20 * 0.2 * m.controller.translation_m * m.controller.response.steady[2]
    assert height - low == pytest.approx(wanted, rel=0.12), f"{height - low:.4f} m commanded, {wanted:.4f} m expected"


def test_a_push_towards_the_table_ends_above_it(bundle):
    """Down, and only down, with an arm that obeys: the gripper comes to rest at its clearance, and that is no fault."""
    limits = dataclasses.replace(bundle.manifest.cartesian, table_clearance_m=0.06)
    raised = dataclasses.replace(bundle, manifest=dataclasses.replace(bundle.manifest, cartesian=limits))
    runtime = Runtime(raised, info_of(raised.manifest), "joint", lambda observation: np.array([0, 0, -0.6, 0, 0, 0, -1.0]))
    state, heights = start_state(raised), []
    assert runtime.begin(state, 0.0) is None
    for i in range(80):
        tick = runtime.tick(changed(state, stamp=0.05 * i), 0.05 * i)
        assert tick.fault is None, tick.fault
        state = changed(state, joints=tick.command.target)
        runtime.observer(state, 0.0)
        heights.append(runtime.observer.kinematics.lowest() - limits.table_top_m)
    assert heights[0] > 0.08 and min(heights) > 0.06 - 1e-3 and heights[-1] < 0.065, f"{heights[0]:.3f} to {heights[-1]:.4f} m"


def test_rotation_vectors_and_matrices_agree():
    rng = np.random.default_rng(0)
    for vector in rng.uniform(-1.5, 1.5, (50, 3)):
        np.testing.assert_allclose(vector_of(rotation_of(vector)), vector, atol=1e-12)

"""No unsafe command: whatever policy and observations do, commands stay within the manifest, and a fault holds the arm.

Hostile ticks by the thousand: tests/benchmarks/test_hostile.py.
"""

import dataclasses
import re

import numpy as np
import pytest

from toolkit.benchmarks.hostile import SimulatedArm
from toolkit.bundle.manifest import Braking, BrakingDistance
from toolkit.bundle.reading import load_bundle
from toolkit.deploy.arm import ArmInfo, State
from toolkit.deploy.kinematics import Kinematics
from toolkit.deploy.runtime import Runtime
from toolkit.deploy.safety import CAMERA, OVERSHOOT


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


@pytest.mark.parametrize("change", [{"object_position": 0.5}, {"goal": 0.5}])
def test_a_jump_between_the_start_and_the_first_tick_is_one(bundle, change):
    runtime = started(bundle)
    state = start_state(bundle, 0.05)
    moved = {key: getattr(state, key) + np.array([shift, 0.0, 0.0]) for key, shift in change.items()}
    tick = runtime.tick(changed(state, **moved), 0.05)
    assert tick.fault is not None and tick.fault.kind == "observation_jump" and tick.command.hold


@pytest.mark.parametrize("consecutive", [True, False])
def test_steps_at_the_goal_count_as_the_bundle_says(bundle, consecutive):
    """The goal now nearer to the object than the tolerance, now farther; counted here by runs of ones."""
    simulation = bundle.manifest.simulation
    says = dataclasses.replace(simulation, holding=dataclasses.replace(simulation.holding, consecutive=consecutive))
    task, rng, outcomes = bundle.manifest.task, np.random.default_rng(0), []
    offset = (0.0, 0.0, task.goal_tolerance_m)
    manifest = dataclasses.replace(bundle.manifest, simulation=says, task=dataclasses.replace(task, goal_offset_m=offset))
    for _ in range(4):
        runtime = Runtime(dataclasses.replace(bundle, manifest=manifest), info_of(manifest), "osc", lambda observation: np.zeros(7))
        state = start_state(bundle)
        assert runtime.begin(changed(state, goal=state.object_position + offset), 0.0) is None
        near = rng.uniform(size=4 * task.hold_steps) < 0.9
        for number, at_goal in enumerate(near):
            state = start_state(bundle, 0.05 * number)
            distance = task.goal_tolerance_m + (-0.005 if at_goal else 0.005)
            tick = runtime.tick(changed(state, goal=state.object_position + [0.0, 0.0, distance]), state.stamp)
            assert tick.fault is None, tick.fault
            told = "".join("1" if one else "0" for one in near[: number + 1])
            counted = len(told) - len(told.rstrip("1")) if consecutive else told.count("1")
            assert runtime.succeeded == (counted >= task.hold_steps)
            outcomes.append(runtime.succeeded)
    assert any(outcomes) and not all(outcomes), "both must occur"


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
        assert after.command.hold and (after.stop is not None) == (tick == bundle.manifest.watch.hold_ticks)


@pytest.mark.parametrize("gap, ticks, holds", [
    (0.05, 1.5, True), (0.10, 1.5, False), (0.30, 1.5, False), (0.30, 4.5, True), (0.50, 6, True),
])
def test_what_may_move_in_a_tick_may_move_farther_in_a_longer_time(bundle, gap, ticks, holds):
    """As the fingers do that close while one state is old, or while the policy sleeps; but an arm left alone stands still after 0.2 s, and
    an object that is half a metre away after half a second has jumped."""
    entry = next(entry for entry in bundle.manifest.observation if entry.name == "object_from_grasp")
    moved = ticks * max(CAMERA["object_from_grasp"], *entry.jump)
    runtime, good = started(bundle), start_state(bundle)
    assert runtime.tick(changed(good, stamp=0.05), 0.05).fault is None
    tick = runtime.tick(changed(good, stamp=0.05 + gap, object_position=good.object_position + [0, 0, moved]), 0.05 + gap)
    assert tick.command.hold == holds and (not holds or tick.fault.kind == "observation_jump")


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


@pytest.mark.parametrize("form", ["osc", "joint"])
def test_an_arm_is_held_where_it_could_no_longer_stop_in_its_box(bundle, form):
    """The recorded episode in a box that ends where it lifts fastest: held there it would come to rest beyond, and so it is held, before
    it has left. By hand: the height a tick later, and the braking distance, measured at twice and at half that speed; within 2 cm."""
    g, m = bundle.golden, bundle.manifest
    kinematics, heights = Kinematics.of(m, bundle.mjcf), []
    for joints, fingers in zip(g["episode_joints"], g["episode_fingers"], strict=True):
        kinematics.place(joints, fingers)
        heights.append(kinematics.position)
    path = np.array(heights)
    rising = np.linalg.norm(np.diff(path, axis=0), axis=1) * m.policy_hz * (np.diff(path[:, 2]) > 0.004)
    row = int(rising.argmax()) + 1
    speed, top = rising[row - 1], float(path[row, 2]) + 0.001
    distances = tuple(BrakingDistance(form, share * speed, 0.08 * share, 0.4) for share in (0.5, 2.0))

    def first_fault(braking, period=0.05):
        version, borne = (6, 0) if braking else (4, None)
        low, high = np.array(m.cartesian.low) - 1.0, np.array(m.cartesian.high) + 1.0
        high[2] = top - OVERSHOOT + 0.06
        box = dataclasses.replace(m.cartesian, low=tuple(low), high=tuple(high))
        tight, played = dataclasses.replace(m, cartesian=box, braking=braking, format_version=version, holds=(),
                                            borne_delay_steps=borne), [0]
        runtime = Runtime(dataclasses.replace(bundle, manifest=tight), info_of(m), form,
                          lambda observation: g["episode_actions"][played[0]].copy())
        for i in range(row + 1):
            played[0] = i
            state = State(period * i, g["episode_joints"][i], g["episode_object_position"][i], g["episode_object_quaternion"][i],
                          g["episode_goal"], g["episode_fingers"][i])
            if i == 0:
                assert runtime.begin(state, 0.0) is None
            runtime.motion.tracking = lambda joints: 0.0  # a recorded arm does not follow commands
            fault = runtime.tick(state, period * i).fault
            if fault:
                return i, fault
        return None, None

    assert first_fault(None)[1] is None
    when, fault = first_fault(Braking(distances, -1.0))
    assert when is not None and fault.kind == "workspace" and "held now" in fault.detail, fault
    late = first_fault(Braking(distances, -1.0), period=0.2)[0]
    assert late is None or late > when, "in four times the time it is four times slower, however late the ticks"
    velocity = (path[when] - path[when - 1]) * m.policy_hz
    fast = float(np.linalg.norm(velocity))
    goes = np.interp(fast, [0, 0.5 * speed, 2 * speed], [0, 0.04, 0.16])
    assert path[when, 2] < top + 0.06 < (path[when] + velocity / m.policy_hz + goes * velocity / fast)[2] + 0.02


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


@pytest.mark.parametrize("form", ["pose", "joint"])
def test_a_steady_action_commands_the_metres_that_the_arm_would_make(bundle, form):
    """0.3 upwards for 20 ticks: steady response times delta times ticks, less what starting up takes."""
    m = bundle.manifest
    runtime = Runtime(bundle, info_of(m), form, lambda observation: np.array([0, 0, 0.2, 0, 0, 0, -1.0]))
    state, arm = start_state(bundle), SimulatedArm(bundle, np.random.default_rng(0))
    arm.begin(0.0)
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
            arm.state = state
            arm.obey(tick.command)
            state = arm.state
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

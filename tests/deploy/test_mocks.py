"""Vendors' drivers on mocks of their packages: what passes through the driver's units, clocks and threads, fault by fault."""

import json
import sys
import threading
import time

import numpy as np
import pytest

from toolkit.bundle.reading import load_bundle
from toolkit.cli import main
from toolkit.deploy.arm import Command
from toolkit.deploy.drivers.stamps import DeviceClock
from toolkit.deploy.faults import COMPLAINT, VENDOR_FAULTS, faults_for, trials
from toolkit.deploy.kinematics import Kinematics
from toolkit.deploy.mocks import VENDORS, SimulatedClock, mocked
from toolkit.errors import ToolkitError
from toolkit.runs.seeds import EVALUATION_SEEDS

PLAYED = ("nothing", "nothing new comes, nor a stamp", "frozen but for encoder noise", "joints in degrees", "a joint missing",
          "gripper not numbers", "the arm does not obey", COMPLAINT)
"""Beside the layers stamp and vendor; `bench faults --driver NAME` plays all."""


def unmet(found):
    return [trial for trial in found if not trial.met]


@pytest.mark.parametrize("name", VENDORS)
def test_every_fault_is_met_through_the_vendors_driver(bundle, name):
    with mocked(bundle, name) as driver:
        faults = [fault for fault in faults_for(driver.vendor) if fault.name in PLAYED or fault.layer in ("stamp", "vendor")]
        found = list(trials(bundle, driver, driver.connect(), "joint", tuple(faults)))
    assert len(found) == len(faults) >= 9 and not unmet(found), unmet(found)
    assert (found[0].fault, found[0].outcome, found[0].seen) == ("nothing", "success", ""), found[0]
    assert all(trial.seen for trial in found if trial.must in ("stop", "pass") and trial.layer != "vendor")


@pytest.mark.parametrize("name", ["ur", "franka"])
def test_poses_arrive_in_the_vendors_own_frame_and_order(bundle, name):
    """A whole episode as poses: a base turned the wrong way, or a quaternion's scalar at the wrong end, would never end in success."""
    with mocked(bundle, name) as driver:
        info = driver.connect()
        found = list(trials(bundle, driver, info, "pose", tuple(fault for fault in faults_for(driver.vendor) if fault.name == "nothing")))
    assert [trial.outcome for trial in found] == ["success"]


@pytest.mark.parametrize("name, fault", [("ur", "policy asleep for 0.5 s"), ("kortex", "policy asleep for 0.5 s"),
                                        ("franka", "one state 0.3 s old"), ("ros2", "one state 0.3 s old")])
def test_a_busy_machine_changes_no_trial(bundle, name, fault, monkeypatch):
    """Cameras that take 30 ms of this machine's time to read: by its clock the ticks would be late, and the threads out of step."""
    found = []
    for spent in (0.0, 0.03):
        with mocked(bundle, name) as driver:
            seen = driver.arm.seen
            monkeypatch.setattr(driver.arm, "seen", lambda seen=seen, spent=spent: (time.sleep(spent), seen())[1])
            chosen = tuple(each for each in faults_for(driver.vendor) if each.name == fault)
            found += trials(bundle, driver, driver.connect(), "joint", chosen)
    assert found[0] == found[1] and found[0].met and found[0].seen in ("late_ticks", "stale_state"), found


def test_a_simulated_clock_wakes_sleepers_in_order_and_waits_for_who_is_awake():
    clock, woke = SimulatedClock(), []

    def sleeper(name, seconds, times):
        for _ in range(times):
            clock.sleep(seconds)
            time.sleep(0.005)
            woke.append((name, round(clock.now(), 6)))

    threads = [threading.Thread(target=sleeper, args=args, daemon=True) for args in (("slow", 0.3, 2), ("quick", 0.2, 2))]
    for count, thread in enumerate(threads, 1):
        thread.start()
        clock.meet(count)
    assert not woke and clock.now() == 0.0, "whoever made it is awake"
    clock.sleep(0.45)
    assert woke == [("quick", 0.2), ("slow", 0.3), ("quick", 0.4)] and clock.now() == 0.45
    clock.sleep(1.0)
    assert woke[3:] == [("slow", 0.6)] and clock.now() == 1.45, "who has ended keeps nobody waiting"
    late = threading.Thread(target=sleeper, args=("late", 9.0, 1), daemon=True)
    late.start()
    clock.meet(1)
    with clock.released():
        late.join()
    assert woke[4:] == [("late", 1.45)], "nobody sleeps while others wait for the end of threads, and no time passes"


def test_a_driver_that_stamps_when_it_is_asked_is_caught(bundle, monkeypatch):
    monkeypatch.setattr(DeviceClock, "__call__", lambda self, seconds: self._now())
    with mocked(bundle, "ur") as driver:
        faults = tuple(fault for fault in faults_for(driver.vendor) if fault.name == "stamp a second old")
        found = list(trials(bundle, driver, driver.connect(), "joint", faults))
    assert unmet(found) == found and not found[0].seen


@pytest.mark.parametrize("name", VENDORS)
def test_a_lie_comes_out_of_the_driver_as_it_went_into_the_vendors_interface(bundle, name):
    with mocked(bundle, name) as driver:
        driver.begin(EVALUATION_SEEDS)
        truth = driver.arm.state()
        read = driver.report(truth)
        turns = (read.joints - truth.joints) / (2 * np.pi)
        np.testing.assert_allclose(turns, turns.round(), atol=1e-9)  # Kortex counts from 0 to 360 degrees
        np.testing.assert_allclose([read.opening, *read.object_position, *read.goal],
                                   [truth.opening, *truth.object_position, *truth.goal], atol=1e-9)
        assert abs(read.stamp - truth.stamp) < 0.05, "the device's clock is set to ours"


def test_the_object_lies_where_the_seed_puts_it_in_robosuite(bundle, task):
    with mocked(bundle, "kortex") as driver:
        for seed in (EVALUATION_SEEDS, EVALUATION_SEEDS + 7):
            driver.arm.begin(seed)
            pose, goal = task.sample_start(np.random.default_rng(seed))
            state = driver.arm.state()
            np.testing.assert_allclose(state.object_position, pose[:3], atol=1e-9)
            np.testing.assert_allclose(np.abs(state.object_quaternion @ pose[3:]), 1.0, atol=1e-9)
            np.testing.assert_allclose(state.goal, goal, atol=1e-9)


def test_the_arm_carries_what_it_has_closed_on_and_nothing_else(bundle):
    with mocked(bundle, "ros2") as driver:
        arm, manifest = driver.arm, bundle.manifest
        arm.begin(EVALUATION_SEEDS)
        before = arm.state().object_position
        arm.grip(0.0)
        arm.aim(np.array(manifest.start.arm_rad) + 0.2)
        driver.sleep(0.3)
        assert np.array_equal(arm.state().object_position, before), "closed away from it"
        arm.begin(EVALUATION_SEEDS)
        start = Kinematics.of(manifest, bundle.mjcf)
        start.place(np.array(manifest.start.arm_rad), bundle.golden["episode_fingers"][0])
        arm.reach(arm.state().object_position, start.rotation)
        driver.sleep(1.5)
        arm.grip(0.0)
        driver.sleep(0.8)
        assert arm.state().opening > 0.1, "the object is between the jaws"
        arm.reach(before + [0, 0, 0.1], start.rotation)
        driver.sleep(1.0)
        assert arm.state().object_position[2] - before[2] == pytest.approx(0.1, abs=0.02)
        arm.grip(1.0)
        driver.sleep(0.7)
        assert arm.state().object_position[2] == pytest.approx(before[2])


def test_what_was_imported_before_is_there_again(bundle, monkeypatch):
    mine = object()
    monkeypatch.setitem(sys.modules, "franky", mine)
    monkeypatch.delitem(sys.modules, "rtde_control", raising=False)
    for name in ("franka", "ur"):
        with mocked(bundle, name):
            assert sys.modules["franky" if name == "franka" else "rtde_control"] is not mine
    assert sys.modules["franky"] is mine and "rtde_control" not in sys.modules


def test_an_arm_whose_angles_a_vendor_cannot_tell_is_refused():
    """A Jaco's joints go beyond half a turn: the second starts at 3.9 rad, which Kortex would tell as -2.4."""
    with pytest.raises(ToolkitError, match="kortex tells angles from -pi to pi, and joint j2s7s300_joint_1 of jaco goes from -6.28 to"):
        with mocked(load_bundle("jaco"), "kortex"):
            pass


def test_a_clockless_vendor_has_no_wrong_clock():
    layers = {name: {fault.layer for fault in faults_for(vendor)} for name, vendor in VENDORS.items()}
    assert "stamp" not in layers["kortex"] and all("stamp" in layers[name] for name in ("ur", "franka", "ros2"))
    assert COMPLAINT not in {fault.name for fault in faults_for(VENDORS["ros2"])} and set(VENDOR_FAULTS) <= set(faults_for(VENDORS["ur"]))


def test_the_command_plays_a_vendors_faults(capsys):
    main(["bench", "faults", "kinova3", "--driver", "kortex", "--only", "vendor", "--json"])
    found = json.loads(capsys.readouterr().out)
    assert found["unmet"] == 0 and found["driver"] == "kortex" and {row["form"] for row in found["trials"]} == {"joint"}
    with pytest.raises(SystemExit) as stop:
        main(["bench", "faults", "--driver", "kortex", "--form", "pose"])
    assert stop.value.code == 2 and "takes no 'pose' commands" in capsys.readouterr().err


def test_kortex_goes_on_at_its_last_speed_until_its_driver_stops_it(bundle):
    """What the mock is for: an arm whose runtime has gone is stopped by the driver's thread, not by itself."""
    with mocked(bundle, "kortex") as driver:
        driver.begin(EVALUATION_SEEDS)
        joints = driver.read().joints
        rows = np.linspace(joints, joints + 0.01, 3)[1:]
        driver.send(Command("joint", False, rows[-1], np.full(len(joints), 0.2), 1.0, 1.0, 0.08, rows))
        driver.sleep(0.1)
        moving = driver.arm.state().speeds
        driver.sleep(0.4)
        assert np.abs(moving).max() > 0.01 and not driver.arm.state().speeds.any()

"""The runtime against the twin: through a socket, and in an interpreter without torch or robosuite."""

import json
import re
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from robots import ROBOTS
from toolkit.bundle.reading import load_bundle
from toolkit.deploy import wire
from toolkit.deploy.arm import Command, State
from toolkit.deploy.drivers.sim import SimDriver
from toolkit.deploy.runtime import Runtime, TickLog, play
from toolkit.errors import ToolkitError
from toolkit.export.twin import WATCHDOG, Twin, saturated

ROOT = Path(__file__).parents[2]
BLOCKED = ("torch", "robosuite", "rerun", "pinocchio", "numba", "onnx", "safetensors", "gymnasium_robotics", "matplotlib")


@pytest.fixture(scope="module")
def bundle():
    return load_bundle("kinova3")


@pytest.fixture(scope="module")
def served():
    """Ports by name: twins in processes of their own, in lockstep."""
    processes, ports = [], {}

    def start(name="kinova3"):
        if name not in ports:
            command = [sys.executable, "-m", "toolkit.cli", "twin", name, "--pace", "lockstep"]
            processes.append(subprocess.Popen(command, stdout=subprocess.PIPE, text=True, cwd=ROOT))
            line = processes[-1].stdout.readline()
            assert line.startswith(f"twin of {name} at 127.0.0.1:"), line
            ports[name] = int(line.rsplit(":", 1)[1])
        return ports[name]

    yield start
    for process in processes:
        process.terminate()
        process.wait()


@pytest.fixture(scope="module")
def twin(task):
    return Twin(ROBOTS["kinova3"], task, "lockstep")


def test_deploy_runs_where_there_is_neither_torch_nor_robosuite(served, tmp_path):
    """The whole command, with every heavy package blocked on the policy's side, moves the twin to success."""
    log = tmp_path / "log.jsonl"
    program = (
        "import sys\n"
        "class Blocked:\n"
        "    def find_spec(self, name, path=None, target=None):\n"
        f"        if name.split('.')[0] in {BLOCKED!r}: raise ImportError(name + ' is blocked')\n"
        "sys.meta_path.insert(0, Blocked())\n"
        "from toolkit.cli import main\n"
        f"main(['deploy', 'kinova3', '--connect', '127.0.0.1:{served()}', '--episodes', '1', '--pace', 'lockstep', '--json', "
        f"'--log', {str(log)!r}])"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, cwd=ROOT)
    assert done.returncode == 0, done.stderr
    content = json.loads(done.stdout)
    assert (content["target"], content["driver"], content["form"], content["pace"]) == ("kinova3", "sim", "osc", "lockstep")
    assert content["successes"] == content["episodes"] == 1 and content["agrees"] and not content["stopped"] and not content["faults"]
    first, *rows = [json.loads(line) for line in log.read_text().splitlines()]
    assert first["format"] == "meta-evolve deployment log" and first["robot"] == "kinova3"
    assert len(rows) == content["ticks"] and rows[-1]["episode"] == 0
    assert all({"observe_ms", "policy_ms", "command_ms", "age_ms", "action", "target"} <= set(row) for row in rows)


@pytest.mark.parametrize("name, form", [("kinova3", "pose"), ("kinova3", "joint"), pytest.param("iiwa", "pose", marks=pytest.mark.slow)])
def test_poses_and_joint_angles_do_the_task_on_a_position_controlled_arm(served, name, form):
    """The iiwa in poses too: its first joint was once given more of the motion than its speed limit allows."""
    driver = SimDriver("127.0.0.1", served(name))
    runtime = Runtime(load_bundle(name), driver.connect(), form)
    driver.begin(10**9)
    outcome = play(runtime, driver, TickLog(None, {}), "lockstep")
    assert outcome.success and driver.result()[0] and not outcome.faults, outcome
    driver.leave()


def test_a_twin_that_woke_late_tells_what_is_and_obeys_from_when_it_is_told(twin, task, monkeypatch):
    """By the clock, and not run for a while, it is where one that waits for its commands is after the same time; both by two commands."""
    now = [100.0]
    monkeypatch.setattr("toolkit.export.twin.time", SimpleNamespace(monotonic=lambda: now[0]))
    late, orders = Twin(ROBOTS["kinova3"], task, "real"), [osc([0, 0, 1.0, 0, 0, 0]), osc([0, 1.0, 0, 0, 0, 0])]
    for one in (late, twin):
        one.begin(10**9)
        one.send(orders[0])
    now[0] += 0.1501
    twin.wait(0.1)
    assert late.read()["joints"] == twin.read()["joints"] and late.time == pytest.approx(0.15), "nothing was played in between"
    now[0] += 0.05
    late.send(orders[1])
    twin.wait(0.05)
    twin.send(orders[1])
    now[0] += 0.05
    assert late.read()["joints"] == twin.read()["joints"]
    with pytest.raises(ToolkitError, match="follows the clock"):
        late.wait(0.1)
    with pytest.raises(ToolkitError, match="waits from 0 to 10 s"):
        twin.wait(-1.0)


def test_a_drivers_clock_is_its_twins(served):
    """A twin in lockstep has a time of its own, by which it stamps: a period per command, and what its runtime sleeps."""
    driver = SimDriver("127.0.0.1", served())
    driver.connect()
    driver.begin(10**9)
    driver.sleep(0.3)
    before = driver.read()
    assert driver.now() == before.stamp == pytest.approx(0.3) and not before.speeds.any(), "an arm without a command waits"
    for _ in range(2):
        driver.send(osc([0, 0, 1.0, 0, 0, 0]))
    moving = driver.read()
    assert driver.now() == moving.stamp == pytest.approx(0.4) and np.abs(moving.speeds).max() > 0.1
    driver.sleep(0.5)
    assert np.abs(driver.read().speeds).max() < 0.05 and driver.now() == pytest.approx(0.9), "held by its own watchdog"
    driver.leave()


def test_a_stopped_twin_takes_no_commands(bundle, served):
    driver = SimDriver("127.0.0.1", served())
    driver.connect()
    driver.begin(10**9)
    driver.stop("a test")
    assert "a test" in driver.read().fault
    with pytest.raises(ToolkitError, match="has been stopped"):
        driver.send(Command("osc", False, np.zeros(6), np.zeros(0), 0.0, 1.0, 0.08))
    driver.begin(10**9)
    assert driver.read().fault == ""
    short = wire.command_to_json(Command("joint", False, np.zeros(2), np.zeros(2), 0.0, 1.0, 0.08, np.zeros((5, 2))))
    for odd in ({"do": "dance"}, {"do": "send", "command": {"form": "osc"}}, {"do": "send", "command": short}):
        with pytest.raises(ToolkitError, match="the twin refuses"):
            driver._ask(odd)
    driver.leave()


def test_nobody_at_the_other_end():
    with pytest.raises(ToolkitError, match="no twin answers at 127.0.0.1:9 .*meta-evolve twin"):
        SimDriver("127.0.0.1", 9, patience=0.0).connect()


# -- the twin is robosuite's robot -------------------------------------------------------------------------------------


def osc(delta, grip=0.0, hold=False):
    return Command("osc", hold, np.asarray(delta, float), np.zeros(0), grip, 1.0, 0.08)


def test_a_push_that_is_too_much_for_a_motor_keeps_its_direction():
    rng = np.random.default_rng(3)
    for _ in range(200):
        limit = rng.uniform(1, 30, 7)
        carry, push = rng.uniform(-0.9, 0.9, 7) * limit, rng.normal(0, 30, 7)
        torque = saturated(carry, push, limit)
        share = (torque - carry) / push
        assert (np.abs(torque) <= limit + 1e-9).all() and np.ptp(share) < 1e-9 and 0.0 <= share[0] <= 1.0 + 1e-9
        assert share[0] > 1.0 - 1e-9 or (np.abs(torque) > limit - 1e-9).any(), "no motor is at its limit, and yet it pushes less"
    over = saturated(np.array([5.0, 0.0]), np.array([1.0, 1.0]), np.array([4.0, 4.0]))
    np.testing.assert_allclose(over, [4.0, 0.0])


def test_the_twin_moves_as_robosuites_own_step_does(twin, native):
    robot, rng = native("kinova3"), np.random.default_rng(0)
    robot.begin(5)
    twin.begin(5)
    for _ in range(12):
        action = rng.uniform(-1, 1, 7)
        robot.apply(action)
        twin.send(osc(action[:6], np.sign(action[6])))
    np.testing.assert_allclose(twin.data.qpos, robot.data.qpos, atol=1e-12)


def test_what_the_twin_reports_gives_the_policys_observation(twin, native, bundle):
    """Through names, the bundle's kinematics and the closing law, against robosuite's own poses."""
    from toolkit.deploy.kinematics import Kinematics
    from toolkit.deploy.observer import Observer

    robot = native("kinova3")
    robot.begin(5)
    twin.begin(5)
    observer = Observer(bundle.manifest, Kinematics.of(bundle.manifest, bundle.mjcf))
    command = bundle.manifest.gripper.preshape
    for step in range(10):
        action = np.array([0.2, -0.3, 0.5, 0.1, -0.1, 0.2, 1.0 if step > 3 else -1.0])
        robot.apply(action)
        twin.send(osc(action[:6], action[6]))
        command = float(np.clip(command + bundle.manifest.gripper.rate * action[6], -1, 1))
    found = twin.read()
    import mujoco

    mujoco.mj_kinematics(robot.model, robot.data)
    arrays = {key: np.array(found[key]) for key in ("joints", "fingers", "object_position", "object_quaternion", "goal")}
    np.testing.assert_allclose(observer(State(0.0, **arrays), command), robot.observe(), atol=1e-9)
    # A gripper that reports its opening alone: finger angles from the table of the gripper at rest.
    opened = {key: value for key, value in arrays.items() if key != "fingers"}
    gripper = bundle.manifest.gripper
    opening = np.interp(command, gripper.command, gripper.opening_m) / gripper.opening_m[0]
    rough = observer(State(0.0, **opened, opening=float(opening)), command)
    off = np.abs(rough - robot.observe())
    assert off.max() < 0.16, f"entry {off.argmax()} is off by {off.max():.3f}"  # a linkage on its way is not where it rests


class Clock:
    """Time that passes when told to."""

    def __init__(self):
        self.now = 100.0

    def __call__(self):
        return self.now


def test_a_twin_by_the_clock_follows_it_and_holds_when_commands_cease(twin, monkeypatch):
    clock = Clock()
    monkeypatch.setattr("toolkit.export.twin.time.monotonic", clock)
    monkeypatch.setattr(twin, "pace", "real")
    twin.begin(5)
    assert twin.catch_up() > 0, "its clock starts with the first command"
    height = twin.data.site_xpos[twin._site][2]

    def pass_time(seconds):
        clock.now += seconds
        while twin.catch_up() == 0.0:
            pass

    twin.send(osc([0, 0, 1, 0, 0, 0], 1.0))
    pass_time(0.0501)
    moved = twin.data.site_xpos[twin._site][2] - height
    assert twin._played == 25 and 0.003 < moved < 0.03, f"{moved:.4f} m in the first period"
    before = twin.native.env.robots[0].gripper["right"].current_action.copy()
    pass_time(WATCHDOG * 0.05 + 0.3)
    speed = np.abs(twin.data.qvel[twin._dofs]).max()
    assert speed < 0.04, f"the arm still moves with {speed:.3f} rad/s"  # its posture pulls it slowly back
    assert (twin.native.env.robots[0].gripper["right"].current_action == before).all(), "the gripper was told once"
    assert twin.behind >= 0.3


# -- small things ------------------------------------------------------------------------------------------------------


def test_the_deploy_package_says_what_it_imports():
    """No file of toolkit/deploy imports anything but NumPy, MuJoCo, mink, the judge of success, the toolkit's light files and the standard
    library."""
    allowed = {"numpy", "mujoco", "mink", "toolkit", *sys.stdlib_module_names}
    vendors = {"rtde_control", "rtde_receive", "franky"}
    for path in (ROOT / "toolkit" / "deploy").rglob("*.py"):
        text = re.sub(r"^from tasks.task import Judge$", "", path.read_text(), flags=re.MULTILINE)
        found = set(re.findall(r"^\s*(?:from|import) ([a-z_0-9]+)", text, re.MULTILINE))
        code = {name for name in found if name not in allowed | vendors}
        assert not code - {"kortex_api", "builtin_interfaces", "trajectory_msgs", "sensor_msgs", "rclpy"}, f"{path}: {code}"

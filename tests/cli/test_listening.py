"""deploy --dry-run: the vendor's fake is read, policy and safety speak, and nothing that moves is even opened."""

import json
import subprocess
import sys
import time
from types import SimpleNamespace

import numpy as np
import pytest

from toolkit.bundle.reading import load_bundle
from toolkit.cli.app import main
from toolkit.deploy.arm import ArmInfo, State
from toolkit.deploy.drivers.kortex import IN_FAULT
from toolkit.deploy.dry import nominal_scene
from toolkit.deploy.runtime import Runtime


def run(capsys, *words):
    """Exit status, output and complaint of deploy on the shipped Kinova3."""
    try:
        main(["deploy", "kinova3", "--dry-run", "--form", "joint", "--ticks", "3", *words])
        status = 0
    except SystemExit as end:
        status = end.code
    said = capsys.readouterr()
    return status, said.out, said.err


@pytest.fixture
def start():
    return np.array(load_bundle("kinova3").manifest.start.arm_rad)


@pytest.fixture
def gen3(gen3, start, monkeypatch):
    """A Gen3 at the bundle's start, its account known."""
    gen3.angles, gen3.opening = start.copy(), 1.0
    monkeypatch.setenv("META_EVOLVE_KORTEX_ACCOUNT", "user:se:cret")
    return gen3


def test_kortex_is_read_and_nothing_is_sent(gen3, start, capsys):
    status, out, _ = run(capsys, "--driver", "kortex", "--host", "10.0.0.4", "--json")
    said = json.loads(out)
    assert status == 0 and said["sent"] == 0 and said["would_send"] == said["ticks"] == 3 and said["faults"] == {}
    assert gen3.speeds == [] and gen3.modes == [] and not gen3.open
    assert gen3.calls == [("connect", "10.0.0.4", 10000), ("session", "user", "se:cret")], "neither gripper nor Stop"
    assert said["measured"] == pytest.approx(start.tolist(), abs=1e-6)
    assert "object is taken to lie" in said["assumed"]
    # An independent look: what the policy wants of the start, by a runtime that is given the state itself.
    bundle = load_bundle("kinova3")
    joints = tuple(said["joints"])
    runtime = Runtime(bundle, ArmInfo("kinova3", joints, (), ("joint",), 40.0), "joint")
    state = State(0.0, np.array(said["measured"]), *nominal_scene(bundle.manifest)()[:3], opening=1.0)
    assert runtime.begin(state, 0.0) is None
    wanted = runtime.tick(state, 0.0).command.target
    np.testing.assert_allclose(said["command"], wanted, atol=1e-6)
    assert 1e-5 < np.abs(wanted - start).max() < 0.2, "a small step from where the arm is"


def test_kortex_away_from_its_start_is_told_why_nothing_would_be_sent(gen3, capsys):
    gen3.angles[3] += 0.4
    status, out, _ = run(capsys, "--driver", "kortex", "--host", "10.0.0.4")
    assert status == 0 and out.count("nothing: start_pose: joint Actuator4 stands 0.400 rad from the start posture") == 3
    assert "0 would have been, held for: start_pose 3" in out and "Actuator4: 2.2020 rad, 126.2 degrees; episodes start at 1.8020" in out
    gen3.angles[3] -= 0.4
    gen3.state = IN_FAULT
    assert "nothing: arm: the arm reports: in fault" in run(capsys, "--driver", "kortex", "--host", "10.0.0.4")[1]
    gen3.refuses = "RefreshFeedback"
    assert "nothing: driver: the state could not be read" in run(capsys, "--driver", "kortex", "--host", "10.0.0.4")[1]


def test_a_dead_arm_is_noticed_though_nothing_is_sent(gen3, capsys, monkeypatch):
    """The same state over and over, read anew each time: it grows old."""
    frozen = gen3.RefreshFeedback()
    monkeypatch.setattr(gen3, "RefreshFeedback", lambda: frozen)
    status, out, _ = run(capsys, "--driver", "kortex", "--host", "10.0.0.4", "--ticks", "8", "--json")
    assert status == 0 and json.loads(out)["faults"].get("stale_state", 0) >= 3


def test_what_is_missing_is_asked_for(gen3, capsys, monkeypatch):
    status, _, err = run(capsys, "--driver", "kortex")
    assert status == 2 and "give --host" in err
    monkeypatch.delenv("META_EVOLVE_KORTEX_ACCOUNT")
    status, _, err = run(capsys, "--driver", "kortex", "--host", "10.0.0.4")
    assert status == 2 and "META_EVOLVE_KORTEX_ACCOUNT to USER:PASSWORD" in err
    status, _, err = run(capsys, "--driver", "kortex", "--host", "10.0.0.4", "--log", "x.jsonl")
    assert status == 2 and "leave out --log" in err
    with pytest.raises(SystemExit):
        main(["deploy", "kinova3", "--driver", "kortex", "--host", "10.0.0.4"])
    assert "from the command line add --dry-run" in capsys.readouterr().err and not gen3.calls
    with pytest.raises(SystemExit):
        main(["deploy", "kinova3", "--driver", "kortex", "--dry-run", "--host", "h", "--ticks", "0"])
    assert "at least one" in capsys.readouterr().err


def test_ur_opens_no_control_interface(start, monkeypatch, capsys):
    """The bundle is another arm's, which the driver cannot know: what it reports decides."""

    def control(*_):
        raise AssertionError("the interface that moves was opened")

    receive = SimpleNamespace(getActualQ=start.tolist, getActualQd=lambda: [0.0] * 7, getTargetMoment=lambda: [0.0] * 7,
                              getTimestamp=time.monotonic, isConnected=lambda: True, isEmergencyStopped=lambda: False,
                              isProtectiveStopped=lambda: False)
    monkeypatch.setitem(sys.modules, "rtde_control", SimpleNamespace(RTDEControlInterface=control))
    monkeypatch.setitem(sys.modules, "rtde_receive", SimpleNamespace(RTDEReceiveInterface=lambda host: receive))
    status, out, _ = run(capsys, "--driver", "ur", "--host", "10.0.0.2", "--json")
    assert status == 0 and json.loads(out)["would_send"] == 3
    receive.isProtectiveStopped = lambda: True
    assert "the arm reports: protective stop" in run(capsys, "--driver", "ur", "--host", "10.0.0.2")[1]


def test_franka_is_given_no_motion_and_no_setting(start, monkeypatch, capsys):
    class Untouchable:
        """Only what is named may be looked at; nothing may be set."""

        def __init__(self, **seen):
            self.__dict__.update(seen)

        def __getattr__(self, name):
            raise AssertionError(f"{name} was used")

        def __setattr__(self, name, value):
            raise AssertionError(f"{name} was set")

    class Now:
        def to_sec(self):
            return time.monotonic()

    state = SimpleNamespace(q=start.tolist(), dq=[0.0] * 7, tau_J=[0.0] * 7, time=Now())
    width = load_bundle("kinova3").manifest.gripper.opening_m[0]
    fake = SimpleNamespace(Robot=lambda host: Untouchable(state=state, has_errors=False), Gripper=lambda host: Untouchable(width=width),
                           Exception=RuntimeError)
    monkeypatch.setitem(sys.modules, "franky", fake)
    status, out, _ = run(capsys, "--driver", "franka", "--host", "10.0.0.3", "--json")
    assert status == 0 and json.loads(out)["would_send"] == 3


def test_ros2_is_heard_without_a_publisher(ros, start, capsys):
    ros.angles = start
    status, out, _ = run(capsys, "--driver", "ros2", "--json", "--ticks", "12")
    said = json.loads(out)
    assert status == 0 and said["would_send"] >= 1 and ros.topics == [] and ros.published == [] and ros.destroyed
    assert said["measured"] == pytest.approx(start.tolist())


def test_robosuites_deltas_are_no_form_for_an_arm(gen3, capsys):
    with pytest.raises(SystemExit):
        main(["deploy", "kinova3", "--driver", "kortex", "--dry-run", "--host", "h"])
    assert "takes no 'osc' commands; it takes: joint" in capsys.readouterr().err and not gen3.open


def test_a_robot_pc_needs_neither_torch_nor_robosuite_for_it():
    """Nor onnx or safetensors: what the page's own line of packages brings is enough to listen to an arm."""
    code = """
import sys
for name in ("torch", "robosuite", "onnx", "safetensors", "pinocchio", "numba", "rerun"):
    sys.modules[name] = None  # not to be imported
import time
import numpy as np
from toolkit.bundle.reading import load_bundle
from toolkit.cli import listening
from toolkit.deploy.arm import ArmInfo, State
from toolkit.deploy.drivers import franka, kortex, ros2, ur
from toolkit.deploy.dry import nominal_scene
bundle = load_bundle("kinova3")
class Arm:
    def listen(self):
        return ArmInfo("kinova3", tuple(joint.name for joint in bundle.manifest.joints), (), ("joint",), 40.0)
    def read(self):
        return State(time.monotonic(), np.array(bundle.manifest.start.arm_rad), *nominal_scene(bundle.manifest)()[:3], opening=1.0)
listening.dry(bundle, "kortex", Arm(), lambda: None, "joint", 2, False)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    assert "tick 2: would send joint" in done.stdout and "2 ticks, nothing sent; 2 would have been" in done.stdout

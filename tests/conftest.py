"""What the tests share: two robots merged once, all of them where a test asks for all, and each unmodified robot loaded once."""

import logging
import os
import shutil
import sys
import threading
import time
import types
import zipfile
from functools import cache
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import settings

# Networks this small are no faster on several threads, which burn processor time while they wait for one another.
os.environ.setdefault("OMP_NUM_THREADS", "1")
# No deadlines: they would time the first call's compilation.
settings.register_profile("repeatable", deadline=None, derandomize=True)
settings.load_profile("repeatable")
pytest.register_assert_rewrite("command_line", "toy_transfer", "toy_trees")  # its asserts say what differs, as those of a test do
logging.getLogger("robosuite_logs").addFilter(lambda record: False)  # robosuite warns of parts that no arm here has

TOGETHER = ("tests/demonstrations/", "tests/export/", "tests/inspection/")
"""Folders whose files share what takes long to make: a recording retargeted, a bundle measured, a run played and drawn."""


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config, log):
    """`--dist loadfile` that takes each of these folders for one file, so that what it makes is made once."""
    if config.getvalue("dist") != "loadfile":
        return None
    from xdist.scheduler import LoadFileScheduling

    class LoadFolders(LoadFileScheduling):
        def _split_scope(self, nodeid):
            return next((folder for folder in TOGETHER if nodeid.startswith(folder)), super()._split_scope(nodeid))

    return LoadFolders(config, log)


@pytest.fixture(scope="session")
def task():
    from tasks import TASKS

    return TASKS["061_foam_brick"]


@pytest.fixture(scope="session")
def matching():
    """Every registered robot, the source first."""
    from robots import ROBOTS
    from toolkit.morphology.matching import match

    return match(list(ROBOTS.values()))


@pytest.fixture(scope="session")
def space(matching):
    from toolkit.morphology.space import EvolutionSpace

    return EvolutionSpace(matching)


@pytest.fixture(scope="session")
def merged(space, task):
    from toolkit.morphology.build import MergedRobot

    return MergedRobot(space, task)


@pytest.fixture(scope="session")
def pair(task):
    """The source and one target, merged: for what holds of any merged robot; all of them take several times as long."""
    from robots import ROBOTS
    from toolkit.morphology.lab import Lab

    return Lab(ROBOTS["adroit"], [ROBOTS["kinova3"]], task)


@pytest.fixture(scope="session")
def arms(task):
    """The source and the three arms of the paper, merged."""
    from robots import ROBOTS
    from toolkit.morphology.lab import Lab

    return Lab(ROBOTS["adroit"], [ROBOTS[name] for name in ("jaco", "kinova3", "iiwa")], task)


def loader(make):
    """name -> what ``make`` makes of the robot of that name, once; its episode begun."""
    from robots import ROBOTS

    made = cache(lambda name: make(ROBOTS[name]))

    def load(name):
        robot = made(name)
        robot.begin(0)
        return robot

    return load


@pytest.fixture(scope="session")
def native(task):
    """name -> the unmodified robosuite robot in its own environment; whoever uses it begins an episode of its own."""
    from toolkit.simulation.native import NativeRobot

    return loader(lambda robot: NativeRobot(robot, task))


@pytest.fixture(scope="session")
def native_fast(task):
    """name -> the unmodified robosuite robot under the compiled control step."""
    from toolkit.simulation.laws import native_plant

    return loader(lambda robot: native_plant(robot, task))


@pytest.fixture(scope="session")
def engine(pair):
    """Plays on the merged pair, on two threads."""
    from toolkit.simulation.rollout import RolloutEngine

    made = RolloutEngine(pair.merged, threads=2)
    yield made
    made.close()


@pytest.fixture(scope="session")
def restless():
    """seed -> a random policy, restless enough to reach the clip."""
    from tasks.pick import ACTION, OBSERVATION, OBSERVATION_SIZE
    from toolkit.learning.policy import GaussianPolicy

    def make(seed):
        rng = np.random.default_rng(seed)
        policy = GaussianPolicy(OBSERVATION.names, ACTION.names, rng)
        policy.set_parameters(0.4 * rng.standard_normal(len(policy.parameters)))
        policy.set_normalisation(0.1 * rng.standard_normal(OBSERVATION_SIZE), OBSERVATION.numbers("scale"))
        return policy

    return make


@pytest.fixture(scope="session")
def wait_for():
    """Wait until a condition holds; fails if it does not within seconds."""

    def wait(condition, seconds=5.0):
        limit = time.monotonic() + seconds
        while not condition():
            assert time.monotonic() < limit, "it never came"
            time.sleep(0.002)

    return wait


@pytest.fixture(scope="session")
def checkout():
    """Make a folder a checkout with robots/ and grippers/ of its own, to write cards into; what else stands in it is ours."""

    def make(folder):
        root = Path(__file__).parents[1]
        for name in ("robots", "grippers"):
            shutil.copytree(root / name, folder / name, ignore=shutil.ignore_patterns("__pycache__"))
        for name in ("toolkit", "tasks", "meta_evolve.py"):
            (folder / name).symlink_to(root / name)
        return folder

    return make


@pytest.fixture
def unpacked(tmp_path):
    """name -> folder of a shipped bundle; its policy is a trained one, which no rounding throws out of its episode."""
    from toolkit.bundle.reading import shipped_bundles

    def unpack(name):
        with zipfile.ZipFile(shipped_bundles()[name]) as archive:
            archive.extractall(tmp_path)
        return tmp_path / name

    return unpack


@pytest.fixture
def log_elsewhere(tmp_path, monkeypatch):
    """MuJoCo writes its warnings to MUJOCO_LOG.TXT where it runs."""
    monkeypatch.chdir(tmp_path)


class Repeated(list):
    """protobuf's repeated field of messages."""

    def add(self):
        self.append(SimpleNamespace())
        return self[-1]


class FakeKortex:
    """A Gen3 behind the names of kortex_api 2.6: degrees from 0 to 360, and joints that go on at the last speed until told otherwise."""

    class ServerError(Exception):
        pass

    class ClientError(Exception):
        pass

    class RouterClient:
        basicErrorCallback = staticmethod(print)

        def __init__(self, transport, callback):
            pass

    def __init__(self, monkeypatch):
        self.calls, self.speeds, self.modes, self.angles, self.since = [], [], [], np.zeros(7), time.monotonic()
        self.rate, self.opening, self.refuses, self.faults, self.noise = np.zeros(7), 0.75, "", [0] * 7, 0.0
        self.state, self.motors, self.open = 7, 1, set()
        fake = self

        class Transport:
            def connect(self, host, port):
                fake.calls.append(("connect", host, port))
                fake.open.add("line")

            def disconnect(self):
                fake.open.discard("line")

        class Sessions:
            def __init__(self, router):
                pass

            def CreateSession(self, wanted):
                fake.check("CreateSession")
                fake.calls.append(("session", wanted.username, wanted.password))
                fake.open.add("session")

            def CloseSession(self, options):
                assert options.timeout_ms == 1000
                fake.open.discard("session")

        messages = SimpleNamespace(
            JointSpeeds=lambda: SimpleNamespace(joint_speeds=Repeated()), GRIPPER_POSITION=3, SINGLE_LEVEL_SERVOING=2,
            GripperCommand=lambda: SimpleNamespace(gripper=SimpleNamespace(finger=Repeated())), ServoingModeInformation=SimpleNamespace,
        )
        for name, found in {
            "kortex_api": {}, "kortex_api.autogen": {}, "kortex_api.autogen.client_stubs": {}, "kortex_api.Exceptions": {},
            "kortex_api.autogen.client_stubs.BaseClientRpc": {"BaseClient": lambda router: fake},
            "kortex_api.autogen.client_stubs.BaseCyclicClientRpc": {"BaseCyclicClient": lambda router: fake},
            "kortex_api.autogen.messages": {"Base_pb2": messages, "Session_pb2": SimpleNamespace(CreateSessionInfo=SimpleNamespace)},
            "kortex_api.Exceptions.KClientException": {"KClientException": self.ClientError},
            "kortex_api.Exceptions.KServerException": {"KServerException": self.ServerError},
            "kortex_api.RouterClient": {"RouterClient": self.RouterClient, "RouterClientSendOptions": SimpleNamespace},
            "kortex_api.SessionManager": {"SessionManager": Sessions}, "kortex_api.TCPTransport": {"TCPTransport": Transport},
        }.items():
            module = types.ModuleType(name)
            module.__dict__.update(found)
            monkeypatch.setitem(sys.modules, name, module)

    def check(self, call):
        if self.refuses == call:
            raise self.ServerError(f"{call} is refused")

    def moved(self):
        now = time.monotonic()
        self.angles, self.since = self.angles + self.rate * (now - self.since), now

    def RefreshFeedback(self):
        self.check("RefreshFeedback")
        self.moved()
        self.noise += 0.001
        rows = [SimpleNamespace(position=float(a), velocity=float(v), torque=2.0 + self.noise, fault_bank_a=bank, fault_bank_b=0)
                for a, v, bank in zip(np.degrees(self.angles) % 360, np.degrees(self.rate), self.faults, strict=True)]
        motors = [SimpleNamespace(position=100.0 * (1 - self.opening))] * self.motors
        return SimpleNamespace(base=SimpleNamespace(active_state=self.state), actuators=rows,
                               interconnect=SimpleNamespace(gripper_feedback=SimpleNamespace(motor=motors)))

    def SetServoingMode(self, mode):
        self.check("SetServoingMode")
        self.modes.append(mode.servoing_mode)

    def SendJointSpeedsCommand(self, message):
        self.check("SendJointSpeedsCommand")
        self.moved()
        assert [joint.joint_identifier for joint in message.joint_speeds] == list(range(7))
        self.rate = np.radians([joint.value for joint in message.joint_speeds])
        self.speeds.append((time.monotonic(), self.rate))

    def SendGripperCommand(self, message):
        self.calls.append(("gripper", message.mode, message.gripper.finger[0].finger_identifier, message.gripper.finger[0].value))

    def Stop(self):
        self.check("Stop")
        self.moved()
        self.rate = np.zeros(7)
        self.calls.append(("stop",))


@pytest.fixture
def gen3(monkeypatch):
    return FakeKortex(monkeypatch)


class FakeRos:
    """rclpy and the messages, as far as they are used; a publisher of joint states at 100 Hz is a thread's own business."""

    def __init__(self, monkeypatch):
        self.angles = np.zeros(7)
        self.published, self.topics, self.heard, self.alive, self.destroyed, self.spinning = [], [], {}, False, False, threading.Event()
        fake = self

        class Node:
            def create_publisher(self, kind, topic, depth):
                fake.topics.append(topic)
                return SimpleNamespace(publish=fake.published.append)

            def create_subscription(self, kind, topic, callback, depth):
                fake.heard[topic] = callback

            def destroy_node(self):
                fake.destroyed = True

        def spin_once(node, timeout_sec):
            fake.spinning.set()
            if "/joint_states" in fake.heard:
                seconds = 10**9 + time.monotonic()
                stamp = SimpleNamespace(sec=int(seconds), nanosec=int(1e9 * (seconds % 1)))
                names = [f"joint_{i}" for i in range(7, 0, -1)]
                fake.heard["/joint_states"](SimpleNamespace(
                    header=SimpleNamespace(stamp=stamp), name=names, position=fake.angles[::-1].tolist(), velocity=[0.0] * 7,
                    effort=[1.0] * 7,
                ))
            time.sleep(0.01)

        def init():
            fake.alive = True

        modules = {
            "rclpy": {"ok": lambda: fake.alive, "init": init, "create_node": lambda name: Node(), "spin_once": spin_once},
            "builtin_interfaces": {}, "builtin_interfaces.msg": {"Duration": lambda sec, nanosec: sec + 1e-9 * nanosec},
            "sensor_msgs": {}, "sensor_msgs.msg": {"JointState": object}, "trajectory_msgs": {},
            "trajectory_msgs.msg": {"JointTrajectory": SimpleNamespace, "JointTrajectoryPoint": SimpleNamespace},
        }
        for name, found in modules.items():
            module = types.ModuleType(name)
            module.__dict__.update(found)
            monkeypatch.setitem(sys.modules, name, module)


@pytest.fixture
def ros(monkeypatch):
    return FakeRos(monkeypatch)

"""Exit statuses: a command whose reader, peer, disk or worker has gone never passes for one that has done its work."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from toolkit import cli
from toolkit.bundle.reading import load_bundle
from toolkit.cli import main
from toolkit.cli.terminal import Outlet
from toolkit.deploy.arm import ArmInfo, State
from toolkit.deploy.runtime import Runtime, TickLog, play
from toolkit.errors import ToolkitError
from toolkit.io.quoting import plain

ROOT = Path(cli.__file__).parents[2]
POINTS = '{"source": {"name": "s", "alpha": [0, 0]}, "targets": [{"name": "a", "alpha": [1, 0]}, {"name": "b", "alpha": [0, 1]}]}'
FULL = pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs a device that is always full")


@pytest.fixture(autouse=True)
def at_home(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    (tmp_path / "points.json").write_text(POINTS)


def command(*words):
    return [sys.executable, "-m", "toolkit.cli", *map(str, words)]


def unread(*words):
    """Status and stderr of a command whose reader has gone before it prints."""
    reader, writer = os.pipe()
    os.close(reader)
    try:
        done = subprocess.run(command(*words), stdout=writer, stderr=subprocess.PIPE, text=True, timeout=120)
    finally:
        os.close(writer)
    return done.returncode, done.stderr


PRINTING = [
    ("robots",), ("robots", "--json"), ("tree", "--points", "points.json"), ("tree", "--points", "points.json", "--json"),
    ("bench", "tree", "--terminals", "4", "--dimensions", "3", "--json"),
    ("recordings", "make", "made", "--objects", "061_foam_brick", "--each", "1", "--frames", "12", "--json"), ("--help",),
]


@pytest.mark.parametrize("words", PRINTING, ids=" ".join)
def test_a_reader_that_wants_no_more_changes_no_status(words):
    assert unread(*words) == (0, "")


@FULL
@pytest.mark.parametrize("words", PRINTING, ids=" ".join)
def test_output_that_found_no_room_is_no_success(words):
    with open("/dev/full", "w") as full:
        done = subprocess.run(command(*words), stdout=full, stderr=subprocess.PIPE, text=True, timeout=120)
    assert done.returncode == 2 and "standard output cannot be written (No space left on device)" in done.stderr, done
    assert len(done.stderr.splitlines()) == 1, done.stderr


def test_a_failure_stays_one_when_nobody_reads():
    """Each prints before it fails; the exit status is all that a script sees."""
    subprocess.run(command("recordings", "make", "hands", "--objects", "061_foam_brick", "--each", "2", "--frames", "12"), check=True,
                   stdout=subprocess.DEVNULL, timeout=120)
    sorted(Path("hands").glob("*/*/*/labels_*.npz"))[3].unlink()
    assert unread("recordings", "list", "hands")[0] == 2
    assert unread("tree", "--points", "nosuch.json")[0] == 2


def test_a_lost_line_of_progress_stops_nothing():
    reader, writer = os.pipe()
    os.close(reader)
    done = subprocess.run(command("bench", "tree", "--terminals", "4", "--dimensions", "3", "--json"), stdout=subprocess.PIPE,
                          stderr=writer, text=True, timeout=120)
    os.close(writer)
    assert done.returncode == 0 and done.stdout.startswith("{")


def test_without_any_standard_output_a_command_still_ends_well():
    done = subprocess.run(["/bin/sh", "-c", f'exec {" ".join(command("tree", "--points", "points.json"))} >&- 2>&-'], timeout=120)
    assert done.returncode == 0


class Full:
    """A stream whose disk has filled."""

    def __init__(self, error):
        self.error, self.tries = error, 0

    def write(self, text):
        self.tries += 1
        raise self.error

    def flush(self):
        raise self.error

    def fileno(self):
        raise ValueError("no file of its own")


def test_an_outlet_remembers_why_it_was_lost_and_tries_no_more():
    stream = Full(OSError(28, "No space left on device"))
    outlet = Outlet(stream)
    print("a", file=outlet)
    print("b", file=outlet, flush=True)
    assert outlet.lost is stream.error and stream.tries == 1


def test_a_sentence_is_one_line_whatever_a_name_holds(capsys):
    with pytest.raises(SystemExit) as stop:
        main(["tree", "--points", "no\nsuch\x1b[2J\u202e.json"])
    assert stop.value.code == 2
    said = capsys.readouterr().err
    assert len(said.splitlines()) == 1 and said.isprintable() or "\x1b" not in said and "\u202e" not in said
    assert plain("a\x1b[31m\u202eb\tc") == "a\\x1b[31m\\u202eb\\tc"


@FULL
def test_what_the_machine_refuses_is_a_sentence(capsys, monkeypatch):
    """Wherever a write has no better sentence of its own."""
    import toolkit.evolution

    def full(*_):
        with open("/dev/full", "w") as file:
            file.write("x" * 100_000)

    monkeypatch.setattr(toolkit.evolution, "evolution_tree", full)
    with pytest.raises(SystemExit) as stop:
        main(["tree", "--points", "points.json"])
    assert stop.value.code == 2
    assert "No space left on device" in capsys.readouterr().err
    monkeypatch.setattr(toolkit.evolution, "evolution_tree", lambda *_: open("/nosuch/file"))
    with pytest.raises(FileNotFoundError):  # a mistake of ours keeps its traceback, and status 1
        main(["tree", "--points", "points.json"])


# -- peers and workers ---------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_twin_that_is_killed_ends_in_a_sentence_with_what_is_known():
    twin = subprocess.Popen(command("twin", "kinova3", "--pace", "lockstep"), stdout=subprocess.PIPE, text=True)
    port = twin.stdout.readline().rsplit(":", 1)[1].strip()
    deploy = subprocess.Popen(
        command("deploy", "kinova3", "--connect", f"127.0.0.1:{port}", "--pace", "lockstep", "--episodes", "50"),
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )
    try:
        for line in deploy.stderr:
            if "succeed" in line:  # the first episode is over
                break
        twin.send_signal(signal.SIGKILL)
        out, err = deploy.communicate(timeout=60)
    finally:
        twin.kill()
        deploy.kill()
        twin.wait()
    assert deploy.returncode == 2 and out == "", (deploy.returncode, out, err)
    assert "of 50 was not finished" in err and f"the twin at 127.0.0.1:{port} has gone" in err, err


@pytest.mark.slow
def test_a_twin_that_hangs_is_not_waited_for_without_end(monkeypatch):
    twin = subprocess.Popen(command("twin", "kinova3", "--pace", "lockstep"), stdout=subprocess.PIPE, text=True)
    port = int(twin.stdout.readline().rsplit(":", 1)[1])
    from toolkit.deploy.drivers import sim

    driver = sim.SimDriver("127.0.0.1", port)
    try:
        driver.connect()
        twin.send_signal(signal.SIGSTOP)
        monkeypatch.setattr(sim, "PATIENCE", 0.5)
        with pytest.raises(ToolkitError, match="no answer in 0 s|does not answer"):
            driver.read()
        twin.send_signal(signal.SIGCONT)
        for _ in range(3):  # an answer that comes too late is nobody's
            with pytest.raises(ToolkitError, match="has gone or does not answer"):
                driver.read()
    finally:
        twin.kill()
        twin.wait()


def test_a_twin_that_does_not_start_says_its_status(monkeypatch, capsys):
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    monkeypatch.setattr(sys, "executable", "/bin/false")
    with pytest.raises(SystemExit) as stop:
        main(["deploy", "kinova3", "--episodes", "1"])
    assert stop.value.code == 2 and "the twin did not start (exit status 1" in capsys.readouterr().err


class Killed:
    """Ends the process that unpickles it, as a kernel short of memory does."""

    def __reduce__(self):
        return os._exit, (9,)


@pytest.mark.slow
def test_a_killed_worker_is_no_result():
    from toolkit.evaluation.success import _outcomes

    with pytest.raises(ToolkitError, match="was killed"):
        list(_outcomes(Killed(), None, None, range(8), 2))


def test_a_viewer_that_ends_by_itself_is_a_failure(monkeypatch, capsys):
    from toolkit.cli import inspection
    from toolkit.inspection.recording import viewer

    with pytest.raises(ToolkitError, match="ended by itself with status 3"):
        inspection._wait(subprocess.Popen(["/bin/sh", "-c", "exit 3"]), "look")
    inspection._wait(subprocess.Popen(["/bin/true"]), "closed by its user")
    monkeypatch.setattr(viewer, "viewer_program", lambda: "/bin/false")
    with pytest.raises(ToolkitError, match="ended at once with status 1"):
        viewer.open_window(Path("a.rrd"))
    with pytest.raises(ToolkitError, match="does not start"):
        viewer.follow_window()


# -- the log of an arm ---------------------------------------------------------------------------------------


class Recorded:
    """An arm that does what the bundle's golden episode recorded."""

    def __init__(self, bundle):
        self.g, self.row, self.stopped = bundle.golden, 0, ""

    def read(self):
        g, last = self.g, len(self.g["episode_joints"]) - 1
        row = min(self.row, last)
        self.row += 1
        return State(time.monotonic(), g["episode_joints"][row], g["episode_object_position"][row], g["episode_object_quaternion"][row],
                     g["episode_goal"], g["episode_fingers"][row], outcome="running" if self.row <= last else "success")

    def send(self, command):
        return command

    def stop(self, reason):
        self.stopped = reason


@FULL
def test_an_arm_does_not_stop_for_its_log():
    bundle = load_bundle("kinova3")
    manifest = bundle.manifest
    info = ArmInfo("kinova3", tuple(joint.name for joint in manifest.joints), manifest.gripper.joints, ("osc",), 500.0)
    log, arm = TickLog(Path("/dev/full"), {}), Recorded(bundle)
    outcome = play(Runtime(bundle, info), arm, log, "lockstep")
    log.close()
    assert outcome.success and outcome.ticks == len(bundle.golden["episode_joints"]) - 1 and arm.stopped == "", (outcome, arm.stopped)
    assert "No space left on device" in log.trouble and "was not stopped" in log.trouble
    assert np.isfinite(outcome.tick_ms).all()


@pytest.mark.slow
@FULL
def test_deploy_says_that_its_log_is_cut_off(capsys):
    main(["deploy", "kinova3", "--episodes", "1", "--pace", "lockstep", "--log", "/dev/full"])
    said = capsys.readouterr().out
    assert "1 of 1" in said and "/dev/full is cut off" in said and "No space left on device" in said

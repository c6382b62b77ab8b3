"""export, deploy, twin: addresses and ports that are none are named, and a token is asked for where others can come."""

import socket
import subprocess
import sys
import time
from pathlib import Path

import pytest

from toolkit import cli
from toolkit.cli import main
from toolkit.cli.deployment import _address, _loopback
from toolkit.errors import ToolkitError

ROOT = Path(cli.__file__).parents[2]


@pytest.mark.parametrize("text", ["5005", "host:", ":5005", "host:0", "host:65536", "host:" + "9" * 20, "host:5005x", "host:\u0665"])
def test_an_address_that_is_none_is_refused(text):
    with pytest.raises(ToolkitError, match="is no HOST:PORT"):
        _address(text)


def test_an_address_of_the_sixth_version_is_taken():
    assert _address("[::1]:5005") == ("::1", 5005)


def test_beyond_this_machine_a_token_is_asked_for():
    for host, local in (("127.0.0.1", True), ("127.0.0.2", True), ("0.0.0.0", False)):
        with socket.create_server((host, 0)) as listener:
            assert _loopback(listener) is local


@pytest.mark.parametrize("options, said", [
    (("--port", "65536"), "port is 65536"), (("--port", "-1"), "port is -1"), (("--port", "99999999999"), "port is 99999999999"),
    (("--host", "no.such.host.invalid"), "cannot be listened on"), (("--host", "x" * 300), "cannot be listened on"),
    (("--host", "203.0.113.7", "--port", "5005"), "cannot be listened on"),
])
def test_a_port_that_cannot_be_listened_on_is_named(capsys, options, said):
    with pytest.raises(SystemExit) as stop:
        main(["twin", "kinova3", *options])
    assert stop.value.code == 2 and said in capsys.readouterr().err


def test_a_port_that_is_taken_is_named(capsys):
    with socket.create_server(("127.0.0.1", 0)) as taken:
        with pytest.raises(SystemExit) as stop:
            main(["twin", "kinova3", "--port", str(taken.getsockname()[1])])
    assert stop.value.code == 2 and "Address already in use" in capsys.readouterr().err


@pytest.mark.slow
@pytest.mark.parametrize("asked_for, has", [("lockstep", "real"), ("real", "lockstep")])
def test_a_twin_of_another_pace_is_refused(asked_for, has, capsys):
    """A lockstep client on a twin by the clock once failed every episode without a word."""
    command = [sys.executable, "-m", "toolkit.cli", "twin", "kinova3", "--pace", has]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, cwd=ROOT)
    try:
        port = int(process.stdout.readline().rsplit(":", 1)[1])
        with pytest.raises(SystemExit) as stop:
            main(["deploy", "kinova3", "--connect", f"127.0.0.1:{port}", "--pace", asked_for, "--episodes", "1"])
        assert stop.value.code == 2 and f"start it with --pace {asked_for}" in capsys.readouterr().err
    finally:
        process.kill()
        process.wait()


@pytest.mark.slow
def test_a_twin_ends_with_the_deployment_that_started_it():
    """Whose process may be killed without a word."""
    command = [sys.executable, "-m", "toolkit.cli", "deploy", "kinova3", "--episodes", "50", "--pace", "lockstep"]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True, cwd=ROOT)
    for line in process.stderr:
        if "succeed" in line:
            break
    children = Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()
    assert len(children) == 1
    process.kill()
    process.wait()
    for _ in range(100):
        if not Path(f"/proc/{children[0]}").exists():
            return
        time.sleep(0.1)
    raise AssertionError("the twin lives on, an orphan")

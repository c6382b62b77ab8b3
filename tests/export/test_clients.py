"""The twin and its clients: whatever they send, break off or leave lying, it goes on simulating and serves the next one."""

import json
import socket
import struct
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest
from wire_messages import asked, framed

import toolkit.export.twin
from robots import ROBOTS
from toolkit import cli
from toolkit.deploy import wire
from toolkit.deploy.arm import Command
from toolkit.deploy.drivers.sim import SimDriver
from toolkit.errors import ToolkitError
from toolkit.export.twin import Twin, serve

ROOT = Path(cli.__file__).parents[2]


@pytest.fixture(scope="module")
def twin(task):
    return Twin(ROBOTS["kinova3"], task, "lockstep")


@pytest.fixture
def port(twin):
    """Where the twin listens, in a thread of this process."""
    twin.begin(0)
    listener = socket.create_server(("127.0.0.1", 0))
    thread = threading.Thread(target=serve, args=(twin, listener), daemon=True)
    thread.start()
    number = listener.getsockname()[1]
    yield number
    assert thread.is_alive(), "a client ended the twin"
    driver = patient(number)
    driver.close()
    thread.join(20)
    assert not thread.is_alive(), "the twin does not close when it is asked to"
    listener.close()


def patient(port):
    """A driver that comes in, however many stray clients the twin still has to send away."""
    for _ in range(50):
        driver = SimDriver("127.0.0.1", port, patience=5.0)
        try:
            driver.connect()
            return driver
        except ToolkitError:
            time.sleep(0.1)
    raise AssertionError("the twin lets nobody in any more")


def stray(port):
    connection = socket.create_connection(("127.0.0.1", port), timeout=10)
    return connection


def osc(**entries):
    whole = {"form": "osc", "hold": False, "target": [0] * 6, "rate": [], "grip": 0.0, "opening": 1.0, "opening_m": 0.1, "waypoints": []}
    return whole | entries


def joint(**entries):
    whole = {"form": "joint", "hold": False, "target": [0.1] * 7, "rate": [0] * 7, "grip": 0, "opening": 1, "opening_m": 0.1}
    return whole | {"waypoints": [[0.1] * 7]} | entries


NONSENSE = {
    "http": b"GET / HTTP/1.1\r\nHost: twin\r\n\r\n", "tls": bytes.fromhex("16030100f1010000ed0303") + b"x" * 40, "nothing": b"",
    "half a length": b"\x00\x00", "half a message": struct.pack(">I", 100) + b'{"do": ',
    "2 GiB": struct.pack(">I", 2**31) + b"x" * 1000,
    "the longest": framed(b"[" * 2**20), "bad json": framed(b"{nope"), "a list": framed(b"[1, 2]"),
    "a number": framed(b"17"),
    "deep": framed(b'{"do":' * 100_000), "not utf-8": framed(b'{"do": "\xff\xfe"}'),
    "a long number": framed(b'{"do": ' + b"9" * 9000 + b"}"),
    "empty": framed(b""), "zeros": bytes(5000),
}
"""After these the client is sent away."""
ODD = {
    "no do": asked(), "unknown": asked(do="dance"), "a list to do": asked(do=["read"]), "seed text": asked(do="begin", seed="x"),
    "seed missing": asked(do="begin"), "seed negative": asked(do="begin", seed=-1), "seed huge": framed(b'{"do": "begin", "seed": 1e999}'),
    "seed whole and huge": asked(do="begin", seed=10**30), "seed true": asked(do="begin", seed=True), "no command": asked(do="send"),
    "command text": asked(do="send", command="go"), "command empty": asked(do="send", command={}),
    "NaN": asked(do="send", command=osc(target=[float("nan")] * 6)), "infinite": asked(do="send", command=osc(grip=float("inf"))),
    "opening NaN": asked(do="send", command=osc(opening_m=float("nan"))), "words": asked(do="send", command=osc(target=["a"] * 6)),
    "ragged": asked(do="send", command=joint(waypoints=[[1], [1, 2]])), "no form": asked(do="send", command=osc(form=None)),
    "a list as form": asked(do="send", command=osc(form=["osc"])), "hold text": asked(do="send", command=osc(hold="false")),
    "another size": asked(do="send", command=osc(target=[0] * 5)), "deep target": asked(do="send", command=osc(target=[[0] * 6])),
    "no waypoints": asked(do="send", command=joint(waypoints=[])), "far": asked(do="send", command=joint(target=[1e300] * 7)),
    "a huge number": framed(json.dumps({"do": "send", "command": osc()}).replace('"grip": 0.0', '"grip": ' + "9" * 400).encode()),
    "no unit quaternion": asked(do="send", command={**osc(form="pose", target=[0.4, 0, 0.4, 0, 0, 0, 0], rate=[0] * 6),
                                                    "waypoints": [[0.4, 0, 0.4, 1, 0, 0, 0]]}),
}
"""These are refused by a sentence, and the client is served on."""

@pytest.mark.parametrize("name", NONSENSE)
def test_nonsense_ends_its_client_and_not_the_twin(port, name):
    with stray(port) as client:
        client.sendall(NONSENSE[name])
        client.shutdown(socket.SHUT_WR)
        heard = b"".join(iter(lambda: client.recv(4096), b""))
    assert heard == b"" or b"error" in heard
    driver = patient(port)
    driver.begin(1)
    assert driver.read().fault == ""
    driver.leave()


@pytest.mark.parametrize("name", ODD)
def test_an_odd_question_is_refused_by_a_sentence(port, name):
    line = wire.Line(stray(port))
    line._out += ODD[name]
    answer = wire.exchange(line, {"do": "read", "number": 7}, 20.0)
    assert set(answer) == {"error"} and 10 < len(answer["error"]) < 400, answer
    assert wire.exchange(line, {"do": "begin", "seed": 3, "number": 8}, 20.0)["number"] == 7, "the question after it is answered"
    line.close()


def test_a_reset_in_the_midst_of_an_answer(port):
    for _ in range(5):
        client = stray(port)
        client.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        client.sendall(asked(do="read") * 50)
        client.close()
    driver = patient(port)
    assert "the runtime has gone" in driver.read().fault
    driver.leave()


def test_a_client_that_never_reads_fills_no_memory(port):
    client = stray(port)
    client.settimeout(0.5)
    try:
        for _ in range(20_000):
            client.sendall(asked(do="read"))
    except OSError:
        pass  # the twin has sent it away, or takes nothing any more
    driver = patient(port)  # it says sensible words, so it is served until it stops reading
    driver.leave()
    client.close()


def test_a_second_client_is_told_so_at_once_and_the_first_served_on(port):
    first = patient(port)
    first.begin(5)
    began = time.monotonic()
    with pytest.raises(ToolkitError, match="it serves another client"):
        SimDriver("127.0.0.1", port).connect()
    assert time.monotonic() - began < 5.0
    first.send(Command("osc", False, np.zeros(6), np.zeros(0), 0.0, 1.0, 0.1))
    assert first.read().fault == ""
    first.leave()


def test_a_half_open_client_gives_way(port, monkeypatch):
    """One that never says a word at once, one that has spoken after a while."""
    mute = [stray(port) for _ in range(3)]
    first = patient(port)
    first.begin(5)
    monkeypatch.setattr(toolkit.export.twin, "PATIENCE", 0.3)
    time.sleep(0.4)
    second = patient(port)
    second.begin(5)
    assert second.read().fault == ""
    with pytest.raises(ToolkitError, match="another client came|has gone"):
        first.read()
    second.leave()
    for client in mute:
        client.close()


def test_a_dribbling_client_does_not_stop_the_clock(task):
    """By the clock the physics goes on while a message comes byte by byte, and the arm holds."""
    twin = Twin(ROBOTS["kinova3"], task, "real")
    listener = socket.create_server(("127.0.0.1", 0))
    thread = threading.Thread(target=serve, args=(twin, listener), daemon=True)
    thread.start()
    driver = patient(listener.getsockname()[1])
    driver.begin(0)
    driver.send(Command("osc", False, np.array([0, 0, 1.0, 0, 0, 0]), np.zeros(0), 0.0, 1.0, 0.1))
    before = twin.data.time
    for byte in asked(do="read")[:20]:
        driver._line._socket.send(bytes([byte]))
        time.sleep(0.03)
    passed = twin.data.time - before
    assert passed > 0.2, f"{passed:.3f} s of physics in 0.6 s"
    driver.leave()
    time.sleep(1.0)  # without any client it goes on too, and stands still
    later = twin.data.time
    time.sleep(0.5)
    assert twin.data.time > later and np.abs(twin.data.qvel[twin._dofs]).max() < 0.05
    closing = patient(listener.getsockname()[1])
    assert "the runtime has gone" in closing.read().fault
    closing.close()
    thread.join(20)
    assert not thread.is_alive()
    listener.close()


def test_a_simulation_that_breaks_is_told_and_the_next_episode_plays(twin, monkeypatch):
    twin.begin(0)
    monkeypatch.setattr(twin, "_control", lambda: np.linalg.solve(np.zeros((2, 2)), np.ones(2)))
    twin.send(Command("osc", False, np.zeros(6), np.zeros(0), 0.0, 1.0, 0.1))
    assert "the simulation has failed" in twin.read()["fault"]
    monkeypatch.undo()
    twin.begin(0)
    twin.send(Command("osc", False, np.zeros(6), np.zeros(0), 0.0, 1.0, 0.1))
    assert twin.read()["fault"] == ""


@pytest.mark.parametrize("form, size", [("joint", 7), ("pose", 7)])
def test_commands_at_the_edge_of_sense_leave_it_alive(twin, form, size):
    """The largest numbers that are let through, for a second of simulation; it may diverge, and then says so."""
    twin.begin(0)
    target = np.full(size, wire.FAR)
    if form == "pose":
        target[3:] = [0.5, -0.5, 0.5, -0.5]
    rate = np.full({"joint": 7, "pose": 6}[form], -wire.FAR)
    for _ in range(20):
        twin.send(Command(form, False, target, rate, 1.0, 0.0, 0.0, np.repeat(target[None], 5, axis=0)))
    json.dumps(twin.read(), allow_nan=False)
    twin.begin(0)
    assert twin.read()["fault"] == ""


# -- the other side of the wire ------------------------------------------------------------------------------


@pytest.mark.parametrize("token, said", [("", "knows its token"), ("wrong", "knows its token"), ("right", ""), ("r\u00efght", "knows")])
def test_a_twin_with_a_token_serves_only_who_knows_it(twin, token, said):
    twin.begin(0)
    listener = socket.create_server(("127.0.0.1", 0))
    thread = threading.Thread(target=serve, args=(twin, listener), kwargs={"token": "right"}, daemon=True)
    thread.start()
    number = listener.getsockname()[1]
    driver = SimDriver("127.0.0.1", number, token=token)
    if said:
        with pytest.raises(ToolkitError, match=said):
            driver.connect()
        with stray(number) as client:
            client.sendall(asked(do="close"))
            assert b"token" in client.recv(4096), "a stranger does not end it either"
        driver = SimDriver("127.0.0.1", number, token="right")
    driver.connect()
    driver.begin(1)
    assert driver.read().fault == ""
    driver.close()
    thread.join(20)
    assert not thread.is_alive()
    listener.close()


@pytest.mark.slow
def test_the_command_outlives_stray_clients_too():
    process = subprocess.Popen([sys.executable, "-m", "toolkit.cli", "twin", "kinova3", "--pace", "lockstep"], stdout=subprocess.PIPE,
                               text=True, cwd=ROOT)
    try:
        port = int(process.stdout.readline().rsplit(":", 1)[1])
        for content in (NONSENSE["http"], NONSENSE["bad json"], ODD["seed text"], NONSENSE["2 GiB"]):
            with stray(port) as client:
                client.sendall(content)
        client = stray(port)
        client.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        client.sendall(asked(do="read") * 50)
        client.close()
        driver = patient(port)
        driver.begin(0)
        assert driver.read().fault == "" and process.poll() is None
        driver.close()
        assert process.wait(20) == 0
    finally:
        process.kill()

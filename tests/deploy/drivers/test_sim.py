"""The twin's driver: whatever answers in place of a twin is named."""

import socket
import threading
import time

import pytest
from wire_messages import asked, framed

from toolkit.deploy.drivers.sim import SimDriver
from toolkit.errors import ToolkitError

FOREIGN = {
    "http": b"HTTP/1.1 400 Bad Request\r\n\r\n", "nothing": b"", "bad json": framed(b"{nope"), "a list": framed(b"[]"),
    "deep": framed(b"[" * 50_000), "no description": asked(number=1), "odd entries": asked(number=1, colour="red"),
    "names that are none": asked(number=1, robot=3, joints=[1], fingers=[], forms=["osc"], rate_hz="fast"),
    "late": asked(number=0, robot="kinova3"),
}


def answering(content):
    """A server that answers every client with some bytes."""
    listener = socket.create_server(("127.0.0.1", 0))

    def answer():
        try:
            while True:
                connection, _ = listener.accept()
                connection.recv(100)
                connection.sendall(content)
                connection.close()
        except OSError:
            pass

    threading.Thread(target=answer, daemon=True).start()
    return listener


@pytest.mark.parametrize("name", FOREIGN)
def test_what_answers_in_place_of_a_twin_is_named(name):
    with answering(FOREIGN[name]) as listener:
        port = listener.getsockname()[1]
        with pytest.raises(ToolkitError, match=f"127.0.0.1:{port}"):
            SimDriver("127.0.0.1", port).connect()


def test_a_host_without_an_address_is_refused_without_patience():
    began = time.monotonic()
    with pytest.raises(ToolkitError, match="is no address of a twin"):
        SimDriver("no.such.host.invalid", 5005).connect()
    assert time.monotonic() - began < 60

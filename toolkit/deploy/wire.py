"""Messages between the runtime and the twin: a length, then JSON. Inert, and bounded in size."""

import json
import select
import socket
import struct
import time
from typing import Any

import numpy as np

from toolkit.deploy.arm import FORMS, Command
from toolkit.errors import ToolkitError

LARGEST = 2**20
"""Bytes of a message."""


FAR = 1e3
"""[rad, m, 1/s] beyond which no number of a command makes sense."""
UNIT = 1e-3
"""By which the length of a pose's quaternion may differ from 1."""
FOREIGN = "is another program on that port?"


class Line:
    """One end of a connection, which never waits: what came is taken out message by message, what does not fit goes out later.

    Args:
        connection: a connected stream socket; the line owns it.

    Attributes:
        ended: whether the other side has closed; what it sent before is still taken out.
    """

    def __init__(self, connection: socket.socket) -> None:
        connection.setblocking(False)
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)  # a peer whose machine is gone is noticed
        if connection.family in (socket.AF_INET, socket.AF_INET6):
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._socket, self._in, self._out = connection, bytearray(), bytearray()
        self.ended = False

    def fileno(self) -> int:
        """For select."""
        return self._socket.fileno()

    @property
    def waiting(self) -> bool:
        """Whether something is still to go out."""
        return bool(self._out)

    def post(self, message: dict[str, Any]) -> None:
        """Send a message, or as much of it as the other side has room for; ``push`` sends the rest.

        Raises:
            ToolkitError: the other side takes nothing any more.
            OSError: the connection is broken.
        """
        self._out += _framed(message)
        if len(self._out) > 2 * LARGEST:
            raise ToolkitError(f"{len(self._out)} bytes wait to be read by the other side, which does not")
        self.push()

    def push(self) -> None:
        """Send what still waits, as far as there is room."""
        try:
            while self._out:
                del self._out[: self._socket.send(self._out)]
        except BlockingIOError:
            pass

    def pull(self) -> None:
        """Take in what has come: a whole message's worth at most, so that nobody fills the memory."""
        try:
            while not self.ended and len(self._in) < LARGEST + 4:
                part = self._socket.recv(2**16)
                self._in += part
                self.ended = not part
        except BlockingIOError:
            pass

    def next(self) -> dict[str, Any] | None:
        """The next whole message that has come; None if there is none yet.

        Raises:
            ToolkitError: something else speaks there.
        """
        if len(self._in) < 4:
            return None
        size = _checked_size(bytes(self._in[:4]))
        if len(self._in) < 4 + size:
            return None
        content = bytes(self._in[4 : 4 + size])
        del self._in[: 4 + size]
        return _message(content)

    def close(self) -> None:
        """Close the connection, whatever state it is in."""
        self._socket.close()


def exchange(line: Line, message: dict[str, Any], patience: float) -> dict[str, Any]:
    """Ask, and wait for the answer.

    Args:
        line: to the other side.
        message: the question.
        patience: [s].

    Raises:
        ToolkitError: it has closed, does not answer in time, or something else speaks there.
        OSError: the connection is broken.
    """
    limit = time.monotonic() + patience
    line.post(message)
    while True:
        answer = line.next()
        if answer is not None:
            return answer
        if line.ended:
            raise ToolkitError("it has closed the connection")
        left = limit - time.monotonic()
        if left <= 0:
            raise ToolkitError(f"no answer in {patience:.0f} s")
        readable, writable, _ = select.select([line], [line] if line.waiting else [], [], left)
        if writable:
            line.push()
        if readable:
            line.pull()


def _framed(message: dict[str, Any]) -> bytes:
    try:
        content = json.dumps(message, allow_nan=False).encode()
    except ValueError:
        raise ToolkitError("a message holds numbers that are not finite, which JSON does not have") from None
    return struct.pack(">I", len(content)) + content


def _checked_size(head: bytes) -> int:
    size = struct.unpack(">I", head)[0]
    if size > LARGEST:
        raise ToolkitError(f"a message of {size} bytes came, more than {LARGEST}; {FOREIGN}")
    return size


def _message(content: bytes) -> dict[str, Any]:
    try:
        message = json.loads(content)
    except (ValueError, RecursionError) as error:
        raise ToolkitError(f"a message came that is no JSON ({str(error)[:80]}); {FOREIGN}") from None
    if not isinstance(message, dict):
        raise ToolkitError(f"a message came that is no object; {FOREIGN}")
    return message


def command_to_json(command: Command) -> dict[str, Any]:
    """All of a command."""
    return {
        "form": command.form, "hold": command.hold, "target": command.target.tolist(), "rate": command.rate.tolist(),
        "grip": command.grip, "opening": command.opening, "opening_m": command.opening_m, "waypoints": command.waypoints.tolist(),
    }


def command_from_json(content: dict[str, Any]) -> Command:
    """A command again.

    Raises:
        ToolkitError: an entry is missing, of another kind, not finite, absurdly large, or no pose.
    """
    try:
        if not isinstance(content["hold"], bool):
            raise TypeError("hold is neither true nor false")
        command = Command(
            form=content["form"], hold=content["hold"], target=np.array(content["target"], float),
            rate=np.array(content["rate"], float), grip=float(content["grip"]), opening=float(content["opening"]),
            opening_m=float(content["opening_m"]), waypoints=np.array(content["waypoints"], float),
        )
    except (KeyError, TypeError, ValueError, OverflowError, AttributeError) as error:
        raise ToolkitError(f"a command came that is none ({type(error).__name__}: {str(error)[:80]})") from None
    wanted = {"osc": (6,), "pose": (7,)}.get(str(command.form), (command.target.size,))
    if command.form not in FORMS or command.target.shape != wanted:
        raise ToolkitError(f"a command of form {str(command.form)[:40]!r} came with a target of shape {command.target.shape}")
    lone = [command.grip, command.opening, command.opening_m]
    numbers = np.concatenate([command.target, command.rate.ravel(), command.waypoints.ravel(), lone])
    if not (np.abs(numbers) <= FAR).all():
        odd = numbers[int((~(np.abs(numbers) <= FAR)).argmax())]
        raise ToolkitError(f"a {command.form} command came with the number {odd:.3g}; finite ones up to {FAR:.0f} make sense")
    if command.form == "pose":
        turns = np.vstack([command.target, command.waypoints]) if command.waypoints.shape[1:] == (7,) else command.target[None]
        length = np.linalg.norm(turns[:, 3:], axis=1)
        if np.abs(length - 1.0).max() > UNIT:
            raise ToolkitError(f"a pose command came with a quaternion of length {length[np.abs(length - 1.0).argmax()]:.3g}, not 1")
    return command

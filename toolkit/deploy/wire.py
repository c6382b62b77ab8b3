"""Messages between the runtime and the twin: a length, then JSON. Inert, and bounded in size."""

import json
import socket
import struct
from typing import Any

import numpy as np

from toolkit.deploy.arm import Command
from toolkit.errors import ToolkitError

LARGEST = 2**20
"""Bytes of a message."""


def send(connection: socket.socket, message: dict[str, Any]) -> None:
    """Send one message; numbers that are not finite travel as null."""
    content = json.dumps(message, allow_nan=False).encode()
    connection.sendall(struct.pack(">I", len(content)) + content)


def receive(connection: socket.socket) -> dict[str, Any] | None:
    """The next message; None once the other side has closed.

    Raises:
        ToolkitError: something else speaks there.
    """
    head = _exactly(connection, 4)
    if head is None:
        return None
    size = struct.unpack(">I", head)[0]
    if size > LARGEST:
        raise ToolkitError(f"a message of {size} bytes came, more than {LARGEST}; is another program on that port?")
    content = _exactly(connection, size)
    if content is None:
        return None
    try:
        message = json.loads(content)
    except ValueError as error:
        raise ToolkitError(f"a message came that is no JSON ({error}); is another program on that port?") from None
    if not isinstance(message, dict):
        raise ToolkitError("a message came that is no object; is another program on that port?")
    return message


def _exactly(connection: socket.socket, size: int) -> bytes | None:
    parts = bytearray()
    while len(parts) < size:
        part = connection.recv(size - len(parts))
        if not part:
            return None
        parts += part
    return bytes(parts)


def command_to_json(command: Command) -> dict[str, Any]:
    """All of a command."""
    return {
        "form": command.form, "hold": command.hold, "target": command.target.tolist(), "rate": command.rate.tolist(),
        "grip": command.grip, "opening": command.opening, "opening_m": command.opening_m, "waypoints": command.waypoints.tolist(),
    }  # fmt: skip


def command_from_json(content: dict[str, Any]) -> Command:
    """A command again.

    Raises:
        ToolkitError: an entry is missing, of another kind, or not finite.
    """
    try:
        command = Command(
            form=content["form"], hold=bool(content["hold"]), target=np.array(content["target"], float),
            rate=np.array(content["rate"], float), grip=float(content["grip"]), opening=float(content["opening"]),
            opening_m=float(content["opening_m"]), waypoints=np.array(content["waypoints"], float),
        )  # fmt: skip
    except (KeyError, TypeError, ValueError) as error:
        raise ToolkitError(f"a command came that is none ({error!r})") from None
    sizes = {"osc": (6,), "pose": (7,)}.get(command.form, command.target.shape)
    numbers = np.concatenate([command.target.ravel(), command.rate.ravel(), command.waypoints.ravel(), [command.grip, command.opening]])
    if command.form not in ("osc", "pose", "joint") or command.target.shape != sizes or not np.isfinite(numbers).all():
        raise ToolkitError(f"a {command.form!r} command came with target {command.target.tolist()}")
    return command

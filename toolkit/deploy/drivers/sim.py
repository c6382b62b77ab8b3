"""The twin's end of the wire: the simulated robosuite robot in another process, as if it were an arm."""

import socket
import time
from typing import Any

import numpy as np

from toolkit.deploy import wire
from toolkit.deploy.arm import ArmInfo, Command, State
from toolkit.errors import ToolkitError

PATIENCE = 20.0
"""[s] for a single answer; a busy machine compiles or loads a model meanwhile."""


class SimDriver:
    """A connection to ``meta-evolve twin``.

    Args:
        host, port: where it listens.
        patience: [s] for the first connection, while the twin still loads its robot.
    """

    def __init__(self, host: str, port: int, patience: float = 120.0) -> None:
        self.host, self.port, self.patience = host, port, patience
        self._socket: socket.socket | None = None

    def connect(self) -> ArmInfo:
        """See Driver.

        Raises:
            ToolkitError: nobody listens there.
        """
        limit = time.monotonic() + self.patience
        while self._socket is None:
            try:
                self._socket = socket.create_connection((self.host, self.port), timeout=PATIENCE)
            except OSError as error:
                if time.monotonic() > limit:
                    raise ToolkitError(
                        f"no twin answers at {self.host}:{self.port} ({error}); start one: meta-evolve twin BUNDLE --port {self.port}"
                    ) from None
                time.sleep(0.1)
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        found = self._ask({"do": "describe"})
        try:
            return ArmInfo(**{key: tuple(value) if isinstance(value, list) else value for key, value in found.items()})
        except TypeError as error:
            raise ToolkitError(f"{self.host}:{self.port} is no twin of this release ({error}); start: meta-evolve twin BUNDLE") from None

    def begin(self, seed: int) -> None:
        """Put arm, gripper and object at the start that a seed determines."""
        self._ask({"do": "begin", "seed": seed})

    def read(self) -> State:
        """See Driver. The stamp is when the question was asked, so that the way of the answer counts as age."""
        asked = time.monotonic()
        found = self._ask({"do": "read"})
        arrays = {key: np.array(found[key], float) for key in ("joints", "fingers", "speeds", "efforts", "object_position",
                                                                "object_quaternion", "goal")}  # fmt: skip
        return State(asked - float(found["age"]), opening=None, fault=found["fault"], outcome=found["outcome"], **arrays)

    def send(self, command: Command) -> Command:
        """See Driver."""
        return wire.command_from_json(self._ask({"do": "send", "command": wire.command_to_json(command)})["sent"])

    def stop(self, reason: str) -> None:
        """See Driver. A twin that is gone is stopped."""
        try:
            self._ask({"do": "stop", "reason": reason})
        except (OSError, ToolkitError):
            pass

    def result(self) -> dict[str, Any]:
        """The twin's own account of the episode: success, and how far it ran behind the clock [s]."""
        return self._ask({"do": "result"})

    def close(self) -> None:
        """Let the twin end."""
        if self._socket is not None:
            try:
                wire.send(self._socket, {"do": "close"})
            except OSError:
                pass
            self._socket.close()
            self._socket = None

    def _ask(self, message: dict[str, Any]) -> dict[str, Any]:
        if self._socket is None:
            raise ToolkitError("the twin is not connected; call connect first")
        wire.send(self._socket, message)
        answer = wire.receive(self._socket)
        if answer is None:
            raise ToolkitError("the twin has gone; see what it printed")
        if "error" in answer:
            raise ToolkitError(f"the twin refuses: {answer['error']}")
        return answer

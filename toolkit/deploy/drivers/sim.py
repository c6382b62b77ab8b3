"""The twin's end of the wire: the simulated robosuite robot in another process, as if it were an arm."""

import socket
import time
from typing import Any

import numpy as np

from toolkit.deploy import wire
from toolkit.deploy.arm import WALL, ArmInfo, Command, State
from toolkit.errors import ToolkitError
from toolkit.io.quoting import told

PATIENCE = 20.0
"""[s] for a single answer; a busy machine compiles or loads a model meanwhile."""


class SimDriver:
    """A connection to ``meta-evolve twin``; also the clock of its arm: a twin in lockstep has a time of its own.

    Args:
        host, port: where it listens.
        patience: [s] for the first connection, while the twin still loads its robot.  answer: [s] for a single answer.
        token: that a twin which others can reach has printed; empty: it has none.

    Attributes:
        pace: of the twin, once connected: "real" or "lockstep".
    """

    def __init__(self, host: str, port: int, patience: float = 120.0, answer: float = PATIENCE, token: str = "") -> None:
        self.host, self.port, self.patience, self.answer = host, port, patience, answer
        self.token = token
        self._line: wire.Line | None = None
        self._asked, self._gone = 0, ""
        self.pace, self._time = "", 0.0

    def now(self) -> float:
        """See Clock: what a twin in lockstep has played since its episode began."""
        return self._time if self.pace == "lockstep" else WALL.now()

    def sleep(self, seconds: float) -> None:
        """See Clock. A twin in lockstep plays on as one whose runtime sleeps."""
        if self.pace != "lockstep":
            WALL.sleep(seconds)
        else:
            self._ask({"do": "wait", "seconds": seconds})

    @property
    def where(self) -> str:
        """HOST:PORT."""
        return f"{self.host}:{self.port}"

    def connect(self) -> ArmInfo:
        """See Driver.

        Raises:
            ToolkitError: nobody listens there, or no twin does, or it serves somebody else.
        """
        limit = time.monotonic() + self.patience
        while self._line is None:
            try:
                self._line = wire.Line(socket.create_connection((self.host, self.port), timeout=PATIENCE))
            except (socket.gaierror, UnicodeError, OverflowError) as error:  # no patience gives a name an address
                raise ToolkitError(f"{self.where} is no address of a twin ({error}); give HOST:PORT, such as 127.0.0.1:5005") from None
            except OSError as error:
                if time.monotonic() > limit:
                    raise ToolkitError(
                        f"no twin answers at {self.where} ({error}); start one: {told('twin', 'BUNDLE', '--port', self.port)}"
                    ) from None
                time.sleep(0.1)
        self._asked, self._gone = 0, ""
        found = self._ask({"do": "describe"} | ({"token": self.token} if self.token else {}))
        self.pace = str(found.pop("pace", ""))
        try:
            said: dict[str, Any] = {key: tuple(value) if isinstance(value, list) else value for key, value in found.items()}
            info = ArmInfo(**said)
            if not all(isinstance(name, str) for name in (info.robot, *info.joints, *info.fingers)) or not float(info.rate_hz) > 0:
                raise TypeError("its description holds no names and rate")
            return info
        except (TypeError, ValueError, OverflowError) as error:
            raise self._odd(error) from None

    def begin(self, seed: int) -> None:
        """Put arm, gripper and object at the start that a seed determines."""
        self._ask({"do": "begin", "seed": seed})

    def read(self) -> State:
        """See Driver. The stamp is when the question was asked, so that the way of the answer counts as age."""
        asked = self.now()
        found = self._ask({"do": "read"})
        try:
            arrays = {key: np.array(found[key], float) for key in ("joints", "fingers", "speeds", "efforts", "object_position",
                                                                    "object_quaternion", "goal")}
            return State(asked - float(found["age"]), opening=None, fault=str(found["fault"]), outcome=str(found["outcome"]), **arrays)
        except (KeyError, TypeError, ValueError, OverflowError) as error:
            raise self._odd(error) from None

    def send(self, command: Command) -> Command:
        """See Driver."""
        return wire.command_from_json(self._ask({"do": "send", "command": wire.command_to_json(command)}).get("sent", {}))

    def stop(self, reason: str) -> None:
        """See Driver. A twin that is gone is stopped."""
        try:
            self._ask({"do": "stop", "reason": reason})
        except ToolkitError:
            pass

    def result(self) -> tuple[bool, float]:
        """The twin's own account of the episode: success, and how far it ran behind the clock [s]."""
        found = self._ask({"do": "result"})
        try:
            return bool(found["success"]), float(found["behind_s"])
        except (KeyError, TypeError, ValueError, OverflowError) as error:
            raise self._odd(error) from None

    def close(self) -> None:
        """Let the twin end."""
        if self._line is not None:
            try:
                self._line.post({"do": "close"})
            except (OSError, ToolkitError):
                pass
            self.leave()

    def leave(self) -> None:
        """Go; the twin waits for the next one."""
        if self._line is not None:
            self._line.close()
            self._line = None

    def _ask(self, message: dict[str, Any]) -> dict[str, Any]:
        """The answer to a question; they are numbered, so that a late one is never taken for another's.

        Raises:
            ToolkitError: the twin refuses, or has gone: then it is not asked again.
        """
        if self._line is None:
            raise ToolkitError(self._gone or "the twin is not connected; call connect first")
        self._asked += 1
        try:
            answer = wire.exchange(self._line, message | {"number": self._asked}, self.answer)
            if "number" not in answer and "error" in answer:
                raise ToolkitError(f"it sends this client away: {answer['error']}")
            if answer.pop("number", None) != self._asked:
                raise ToolkitError(f"an answer came to another question; {wire.FOREIGN}")
        except (OSError, ToolkitError) as error:
            self.leave()
            self._gone = f"the twin at {self.where} has gone or does not answer ({error}); see what it printed"
            raise ToolkitError(self._gone) from None
        if "error" in answer:
            raise ToolkitError(f"the twin refuses: {answer['error']}")
        try:
            self._time = float(answer.pop("time", self._time))
        except (TypeError, ValueError, OverflowError) as error:
            raise self._odd(error) from None
        return answer

    def _odd(self, error: Exception) -> ToolkitError:
        return ToolkitError(f"{self.where} is no twin of this release ({error!r}); start: meta-evolve twin BUNDLE")

"""The newest command, and the thread that feeds an arm with it more often than the policy decides; a watchdog stands in its way."""

import threading
from collections.abc import Callable, Iterable

from toolkit.deploy.arm import Clock, Command
from toolkit.errors import ToolkitError

WATCHDOG = 0.2
"""[s] without a command after which the arm is held."""
ENDING = 1.0
"""[s] within which the thread must have ended: a request on its way is waited for no longer."""


class Streamer:
    """Feeds one arm; its driver begins it anew with every connection.

    Args:
        clock: of a command's age.

    Attributes:
        trouble: why the arm is fed no more; empty while nothing is wrong.
    """

    def __init__(self, clock: Clock) -> None:
        self._clock, self._lock, self._ended = clock, threading.Lock(), threading.Event()
        self._newest: tuple[Command, float] | None = None
        self._thread: threading.Thread | None = None
        self.trouble = ""

    def begin(self, cycles: Iterable[None], feed: Callable[[Command, float], None], hold: Callable[[], None]) -> None:
        """Start the thread; what was sent or went wrong before is forgotten.

        Args:
            cycles: one item whenever a message is due, without end; drawn by the thread.
            feed: (command, its age [s]) -> one message to the arm; raises ToolkitError where the arm refuses it.
            hold: the arm's own deceleration, once, when there is nothing to feed; raises likewise.
        """
        self._ended.clear()
        self.trouble, self._newest = "", None
        thread = self._thread = threading.Thread(target=self._run, args=(cycles, feed, hold), daemon=True)
        thread.start()

    def send(self, command: Command) -> None:
        """Feed this from now on.

        Raises:
            ToolkitError: the arm is fed no more.
        """
        if self.trouble:
            raise ToolkitError(f"the arm has stopped: {self.trouble}")
        with self._lock:
            self._newest = command, self._clock.now()

    def end(self, reason: str) -> bool:
        """Feed the arm no more, and say why; may be called twice, and from any thread. Returns whether a thread had begun."""
        self.trouble = self.trouble or reason
        self._ended.set()
        begun, self._thread = self._thread, None
        if begun is not None and begun is not threading.current_thread():
            begun.join(timeout=ENDING)
        return begun is not None

    def _run(self, cycles: Iterable[None], feed: Callable[[Command, float], None], hold: Callable[[], None]) -> None:
        still = True
        try:
            for _ in cycles:
                if self._ended.is_set():
                    return
                with self._lock:
                    newest = self._newest
                if newest is not None and not newest[0].hold and (age := self._clock.now() - newest[1]) <= WATCHDOG:
                    feed(newest[0], age)
                    still = False
                elif not still:
                    hold()
                    still = True
        except ToolkitError as error:
            self.trouble = self.trouble or str(error)

"""When a device measured what it says: its own clock, set to ours.

A driver that stamps a state when it reads it makes a dead sensor look alive. Every controller and camera counts something of its own
(seconds since it was switched on, packets, frames); only if that goes on is the state a new one.
"""

import time
from collections.abc import Callable

DRIFT = 1e-3
"""[1] by which a device's clock is let run slower than ours, so that its offset is found anew, not for ever the luckiest packet's."""


class DeviceClock:
    """A device's seconds as time.monotonic's.

    The two clocks are set by the quickest packet seen: no packet comes before it was measured, so that what comes later than the
    quickest has been on its way for longer, and is so much older.

    Args:
        now: our clock [s].
    """

    def __init__(self, now: Callable[[], float] = time.monotonic) -> None:
        self._now, self._offset, self._last, self._set = now, float("inf"), 0.0, 0.0

    def __call__(self, seconds: float) -> float:
        """When [s, time.monotonic] the device measured what it stamps with its own ``seconds``; one that stands still grows old."""
        now = self._now()
        if seconds < self._last:  # switched on again
            self._offset = float("inf")
        if seconds != self._last or self._offset == float("inf"):
            self._offset = min(now - seconds, self._offset + DRIFT * (now - self._set))
            self._last, self._set = seconds, now
        return min(now, seconds + self._offset)


class Changes:
    """For a device that counts, but keeps no clock: a state is as old as its number.

    Args:
        now: our clock [s].
    """

    def __init__(self, now: Callable[[], float] = time.monotonic) -> None:
        self._now, self._last, self._since = now, None, 0.0

    def __call__(self, number: object) -> float:
        """When [s, time.monotonic] this number was first seen."""
        if number != self._last:
            self._last, self._since = number, self._now()
        return self._since

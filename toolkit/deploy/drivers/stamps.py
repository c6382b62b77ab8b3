"""When a device measured what it says: its own clock, set to ours.

A driver that stamps a state when it reads it makes a dead sensor look alive. Every controller and camera counts something of its own
(seconds since it was switched on, packets, frames); only if that goes on is the state a new one.
"""

import time
from collections.abc import Callable

DRIFT = 1e-3
"""[1] by which a device's clock is let run slower than ours, so that its offset is found anew, not for ever the luckiest packet's; and
faster, before it counts as put on."""
LEAP, SETTLING = 0.1, 0.2
"""[s] by which a stamp may come before its time and be taken for a quicker packet, and [s] from the first packet on in which any may: those
that waited before the connection was read are the slowest."""


class DeviceClock:
    """A device's seconds as time.monotonic's, for as long as one connection lasts.

    The two clocks are set by the quickest packet seen: no packet comes before it was measured, so that what comes later than the
    quickest has been on its way for longer, and is so much older. A device whose seconds go back, because it has started again or a
    packet comes out of its order, is as old as they say, and one whose seconds leap ahead lies in the future: the runtime holds for both.

    Args:
        now: our clock [s].
    """

    def __init__(self, now: Callable[[], float] = time.monotonic) -> None:
        self._now, self._offset, self._last, self._set, self._began = now, float("inf"), -float("inf"), 0.0, float("inf")

    def __call__(self, seconds: float) -> float:
        """When [s, time.monotonic] the device measured what it stamps with its own ``seconds``; one that stands still grows old."""
        now = self._now()
        self._began = min(self._began, now)
        drifted = DRIFT * (now - self._set)
        if now - self._began > SETTLING and seconds + self._offset - now > LEAP + drifted:
            return seconds + self._offset
        if seconds > self._last:
            self._offset = min(now - seconds, self._offset + drifted)
            self._last, self._set = seconds, now
        return min(seconds + self._offset, now)  # in this order what is not a number stays none


class Changes:
    """For a device that counts, but keeps no clock: a state is as old as its number.

    Args:
        now: our clock [s].
    """

    def __init__(self, now: Callable[[], float] = time.monotonic) -> None:
        self._now, self._since = now, 0.0
        self._last: object = None

    def __call__(self, number: object) -> float:
        """When [s, time.monotonic] this number was first seen."""
        if number != self._last:
            self._last, self._since = number, self._now()
        return self._since


def least_fresh(now: float, *stamps: float) -> float:
    """Of what one state is made of [s, on the clock of ``now``]: the stamp farthest from now, so that none from the past or the future is
    hidden."""
    return max(stamps, key=lambda stamp: float("inf") if stamp != stamp else abs(now - stamp))

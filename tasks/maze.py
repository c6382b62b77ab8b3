"""A maze of our own for the paper's second experiment, whose is not public: walls, and the way out.

A U of five cells of 3 m around a wall, whose last cell is open to the outside (x to the east, y to the north, the centre at 0):

    +-----------+
    | start ->  |
    +-----+     |
    |#####|  |  |
    +-----+  v  |
    <- out <-   |
    ------------+

The way is 12 m, so that an episode of 10 s, as long as the paper's, asks for a mean speed of 1.2 m/s from rest: ants run twice as fast,
but heavier ones have to be able to leave it as well.
"""

import math
from abc import ABC, abstractmethod

CELL = 3.0
"""Width [m] of the corridors; an ant's feet stand 2 m apart."""
WALL_HEIGHT, WALL_WIDTH = 1.0, 0.3
"""Of the walls [m]; that in the middle is a cell wide."""
EAST, NORTH = CELL, 1.5 * CELL
"""Distances [m] of the outer walls' inner faces from the centre."""
OUT_EAST, OUT_NORTH = EAST + WALL_WIDTH, NORTH + WALL_WIDTH
"""Distances [m] of their outer faces."""
WALLS: dict[str, tuple[float, float, float, float]] = {
    "north": (-OUT_EAST, OUT_EAST, NORTH, OUT_NORTH),
    "east": (EAST, OUT_EAST, -NORTH, NORTH),
    "south": (-OUT_EAST, OUT_EAST, -OUT_NORTH, -NORTH),
    "west": (-OUT_EAST, -EAST, -CELL / 2, NORTH),
    "middle": (-EAST, 0.0, -CELL / 2, CELL / 2),
}
"""Least and greatest x, least and greatest y [m] of each wall."""
START = (-1.0, CELL)
"""In the first cell [m], half a metre beyond its centre: an ant's legs are straight at first, and the longest ones behind it clear of
the wall."""


class Way(ABC):
    """A line to go along.

    Attributes:
        length: [m] from the start to where success is.
    """

    length: float

    @abstractmethod
    def coordinates(self, x: float, y: float) -> tuple[float, float]:
        """Arc length [m] from the start to the point of the line that is nearest to (x, y) [m], and how far to the left of it that is."""

    @abstractmethod
    def point(self, along: float) -> tuple[float, float]:
        """x and y [m] of the line at an arc length [m] from the start."""

    def direction(self, along: float) -> float:
        """Of the line at an arc length [m]: angle [rad] from east, counterclockwise."""
        (x, y), (u, v) = self.point(along - 1e-6), self.point(along + 1e-6)
        return math.atan2(v - y, u - x)


class WayOut(Way):
    """The maze's centre line: straight through cells, round corners about those of the wall in the middle; goes on outside."""

    _BEND = CELL / 2
    _QUARTER = math.pi / 2 * _BEND
    _FIRST, _SECOND, _THIRD = -START[0], CELL, OUT_EAST  # [m] of straight line, the last to the opening's outer face
    length = _FIRST + _SECOND + _THIRD + 2 * _QUARTER

    def coordinates(self, x: float, y: float) -> tuple[float, float]:
        """See Way."""
        bend, corner, southwards = self._BEND, self._FIRST + self._QUARTER, self._FIRST + self._QUARTER + self._SECOND
        if x < 0:
            return (self._FIRST + x, y - CELL) if y > 0 else (southwards + self._QUARTER - x, -y - CELL)
        if y > bend:
            return self._FIRST + bend * math.atan2(x, y - bend), math.hypot(x, y - bend) - bend
        if y >= -bend:
            return corner + bend - y, x - bend
        return southwards + bend * math.atan2(-(y + bend), x), math.hypot(x, y + bend) - bend

    def point(self, along: float) -> tuple[float, float]:
        """See Way."""
        bend = self._BEND
        if along < self._FIRST:
            return along - self._FIRST, CELL
        along -= self._FIRST
        if along < self._QUARTER:
            return bend * math.sin(along / bend), bend + bend * math.cos(along / bend)
        along -= self._QUARTER
        if along < self._SECOND:
            return bend, bend - along
        along -= self._SECOND
        if along < self._QUARTER:
            return bend * math.cos(along / bend), -bend - bend * math.sin(along / bend)
        return self._QUARTER - along, -CELL


class WayEast(Way):
    """From the same start to the east, on and on."""

    length = WayOut.length

    def coordinates(self, x: float, y: float) -> tuple[float, float]:
        """See Way."""
        return x - START[0], y - START[1]

    def point(self, along: float) -> tuple[float, float]:
        """See Way."""
        return START[0] + along, START[1]

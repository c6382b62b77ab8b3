"""Systems by name, one file each: the source and the commercial targets."""

from grippers.cards import discover
from robots.robot import Robot

ROBOTS: dict[str, Robot] = dict(
    sorted(discover(__name__, Robot).items(), key=lambda item: not item[1].source_of_policy)
)
"""The source first, then in alphabetical order. The source is ADROIT on a Kinova Gen3, the arm whose evolution tree to
jaco, kinova3 and iiwa is short."""

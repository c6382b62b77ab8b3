"""Systems by name, one file each: the source and the commercial targets."""

from grippers.cards import discover
from robots.model_robot import ModelRobot
from robots.robot import Robot

ROBOTS: dict[str, Robot] = dict(
    sorted(discover(__name__, Robot).items(), key=lambda item: not item[1].source_of_policy)
)
"""The source first, then in alphabetical order. The source is ADROIT on a Kinova Gen3, the arm whose evolution tree to
jaco, kinova3 and iiwa is short."""
MODEL_ROBOTS: dict[str, ModelRobot] = dict(
    sorted(discover(__name__, ModelRobot).items(), key=lambda item: not item[1].source_of_policy)
)
"""Robots that are changes of a model, family by family; the sources first."""

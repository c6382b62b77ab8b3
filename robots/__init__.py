"""Systems by name: the source and the commercial targets."""

from robots.adroit import ADROIT_ON_KINOVA3
from robots.iiwa import IIWA
from robots.jaco import JACO
from robots.kinova3 import KINOVA3
from robots.robot import Robot

ROBOTS: dict[str, Robot] = {robot.name: robot for robot in (ADROIT_ON_KINOVA3, JACO, KINOVA3, IIWA)}

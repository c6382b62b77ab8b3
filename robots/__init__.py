"""Systems by name: the source and the commercial targets."""

from robots.adroit import ADROIT_ON_KINOVA3
from robots.iiwa import IIWA
from robots.jaco import JACO
from robots.kinova3 import KINOVA3
from robots.panda import PANDA
from robots.robot import Robot
from robots.sawyer import SAWYER
from robots.ur5e import UR5E

ROBOTS: dict[str, Robot] = {
    robot.name: robot for robot in (ADROIT_ON_KINOVA3, JACO, KINOVA3, IIWA, PANDA, UR5E, SAWYER)
}
"""ADROIT on a Kinova Gen3: the source. The arm is the one whose evolution tree to the first three targets is short."""

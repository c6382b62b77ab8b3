"""KUKA LBR iiwa with a Robotiq 2F-140."""

from grippers.robotiq140 import ROBOTIQ140
from robots.robot import Robot

IIWA = Robot(
    name="iiwa",
    arm="IIWA",
    gripper=ROBOTIQ140,
    base_position=(-0.56, 0.0, 0.0),
    posture_seed=(0.0, 0.65, 0.0, -1.89, 0.0, 0.6, 0.0),
    datasheet="robosuite 1.5.1's model of the arm (masses, inertias, limits) on its RethinkMount",
)

"""Kinova Gen3 with a Robotiq 2F-85."""

from grippers.robotiq85 import ROBOTIQ85
from robots.robot import Robot

KINOVA3 = Robot(
    name="kinova3",
    arm="Kinova3",
    gripper=ROBOTIQ85,
    base_position=(-0.56, 0.0, 0.0),
    posture_seed=(0.0, 0.65, 0.0, 1.89, 0.0, 0.6, -1.5707963267948966),
    datasheet="robosuite 1.5.1's model of the arm (masses, inertias, limits) on its RethinkMount",
    # Kinova's URDF of the Gen3, 7 joints (ros2_kortex).
    joint_speeds=(1.396, 1.396, 1.396, 1.396, 1.222, 1.222, 1.222),
)

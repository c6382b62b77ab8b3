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
    # 80 and 70 degrees/s: Kinova, ros2_kortex, kortex_description/arms/gen3/7dof/urdf/gen3_macro.xacro.
    joint_speeds=(1.396, 1.396, 1.396, 1.396, 1.2217, 1.2217, 1.2217),
)

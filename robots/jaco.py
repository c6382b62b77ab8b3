"""Kinova Jaco (7 joints, spherical wrist) with its three-finger hand."""

from grippers.jaco3 import JACO3
from robots.robot import Robot

JACO = Robot(
    name="jaco",
    arm="Jaco",
    gripper=JACO3,
    base_position=(-0.56, 0.0, 0.0),
    posture_seed=(3.192, 3.680, 0.0, 1.170, 0.050, 3.760, 3.142),
    datasheet="robosuite 1.5.1's model of the arm (masses, inertias, limits) on its RethinkMount",
    # 36 degrees/s of the large actuators, 48 of the small ones: Kinova, kinova-ros,
    # kinova_description/urdf/j2s7s300.xacro, joint_1_velocity_limit to joint_7_velocity_limit.
    joint_speeds=(0.628, 0.628, 0.628, 0.628, 0.837, 0.837, 0.837),
)

"""Franka Emika Panda with its own hand."""

from grippers.panda_gripper import PANDA_GRIPPER
from robots.robot import Robot

PANDA = Robot(
    name="panda",
    arm="Panda",
    gripper=PANDA_GRIPPER,
    base_position=(-0.56, 0.0, 0.0),
    posture_seed=(0.0, 0.1963495408, 0.0, -2.6179938780, 0.0, 2.9415926536, 0.7853981634),
    datasheet="robosuite 1.5.1's model of the arm (masses, inertias, limits) on its RethinkMount",
    # Franka: libfranka, include/franka/rate_limiting.h, kMaxJointVelocity before its allowance for lost packets; the control
    # interface aborts faster motions.
    joint_speeds=(2.175, 2.175, 2.175, 2.175, 2.610, 2.610, 2.610),
)

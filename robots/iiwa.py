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
    # 98 98 100 130 140 180 180 degrees/s: KUKA, specification of the LBR iiwa 7 R800, as in lbr_fri_ros2_stack,
    # lbr_description/urdf/iiwa7/joint_limits.yaml (the LBR iiwa 14 R820 is slower).
    joint_speeds=(1.710, 1.710, 1.745, 2.268, 2.443, 3.141, 3.141),
)

"""Universal Robots UR5e (six joints) with a Robotiq 2F-85."""

from grippers.robotiq85 import ROBOTIQ85
from robots.robot import Robot

UR5E = Robot(
    name="ur5e",
    arm="UR5e",
    gripper=ROBOTIQ85,
    base_position=(-0.56, 0.0, 0.0),
    posture_seed=(-0.470, -1.735, 2.480, -2.275, -1.590, -1.991),
    datasheet="robosuite 1.5.1's model of the arm (masses, inertias, limits) on its RethinkMount",
    # 180 degrees/s: Universal Robots, UR5e User Manual 5.8, as in their ur_description, config/ur5e/joint_limits.yaml.
    joint_speeds=(3.141, 3.141, 3.141, 3.141, 3.141, 3.141),
)

"""ADROIT on a Kinova Gen3: the source. The arm is the one whose evolution tree to the three targets is short."""

from grippers.adroit import ADROIT
from robots.robot import Robot

ADROIT_ON_KINOVA3 = Robot(
    name="adroit",
    arm="Kinova3",
    gripper=ADROIT,
    base_position=(-0.56, 0.0, 0.0),
    posture_seed=(0.0, 0.65, 0.0, 1.89, 0.0, 0.6, -1.5707963267948966),
    source_of_policy=True,
    datasheet="robosuite 1.5.1's model of the arm (masses, inertias, limits) on its RethinkMount",
)

"""Rethink Robotics Sawyer with its electric gripper.

Two of the meshes that robosuite 1.5.1 ships for Sawyer's head (head_1, head_4) enclose no volume, and MuJoCo refuses to
derive an inertia from them. They are pictures only, so the class below, robosuite's own in every other respect, tells
the compiler to take them as thin shells.
"""

from robosuite.models.robots import Sawyer
from robosuite.robots import register_robot_class

from grippers.rethink import RETHINK
from robots.robot import Robot

FLAT_MESHES = ("head_1", "head_4")
"""Visual meshes of the head without volume."""
STUCK = 80.0
"""Friction [N m] on joint 1: its motor's limit. robosuite 1.5.1's shapes link0_collision and base_col touch in every
posture, and the contact holds the joint against all that its motor gives (it creeps by 2e-6 rad/s per N m). So robosuite's
Sawyer plays with six joints; the real one need not."""


@register_robot_class("FixedBaseRobot")
class MendedSawyer(Sawyer):
    """robosuite's Sawyer with its two flat meshes taken as shells, in memory."""

    def __init__(self, idn: int | str = 0) -> None:
        super().__init__(idn=idn)
        for mesh in self.asset.findall("mesh"):
            if mesh.get("name", "").removeprefix(self.naming_prefix) in FLAT_MESHES:
                mesh.set("inertia", "shell")


SAWYER = Robot(
    name="sawyer",
    arm="MendedSawyer",
    gripper=RETHINK,
    base_position=(-0.56, 0.0, 0.0),
    posture_seed=(0.0, -1.18, 0.0, 2.18, 0.0, 0.57, -1.57),
    arm_friction={"right_j0": STUCK},
    datasheet="robosuite 1.5.1's model of the arm (masses, inertias, limits) on its RethinkMount",
    # Rethink: sawyer_robot, sawyer_description/urdf/sawyer_base.urdf.xacro.
    joint_speeds=(1.74, 1.328, 1.957, 1.957, 3.485, 3.485, 4.545),
)

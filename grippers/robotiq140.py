"""Robotiq 2F-140: the long-stroke sibling of the 2F-85."""

from grippers.gripper import Gripper

ROBOTIQ140 = Gripper(
    name="robotiq140",
    robosuite_type="Robotiq140Gripper",
    joints={
        "FFJ2": "right_outer_knuckle_joint", "FFJ1": "right_inner_finger_joint", "FFK": "right_inner_knuckle_joint",
        "THJ4": "finger_joint", "THJ1": "left_inner_finger_joint", "THK": "left_inner_knuckle_joint",
    },
    targets={"FFJ2": (0.0, -0.7), "THJ4": (0.0, 0.7)},
    rate=0.2,
    preshape=-1.0,
    four_bar=True,
    source="robosuite 1.5.1: robotiq_gripper_140.xml (ctrlrange), Robotiq140Gripper.speed",
)

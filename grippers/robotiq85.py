"""Robotiq 2F-85: two jaws on four-bar linkages."""

from grippers.gripper import Gripper

ROBOTIQ85 = Gripper(
    name="robotiq85",
    robosuite_type="Robotiq85Gripper",
    joints={
        "FFJ2": "right_outer_knuckle_joint", "FFJ1": "right_inner_finger_joint", "FFK": "right_inner_knuckle_joint",
        "THJ4": "finger_joint", "THJ1": "left_inner_finger_joint", "THK": "left_inner_knuckle_joint",
    },
    targets={"FFJ2": (0.0, 0.8), "THJ4": (0.0, 0.8)},
    rate=0.2,
    preshape=-1.0,
    four_bar=True,
    source="robosuite 1.5.1: robotiq_gripper_85.xml (ctrlrange), Robotiq85Gripper.speed",
)

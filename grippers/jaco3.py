"""Kinova's three-finger hand: a thumb against two fingers, each with a spring-coupled distal joint."""

from grippers.gripper import Gripper

JACO3 = Gripper(
    name="jaco3",
    robosuite_type="JacoThreeFingerGripper",
    joints={
        "FFJ2": "joint_index", "FFJ1": "joint_index_distal",
        "RFJ2": "joint_pinky", "RFJ1": "joint_pinky_distal",
        "THJ4": "joint_thumb", "THJ1": "joint_thumb_distal",
    },
    targets={"FFJ2": (1.51, 0.0), "RFJ2": (1.51, 0.0), "THJ4": (1.51, 0.0)},
    rate=0.01,
    preshape=-0.45,
    grasp_offset=0.014,
    source="robosuite 1.5.1: jaco_three_finger_gripper.xml (ctrlrange; 0 is closed), JacoThreeFingerGripper.speed",
    notes="robosuite closes it by 0.01 a step; the preshape leaves the object a finger's breadth on either side; "
          "its two fingers come before the thumb and press twice as hard, so that a box of 5 cm lies 11 mm towards the thumb once that "
          "touches it, and 19 mm when it is carried: grasp_offset is between",
)

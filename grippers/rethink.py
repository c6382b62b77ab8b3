"""Rethink Robotics' electric parallel gripper with its narrow fingers: two jaws on slides."""

from grippers.gripper import Gripper

RETHINK = Gripper(
    name="rethink",
    robosuite_type="RethinkGripper",
    joints={"FFS": "l_finger_joint", "THS": "r_finger_joint"},
    targets={"FFS": (0.0115, -0.020833), "THS": (-0.0115, 0.020833)},
    rate=0.2,
    preshape=-1.0,
    welded={"FFJ1": "l_finger_tip", "THJ1": "r_finger_tip"},
    source="robosuite 1.5.1: rethink_gripper.xml (ctrlrange), RethinkGripper.speed",
)

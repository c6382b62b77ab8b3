"""Franka's Panda hand: two parallel jaws on slides."""

from grippers.gripper import Gripper

PANDA_GRIPPER = Gripper(
    name="panda_gripper",
    robosuite_type="PandaGripper",
    joints={"FFS": "finger_joint1", "THS": "finger_joint2"},
    targets={"FFS": (0.04, 0.0), "THS": (-0.04, 0.0)},
    rate=0.2,
    preshape=-1.0,
    welded={"FFJ1": "finger_joint1_tip", "THJ1": "finger_joint2_tip"},
    source="robosuite 1.5.1: panda_gripper.xml (ctrlrange), PandaGripper.speed",
)

"""An arm of seven joints, what cameras see before it, and commands to it."""

import time

import numpy as np

from toolkit.deploy.arm import Command
from toolkit.deploy.kinematics import quaternion_of, rotation_of

JOINTS = tuple(f"joint_{i}" for i in range(1, 8))
ANGLES = np.array([0.1, -0.2, 0.3, -1.4, 0.5, 1.6, -0.7])


def scene():
    return np.array([-0.1, 0.0, 0.82]), np.array([1.0, 0, 0, 0]), np.array([-0.1, 0.1, 1.02]), time.monotonic()


def joint_command(hold=False, count=25, joints=ANGLES):
    rows = np.linspace(joints - 0.01, joints, count)
    rate = np.zeros(len(joints)) if hold else np.full(len(joints), 0.2)
    return Command("joint", hold, joints.copy(), rate, 0.0 if hold else 1.0, 0.25, 0.02, rows)


def pose_command():
    quaternion = quaternion_of(rotation_of(np.array([0.3, -0.2, 2.5])))
    pose = np.append([0.4, 0.1, 0.2], quaternion)
    return Command("pose", False, pose, np.array([0.1, 0, 0, 0, 0, 0.2]), 1.0, 0.25, 0.02, np.repeat(pose[None], 25, axis=0))

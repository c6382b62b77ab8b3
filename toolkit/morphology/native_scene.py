"""A compiled robosuite scene, read: which bodies are the robot's, their plain names, and the digest of how it moves."""

import hashlib
import json

import mujoco
import numpy as np

from toolkit.morphology.posture import GRIPPER_PREFIX

PREFIXES = ("robot0_", GRIPPER_PREFIX, "fixed_mount0_")
"""Of the robot's bodies in a robosuite scene; left out of the names in robot.xml."""


def robot_bodies(model: mujoco.MjModel) -> list[int]:
    """Ids of the robot's bodies in a robosuite scene, parents first."""
    return [b for b in range(1, model.nbody) if model.body(b).name.startswith(PREFIXES)]


def plain_name(name: str) -> str:
    """A body's, joint's or geom's name without robosuite's prefix."""
    for prefix in PREFIXES:
        name = name.removeprefix(prefix)
    return name


def model_sha256(model: mujoco.MjModel) -> str:
    """Digest of what makes the robot move as it does: frames, masses, joints, motors; to nine digits.

    The scene around it does not count.
    """
    bodies = robot_bodies(model)
    joints = [j for j in range(model.njnt) if model.jnt_bodyid[j] in bodies]
    dofs = model.jnt_dofadr[joints]
    motors = [a for a in range(model.nu) if model.actuator_trnid[a, 0] in joints]
    numbers = {
        **{key: getattr(model, f"body_{key}")[bodies] for key in ("pos", "quat", "ipos", "iquat", "mass", "inertia")},
        **{f"joint_{key}": getattr(model, f"jnt_{key}")[joints] for key in ("pos", "axis", "range", "stiffness")},
        **{f"dof_{key}": getattr(model, f"dof_{key}")[dofs] for key in ("armature", "damping", "frictionloss")},
        **{f"motor_{key}": getattr(model, f"actuator_{key}")[motors] for key in ("gear", "ctrlrange", "gainprm", "biasprm")},
        "timestep": np.array([model.opt.timestep]),
    }
    names = [model.body(b).name for b in bodies] + [model.joint(j).name for j in joints]
    text = json.dumps([names, {key: [f"{v:.8e}" for v in np.ravel(value) + 0.0] for key, value in numbers.items()}])
    return hashlib.sha256(text.encode()).hexdigest()

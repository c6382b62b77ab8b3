"""A compiled robosuite scene of an arm with its gripper, read: what is whose, where it stands in the arrays, how it moves."""

import hashlib
import json
from collections.abc import Mapping

import mujoco
import numpy as np

from robots.robot import Robot
from toolkit.errors import ToolkitError

ARM_PREFIX, GRIPPER_PREFIX = "robot0_", "gripper0_right_"
GRIP_SITE, BASE_SITE = GRIPPER_PREFIX + "grip_site", ARM_PREFIX + "right_center"
"""The grasp frame, and the frame that OSC commands refer to."""
PREFIXES = (ARM_PREFIX, GRIPPER_PREFIX, "fixed_mount0_")
"""Of the robot's bodies in a robosuite scene; left out of the names in robot.xml."""


class NativeScene:
    """Ids and addresses of a robot's parts in its scene.

    Args:
        model: of a robosuite scene.

    Attributes:
        arm: (n,) ids of the arm's joints, base to flange.  arm_qpos, arm_dofs: (n,) their addresses.
        fingers: (m,) ids of the gripper's joints.  finger_qpos: (m,) their addresses.
        arm_names, finger_names: (n,), (m,) of the joints, without robosuite's prefixes.
    """

    def __init__(self, model: mujoco.MjModel) -> None:
        self.model = model
        names = [model.joint(j).name for j in range(model.njnt)]
        self.arm = [j for j, name in enumerate(names) if name.startswith(ARM_PREFIX)]
        self.fingers = [j for j, name in enumerate(names) if name.startswith(GRIPPER_PREFIX)]
        self.arm_qpos, self.arm_dofs = model.jnt_qposadr[self.arm], model.jnt_dofadr[self.arm]
        self.finger_qpos = model.jnt_qposadr[self.fingers]
        self.arm_names = tuple(plain_name(names[j]) for j in self.arm)
        self.finger_names = tuple(plain_name(names[j]) for j in self.fingers)

    @property
    def grip_site(self) -> int:
        """Id of the grasp frame."""
        return int(self.model.site(GRIP_SITE).id)

    @property
    def arm_actuators(self) -> list[int]:
        """(n,) ids of the arm's motors."""
        by_joint = actuator_by_joint(self.model)
        return [by_joint[joint] for joint in self.arm]

    @property
    def object_joint(self) -> int:
        """Id of the free joint of what is picked."""
        return next(j for j in range(self.model.njnt) if self.model.jnt_type[j] == mujoco.mjtJoint.mjJNT_FREE)

    @property
    def base(self) -> int:
        """Id of the body that the arm's first joint turns against."""
        return int(self.model.body_parentid[self.model.jnt_bodyid[self.arm[0]]])

    @property
    def hand(self) -> int:
        """Id of the gripper's first body."""
        return next(b for b in range(self.model.nbody) if self.model.body(b).name.startswith(GRIPPER_PREFIX))

    @property
    def flange(self) -> int:
        """Id of the body on which the gripper's bodies hang."""
        return int(self.model.body_parentid[self.hand])

    def osc_base(self, data: mujoco.MjData) -> tuple[bool, np.ndarray, np.ndarray, np.ndarray]:
        """Whether the frame that OSC commands refer to turns with the arm's first joint, that joint's axis (3,) and anchor (3,) [m], and
        the frame's origin (3,) [m]; of data whose frames are computed, world."""
        first, site = self.arm[0], self.model.site(BASE_SITE).id
        follows = bool(self.model.body_jntadr[self.model.site_bodyid[site]] == first)
        return follows, np.array(data.xaxis[first]), np.array(data.xanchor[first]), np.array(data.site_xpos[site])


def actuator_by_joint(model: mujoco.MjModel) -> dict[int, int]:
    """Id of a joint -> id of the actuator that drives it."""
    return {int(model.actuator_trnid[a, 0]): a for a in range(model.nu)}


def role_joints(model: mujoco.MjModel, robot: Robot) -> dict[str, int]:
    """Role -> id of the joint that plays it.

    Raises:
        ToolkitError: the gripper's model has no joint of the declared name.
    """
    known = {name: j for j in range(model.njnt) if (name := _gripper_name(model.joint(j).name))}
    return _declared(robot, robot.gripper.joints, known, "names joint", "lacks")


def welded_bodies(model: mujoco.MjModel, robot: Robot) -> dict[str, int]:
    """Role -> id of the body that plays it without a joint of its own.

    Raises:
        ToolkitError: the gripper's model has no body of the declared name, or the body has a joint.
    """
    known = {name: b for b in range(model.nbody) if not model.body_jntnum[b] and (name := _gripper_name(model.body(b).name))}
    return _declared(robot, robot.gripper.welded, known, "is welded to body", "has not without joints")


def _gripper_name(name: str) -> str:
    """What the gripper's own model calls a part; empty for parts of anything else."""
    return name.removeprefix(GRIPPER_PREFIX) if name.startswith(GRIPPER_PREFIX) else ""


def _declared(robot: Robot, roles: Mapping[str, str], known: Mapping[str, int], says: str, lacks: str) -> dict[str, int]:
    """Role -> id, of the parts that a card names for ``roles`` among those ``known`` to the gripper's model."""
    for role, name in roles.items():
        if name not in known:
            raise ToolkitError(f"gripper {robot.gripper.name}: role {role} {says} {name!r}, which its model {lacks}; "
                               f"it has {', '.join(known)}")
    return {role: known[name] for role, name in roles.items()}


def role_actuators(model: mujoco.MjModel, robot: Robot) -> dict[str, int]:
    """Role -> id of the actuator on that role's joint, for the roles that have a target."""
    by_joint, joints = actuator_by_joint(model), role_joints(model, robot)
    missing = [role for role in robot.gripper.targets if joints[role] not in by_joint]
    if missing:
        raise ToolkitError(
            f"gripper {robot.gripper.name}: role {missing[0]} has a target, but joint "
            f"{robot.gripper.joints[missing[0]]!r} has no actuator; name the driven joint's role"
        )
    return {role: by_joint[joints[role]] for role in robot.gripper.targets}


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

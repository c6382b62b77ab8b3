"""Start postures: every robot's grasp frame begins an episode at the same pose over the table (solved with mink)."""

from functools import lru_cache

import mink
import mujoco
import numpy as np

from robots.robot import Robot
from tasks.env import Pick, Start
from tasks.pick import START_POSITION, START_ROTATION, PickTask
from toolkit.errors import ToolkitError
from toolkit.morphology.validation import compiler_complaint, require_valid

GRIPPER_PREFIX = "gripper0_right_"
GRIP_SITE = GRIPPER_PREFIX + "grip_site"
SETTLING_TIME = 2.0
"""Time [s] that a gripper is given to come to rest at its preshape."""


def arm_joints(model: mujoco.MjModel) -> list[int]:
    """Ids of the arm's joints in a robosuite scene, in order from base to flange."""
    return [j for j in range(model.njnt) if model.joint(j).name.startswith("robot0_")]


def role_joints(model: mujoco.MjModel, robot: Robot) -> dict[str, int]:
    """Role -> id of the joint that plays it.

    Raises:
        ToolkitError: the gripper's model has no joint of the declared name.
    """
    out = {}
    for role, name in robot.gripper.joints.items():
        joint = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_JOINT, GRIPPER_PREFIX + name)
        if joint < 0:
            known = [model.joint(j).name.removeprefix(GRIPPER_PREFIX) for j in range(model.njnt)
                     if model.joint(j).name.startswith(GRIPPER_PREFIX)]
            raise ToolkitError(
                f"gripper {robot.gripper.name}: role {role} names joint {name!r}, which its model lacks; "
                f"it has {', '.join(known)}"
            )
        out[role] = joint
    return out


def welded_bodies(model: mujoco.MjModel, robot: Robot) -> dict[str, int]:
    """Role -> id of the body that plays it without a joint of its own.

    Raises:
        ToolkitError: the gripper's model has no body of the declared name, or the body has a joint.
    """
    out = {}
    for role, name in robot.gripper.welded.items():
        body = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, GRIPPER_PREFIX + name)
        if body < 0 or model.body_jntnum[body]:
            known = [model.body(b).name.removeprefix(GRIPPER_PREFIX) for b in range(model.nbody)
                     if model.body(b).name.startswith(GRIPPER_PREFIX) and not model.body_jntnum[b]]
            raise ToolkitError(
                f"gripper {robot.gripper.name}: role {role} is welded to body {name!r}, which its model has not without "
                f"joints; it has {', '.join(known)}"
            )
        out[role] = body
    return out


def role_actuators(model: mujoco.MjModel, robot: Robot) -> dict[str, int]:
    """Role -> id of the actuator on that role's joint, for the roles that have a target."""
    by_joint = {int(model.actuator_trnid[a, 0]): a for a in range(model.nu)}
    joints = role_joints(model, robot)
    missing = [role for role in robot.gripper.targets if joints[role] not in by_joint]
    if missing:
        raise ToolkitError(
            f"gripper {robot.gripper.name}: role {missing[0]} has a target, but joint "
            f"{robot.gripper.joints[missing[0]]!r} has no actuator; name the driven joint's role"
        )
    return {role: by_joint[joints[role]] for role in robot.gripper.targets}


def target_at(robot: Robot, role: str, command: float) -> float:
    """Position target [rad] of a role's actuator at a closing command in [-1, 1]."""
    opened, closed = robot.gripper.targets[role]
    return opened + 0.5 * (command + 1.0) * (closed - opened)


def solve_arm(model: mujoco.MjModel, qpos: np.ndarray, position: np.ndarray, name: str) -> np.ndarray:
    """Full configuration (nq,) at which the grasp frame stands at ``position`` [m] with START_ROTATION.

    Differential inverse kinematics (mink) from ``qpos``; only the arm moves.

    Raises:
        ToolkitError: the pose cannot be reached within the joint limits.
    """
    dofs = model.jnt_dofadr[arm_joints(model)]
    configuration = mink.Configuration(model, q=qpos)
    frame = mink.FrameTask(GRIP_SITE, "site", position_cost=1.0, orientation_cost=1.0, lm_damping=1e-9)
    rotation = mink.SO3.from_matrix(START_ROTATION)
    frame.set_target(mink.SE3.from_rotation_and_translation(rotation, position))
    limits = [mink.ConfigurationLimit(model)]
    for _ in range(400):
        error = frame.compute_error(configuration)
        if np.abs(error).max() < 1e-11:
            return np.array(configuration.q)
        velocity = mink.solve_ik(configuration, [frame], 1.0, "daqp", damping=1e-9, limits=limits)
        step = np.zeros(model.nv)
        step[dofs] = np.clip(velocity[dofs], -0.3, 0.3)
        configuration.integrate_inplace(step, 1.0)
    raise ToolkitError(
        f"robot {name}: its grasp frame cannot reach {np.round(position, 3).tolist()} m from base_position; "
        f"{np.abs(error).max():.2e} m or rad are left; move base_position or change posture_seed"
    )


def _settle_gripper(model: mujoco.MjModel, qpos: np.ndarray, robot: Robot) -> tuple[np.ndarray, np.ndarray]:
    """Configuration and control after the gripper has come to rest at its preshape with the arm held still."""
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    free = [j for j in range(model.njnt) if model.jnt_type[j] == mujoco.mjtJoint.mjJNT_FREE]
    arm = arm_joints(model)
    arm_q, arm_v = model.jnt_qposadr[arm], model.jnt_dofadr[arm]
    for role, actuator in role_actuators(model, robot).items():
        data.ctrl[actuator] = target_at(robot, role, robot.gripper.preshape)
    for _ in range(int(SETTLING_TIME / model.opt.timestep)):
        for joint in free:  # the object waits out of reach
            data.qpos[model.jnt_qposadr[joint] : model.jnt_qposadr[joint] + 3] = (3.0, 3.0, 3.0)
        data.qpos[arm_q], data.qvel[arm_v] = qpos[arm_q], 0.0
        mujoco.mj_step(model, data)
    data.qpos[arm_q] = qpos[arm_q]
    return np.array(data.qpos), np.array(data.ctrl)


def _nominal_task() -> PickTask:
    from tasks import TASKS

    return TASKS["061_foam_brick"]


@lru_cache(maxsize=32)
def start_of(robot: Robot) -> Start:
    """The robot's start: arm posture by inverse kinematics, gripper settled at its preshape.

    Raises:
        ToolkitError: something is wrong with the card or its models, or the robot cannot reach the start.
    """
    require_valid(robot)
    try:
        env = Pick(robot, _nominal_task(), Start(arm=np.array(robot.posture_seed)))
    except ValueError as error:
        raise compiler_complaint(robot, error) from error
    model, data = env.sim.model._model, env.sim.data._data
    qpos = solve_arm(model, np.array(data.qpos), START_POSITION, robot.name)
    qpos, ctrl = _settle_gripper(model, qpos, robot)
    qpos = solve_arm(model, qpos, START_POSITION, robot.name)
    joints = env.robots[0]._ref_gripper_joint_pos_indexes["right"]
    command = None
    if robot.gripper.rate is not None:
        ids = np.array(env.robots[0]._ref_joint_gripper_actuator_indexes["right"])
        low, high = model.actuator_ctrlrange[ids].T
        command = (ctrl[ids] - 0.5 * (high + low)) / (0.5 * (high - low))
    return Start(arm=qpos[model.jnt_qposadr[arm_joints(model)]], fingers=qpos[joints], command=command)


def native_env(robot: Robot, task: PickTask) -> Pick:
    """The unmodified robosuite robot in the task, starting where it should."""
    return Pick(robot, task, start_of(robot))

"""Start postures: every robot's grasp frame begins an episode at the same pose over the table (solved with mink)."""

from functools import lru_cache

import mink
import mujoco
import numpy as np

from robots.robot import Robot
from tasks.env import Pick, Start
from tasks.objects import OBJECTS
from tasks.pick import START_POSITION, START_ROTATION, PickTask
from toolkit.errors import ToolkitError
from toolkit.morphology.native_scene import GRIP_SITE, NativeScene, role_actuators
from toolkit.morphology.validation import compiler_complaint, require_valid

SETTLING_TIME = 2.0
"""Time [s] that a gripper is given to come to rest at its preshape."""
NOMINAL_TASK = PickTask(OBJECTS["061_foam_brick"])
"""In whose scene robots are read; start postures are alike in all."""


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
    dofs = NativeScene(model).arm_dofs
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
    scene = NativeScene(model)
    arm_q, arm_v, item = scene.arm_qpos, scene.arm_dofs, int(model.jnt_qposadr[scene.object_joint])
    for role, actuator in role_actuators(model, robot).items():
        data.ctrl[actuator] = target_at(robot, role, robot.gripper.preshape)
    for _ in range(int(SETTLING_TIME / model.opt.timestep)):
        data.qpos[item : item + 3] = (3.0, 3.0, 3.0)  # the object waits out of reach
        data.qpos[arm_q], data.qvel[arm_v] = qpos[arm_q], 0.0
        mujoco.mj_step(model, data)
    data.qpos[arm_q] = qpos[arm_q]
    return np.array(data.qpos), np.array(data.ctrl)


@lru_cache(maxsize=32)
def start_of(robot: Robot) -> Start:
    """The robot's start: arm posture by inverse kinematics, gripper settled at its preshape.

    Raises:
        ToolkitError: something is wrong with the card or its models, or the robot cannot reach the start.
    """
    require_valid(robot)
    try:
        env = Pick(robot, NOMINAL_TASK, Start(arm=np.array(robot.posture_seed)))
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
    return Start(arm=qpos[NativeScene(model).arm_qpos], fingers=qpos[joints], command=command)


def native_env(robot: Robot, task: PickTask) -> Pick:
    """The unmodified robosuite robot in the task, starting where it should."""
    return Pick(robot, task, start_of(robot))

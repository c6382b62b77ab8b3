"""What a bundle says about its robot, measured on the unmodified robosuite robot: ranges, response, gripper.

The policy plays the robot; its robot answers single deltas; its empty gripper closes.
"""

import copy
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import mujoco
import numpy as np
from numpy.typing import ArrayLike

from grippers.gripper import COMMANDED_ROLES, DIGIT_OF
from robots.robot import Robot
from tasks.pick import START_ROTATION
from toolkit.bundle.manifest import Gripper, Response, Vector
from toolkit.evaluation.stress import GOOD
from toolkit.learning.policy import GaussianPolicy, MeanActor
from toolkit.morphology.native_scene import NativeScene, role_actuators, role_joints
from toolkit.simulation.osc import POSITION_SCALE, ROTATION_SCALE
from toolkit.simulation.plant import CLOSING, Plant
from toolkit.simulation.rollout import play, play_on
from toolkit.simulation.watching import States

RESPONSE_STEPS, RESPONSE_AMPLITUDE = 12, 0.5
"""Policy steps over which an impulse is followed, and its action; beyond, the arm's posture pulls it back."""
GRIPPER_COMMANDS, GRIPPER_TIME = 21, 1.0
"""Closing commands at which the empty gripper is measured, and the time [s] it is given at each."""
BRUSHING = 0.002
"""Height [m] over the table from which down a gripper counts as brushing it."""
CLAMP = 1e6
"""Armature [kg m^2] and damping [N m s/rad] that hold the arm still while the gripper moves."""


def rotation_vector(rotation: np.ndarray) -> np.ndarray:
    """Rotation vector (3,) [rad] of a rotation matrix (3, 3)."""
    quaternion, out = np.empty(4), np.empty(3)
    mujoco.mju_mat2Quat(quaternion, np.ascontiguousarray(rotation).ravel())
    mujoco.mju_quat2Vel(out, quaternion, 1.0)
    return out


def grasp_coordinates(plant: Plant) -> np.ndarray:
    """(6,) origin [m] of the grasp frame and its rotation vector [rad] from the start rotation, in the task frame."""
    site = NativeScene(plant.model).grip_site
    return np.append(plant.data.site_xpos[site], rotation_vector(plant.data.site_xmat[site].reshape(3, 3) @ START_ROTATION.T))


# ---- episodes --------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Played:
    """What episodes on the native robot looked like; lists hold one array per episode.

    Attributes:
        observations: (T, n_obs).  actions: (T, n_act) of the record.
        qpos: (T + 1, nq).  speeds, efforts: (T, n_arm) [rad/s, N m] at the end of each step.
        grasp: (T + 1, 6) grasp_coordinates.  heights: (T + 1,) height [m] of the gripper's lowest shape above the table.
        success: share of successful episodes.
    """

    observations: list[np.ndarray]
    actions: list[np.ndarray]
    qpos: list[np.ndarray]
    speeds: list[np.ndarray]
    efforts: list[np.ndarray]
    grasp: list[np.ndarray]
    heights: list[np.ndarray]
    success: float


class _Motion(States):
    """Keeps, besides configurations, as many rows of (arm speeds [rad/s], arm torques [N m], grasp_coordinates)."""

    def __init__(self, model: mujoco.MjModel) -> None:
        super().__init__()
        self._scene = NativeScene(model)
        self._motors = self._scene.arm_actuators
        self.rows: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []

    def begun(self, plant: Plant) -> None:
        super().begun(plant)
        self.rows.append((plant.data.qvel[self._scene.arm_dofs].copy(), plant.data.ctrl[self._motors].copy(), grasp_coordinates(plant)))

    acted = begun


def watch(
    plant: Plant, policy: GaussianPolicy, seeds: list[int], noisy: bool, lowest: Callable[[np.ndarray], float], delay: int = 0
) -> Played:
    """Play episodes and keep what the manifest needs.

    Args:
        plant: the native robot.
        policy: who plays.
        seeds: of the episodes.
        noisy: with the exploration noise of training.
        lowest: height [m] of the gripper's lowest point at a configuration (nq,).
        delay: policy steps by which what the policy sees is late.
    """
    actor = policy.act if noisy else MeanActor(policy)
    out, succeeded = Played([], [], [], [], [], [], [], 0.0), 0
    for seed in seeds:
        motion, waiting = _Motion(plant.model), deque[np.ndarray](maxlen=delay + 1)

        def late(observation: np.ndarray, rng: np.random.Generator, waiting: deque = waiting) -> np.ndarray:
            waiting.append(observation.copy())
            return actor(waiting[0], rng)

        episode = play(plant, late, seed, np.zeros(0), motion)
        speeds, efforts, grasp = (np.array(column) for column in zip(*motion.rows, strict=True))
        succeeded += episode.success
        for kept, value in (
            (out.observations, episode.observations), (out.actions, episode.actions), (out.qpos, np.array(motion.qpos)),
            (out.speeds, speeds[1:]), (out.efforts, efforts[1:]), (out.grasp, grasp),
            (out.heights, np.array([lowest(row) for row in motion.qpos])),
        ):
            kept.append(value)
    return replace(out, success=succeeded / len(seeds))


def borne_start_error(plant: Plant, policy: GaussianPolicy, seeds: list[int], widths: Sequence[float]) -> float:
    """Largest uniform error [rad] of all arm joints at the start, of those tried, that the policy bears: with it, and with all smaller
    ones, at least GOOD of the episodes succeed; 0 if it does not bear the smallest.

    Args:
        plant: the native robot.
        policy: who plays, without noise.
        seeds: of the episodes.
        widths: half widths [rad] to try, rising.
    """
    arm, borne = NativeScene(plant.model).arm_qpos, 0.0
    for width in widths:
        failures = 0
        for seed in seeds:
            plant.begin(seed)
            plant.data.qpos[arm] += width * np.random.default_rng((seed, 1)).uniform(-1.0, 1.0, len(arm))
            mujoco.mj_forward(plant.model, plant.data)
            played = play_on(plant, MeanActor(policy), np.random.default_rng(seed), plant.observe(),
                             plant.task.horizon)
            failures += not played.success
            if failures > (1.0 - GOOD) * len(seeds):
                return borne
        borne = width
    return borne


def borne_delays(calm: Played, late: Callable[[int], Played], longest: int) -> list[Played]:
    """Undisturbed episodes, then those in which all that is seen is one policy step late, two, and so on, as long as at least GOOD of them
    succeed and the gripper stays off the table, or where it brushes it undisturbed: what comes late comes down on it with its whole speed.

    Args:
        calm: undisturbed.
        late: delay -> the same episodes, late.
        longest: delay to try.
    """
    out, floor = [calm], min(0.0, min(map(np.min, calm.heights)) - BRUSHING)
    for delay in range(1, longest + 1):
        played = late(delay)
        if played.success < GOOD or min(map(np.min, played.heights)) < floor:
            break
        out.append(played)
    return out


def largest_step(rows: list[np.ndarray]) -> np.ndarray:
    """Largest change (n,) between consecutive rows of the episodes' (T, n) arrays."""
    return np.max([np.abs(np.diff(episode, axis=0)).max(axis=0, initial=0.0) for episode in rows], axis=0)


def record_episode(plant: Plant, robot: Robot, policy: GaussianPolicy, seed: int) -> tuple[dict[str, np.ndarray], bool]:
    """A closed-loop episode as an arm and cameras would report it, one row per tick, and whether it succeeded.

    Arrays: episode_joints (T, n), episode_fingers (T, m) [rad], episode_object_position (T, 3), episode_object_quaternion (T, 4),
    episode_goal (3,), episode_command (T,) the closing command, episode_observations (T, n_obs).
    """
    model, data, item, scene = plant.model, plant.data, plant.object_body, NativeScene(plant.model)
    arm, fingers = scene.arm_qpos, scene.finger_qpos
    rows: list[tuple] = []

    def seen(_: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        mujoco.mj_kinematics(model, data)  # after a step, MuJoCo's poses are a substep older than its angles
        observation = plant.observe()
        rows.append((data.qpos[arm].copy(), data.qpos[fingers].copy(), data.xpos[item].copy(), data.xquat[item].copy(),
                     plant.command[CLOSING].mean(), observation))
        return policy.mean(observation)

    episode = play(plant, seen, seed, np.zeros(0))
    names = ("joints", "fingers", "object_position", "object_quaternion", "command", "observations")
    arrays = {f"episode_{name}": np.array(column, float) for name, column in zip(names, zip(*rows, strict=True), strict=True)}
    return arrays | {"episode_goal": np.array(plant.goal, float)}, episode.success


# ---- the arm's answer ------------------------------------------------------------------------------------------------


def measure_response(plant: Plant) -> Response:
    """The impulse response of each axis: one delta from rest at the start, then none.

    Half an action is far from the joint torques' limits on every arm; a full one reaches them on weak wrists.
    """
    rows = []
    scale = np.repeat([POSITION_SCALE, ROTATION_SCALE], 3)
    for axis in range(6):
        plant.begin(0)
        before, row = grasp_coordinates(plant), []
        for step in range(RESPONSE_STEPS):
            action = np.zeros(6 + len(COMMANDED_ROLES))
            action[axis] = RESPONSE_AMPLITUDE if step == 0 else 0.0
            plant.step(action)
            after = grasp_coordinates(plant)
            row.append(float((after - before)[axis] / scale[axis] / RESPONSE_AMPLITUDE))
            before = after
        rows.append(tuple(row))
    return Response(tuple(rows), tuple(sum(row) for row in rows), RESPONSE_AMPLITUDE)


# ---- the gripper -----------------------------------------------------------------------------------------------------


def measure_gripper(robot: Robot, plant: Plant) -> Gripper:
    """Opening and joint angles of the empty gripper over its closing command, the arm held still."""
    model = copy.copy(plant.model)
    scene = NativeScene(model)
    model.dof_armature[scene.arm_dofs], model.dof_damping[scene.arm_dofs] = CLAMP, CLAMP
    data = mujoco.MjData(model)
    plant.begin(0)
    data.qpos[:] = plant.data.qpos
    item = int(model.jnt_qposadr[scene.object_joint])
    data.qpos[item : item + 3] = (3.0, 3.0, 1.0)
    joints, actuators = role_joints(model, robot), role_actuators(model, robot)
    outer = {side: _outermost(model, [joint for role, joint in joints.items() if DIGIT_OF[role].opposes == (side == "thumb")])
             for side in ("thumb", "fingers")}
    commands = np.linspace(-1.0, 1.0, GRIPPER_COMMANDS)
    openings, angles = [], []
    for command in commands:
        data.ctrl[[actuators[role] for role in robot.gripper.targets]] = plant.law.targets(np.full(len(COMMANDED_ROLES), command))
        mujoco.mj_step(model, data, int(GRIPPER_TIME / model.opt.timestep))
        mujoco.mj_forward(model, data)
        gaps = [mujoco.mj_geomDistance(model, data, a, b, 1.0, None) for a in outer["thumb"] for b in outer["fingers"]]
        openings.append(max(0.0, min(gaps)))
        angles.append(vector(data.qpos[scene.finger_qpos]))
    if robot.gripper.rate is None:
        raise ValueError(f"gripper {robot.gripper.name} is a hand, which has no rate")
    return Gripper(
        law="command = clip(command + rate * sign(action), -1, 1)", rate=float(robot.gripper.rate),
        preshape=float(robot.gripper.preshape), open_sign=-1, close_sign=1,
        targets={robot.gripper.joints[role]: tuple(map(float, pair)) for role, pair in robot.gripper.targets.items()},
        command=tuple(commands.tolist()), opening_m=tuple(np.minimum.accumulate(openings).tolist()),
        joints=scene.finger_names,
        joint_units=tuple("m" if model.jnt_type[j] == mujoco.mjtJoint.mjJNT_SLIDE else "rad" for j in scene.fingers),
        joint_positions=tuple(angles),
        fraction="opening_m / opening_m[0]: 1 open, 0 touching",
    )


def _outermost(model: mujoco.MjModel, joints: list[int]) -> list[int]:
    """Collision geoms of the links of these joints that carry no other of these joints."""
    bodies = {int(model.jnt_bodyid[joint]) for joint in joints}
    parents = {int(model.body_parentid[body]) for body in bodies}
    # An inner knuckle ends in no pad: of the last bodies, those with a primitive for a pad count, if there are any.
    geoms = [g for g in range(model.ngeom) if model.body_weldid[model.geom_bodyid[g]] in bodies - parents and model.geom_group[g] == 0]
    pads = [g for g in geoms if model.geom_type[g] != mujoco.mjtGeom.mjGEOM_MESH]
    return pads or geoms


# ---- the robot's model -----------------------------------------------------------------------------------------------


def vector(values: ArrayLike) -> Vector:
    """Numbers of any shape, one after another, as the manifest holds them."""
    return tuple(float(value) for value in np.ravel(values))

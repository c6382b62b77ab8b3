"""What a bundle says about its robot, measured on the unmodified robosuite robot: ranges, response, gripper, shapes.

The policy plays the robot; its robot answers single deltas; its empty gripper closes; its links become the robot.xml
that MuJoCo alone loads.
"""

import copy
import hashlib
import json
import xml.etree.ElementTree as ET
from collections.abc import Callable
from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial import ConvexHull, QhullError

from grippers.gripper import COMMANDED_ROLES
from robots.robot import Robot
from tasks.pick import START_ROTATION
from toolkit.bundle.manifest import Gripper, Response, Vector
from toolkit.deploy.kinematics import HULL
from toolkit.learning.policy import GaussianPolicy
from toolkit.morphology.posture import GRIP_SITE, GRIPPER_PREFIX, arm_joints, role_actuators, role_joints
from toolkit.simulation.osc import POSITION_SCALE, ROTATION_SCALE
from toolkit.simulation.plant import CLOSING, Plant
from toolkit.simulation.rollout import Tape, play

PREFIXES = ("robot0_", GRIPPER_PREFIX, "fixed_mount0_")
"""Of the robot's bodies in a robosuite scene; left out of the names in robot.xml."""
RESPONSE_STEPS, RESPONSE_AMPLITUDE = 12, 0.5
"""Policy steps over which an impulse is followed, and its action; beyond, the arm's posture pulls it back."""
GRIPPER_COMMANDS, GRIPPER_TIME = 21, 1.0
"""Closing commands at which the empty gripper is measured, and the time [s] it is given at each."""
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
    site = plant.model.site(GRIP_SITE).id
    return np.append(plant.data.site_xpos[site], rotation_vector(plant.data.site_xmat[site].reshape(3, 3) @ START_ROTATION.T))


# ---- episodes --------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Played:
    """What episodes on the native robot looked like; lists hold one array per episode.

    Attributes:
        observations: (T, n_obs).  actions: (T, n_act) of the record.
        qpos: (T + 1, nq).  speeds, efforts: (T, n_arm) [rad/s, N m] at the end of each step.
        grasp: (T + 1, 6) grasp_coordinates.  clearance: smallest height [m] of the gripper's shapes above the table.
        success: share of successful episodes.
    """

    observations: list[np.ndarray]
    actions: list[np.ndarray]
    qpos: list[np.ndarray]
    speeds: list[np.ndarray]
    efforts: list[np.ndarray]
    grasp: list[np.ndarray]
    clearance: float
    success: float


def watch(plant: Plant, policy: GaussianPolicy, seeds: list[int], noisy: bool, lowest: Callable[[np.ndarray], float]) -> Played:
    """Play episodes and keep what the manifest needs.

    Args:
        plant: the native robot.
        policy: who plays.
        seeds: of the episodes.
        noisy: with the exploration noise of training.
        lowest: height [m] of the gripper's lowest point at a configuration (nq,).
    """
    model, arm = plant.model, arm_joints(plant.model)
    dofs, by_joint = model.jnt_dofadr[arm], {int(model.actuator_trnid[a, 0]): a for a in range(model.nu)}
    motors = [by_joint[joint] for joint in arm]
    out = Played([], [], [], [], [], [], np.inf, 0.0)
    height, succeeded = np.inf, 0
    for seed in seeds:
        rows: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []

        def seen(observation: np.ndarray, rng: np.random.Generator, rows: list = rows) -> np.ndarray:
            rows.append((plant.data.qvel[dofs].copy(), plant.data.ctrl[motors].copy(), grasp_coordinates(plant)))
            return policy.act(observation, rng) if noisy else policy.mean(observation)

        tape = Tape(qpos=[])
        episode = play(plant, seen, seed, np.zeros(0), tape)
        last = (plant.data.qvel[dofs].copy(), plant.data.ctrl[motors].copy(), grasp_coordinates(plant))
        speeds, efforts, grasp = (np.array(column) for column in zip(*rows, last, strict=True))
        succeeded += episode.success
        height = min(height, *(lowest(row) for row in tape.qpos))
        for kept, value in (
            (out.observations, episode.observations), (out.actions, episode.actions), (out.qpos, np.array(tape.qpos)),
            (out.speeds, speeds[1:]), (out.efforts, efforts[1:]), (out.grasp, grasp),
        ):  # fmt: skip
            kept.append(value)
    return Played(out.observations, out.actions, out.qpos, out.speeds, out.efforts, out.grasp, height, succeeded / len(seeds))


def largest_step(rows: list[np.ndarray]) -> np.ndarray:
    """Largest change (n,) between consecutive rows of the episodes' (T, n) arrays."""
    return np.max([np.abs(np.diff(episode, axis=0)).max(axis=0, initial=0.0) for episode in rows], axis=0)


def record_episode(plant: Plant, robot: Robot, policy: GaussianPolicy, seed: int) -> tuple[dict[str, np.ndarray], bool]:
    """A closed-loop episode as an arm and cameras would report it, one row per tick, and whether it succeeded.

    Arrays: episode_joints (T, n), episode_fingers (T, m) [rad], episode_object_position (T, 3), episode_object_quaternion (T, 4),
    episode_goal (3,), episode_command (T,) the closing command, episode_observations (T, n_obs).
    """
    model, data = plant.model, plant.data
    joints = [model.joint(j).name for j in range(model.njnt)]
    arm = model.jnt_qposadr[arm_joints(model)]
    fingers = model.jnt_qposadr[[j for j, name in enumerate(joints) if name.startswith(GRIPPER_PREFIX)]]
    item = model.body(plant.env.item.root_body).id
    rows: list[tuple] = []

    def seen(_: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        mujoco.mj_kinematics(model, data)  # after a step, MuJoCo's poses are a substep older than its angles
        observation = plant.observe()
        rows.append((data.qpos[arm].copy(), data.qpos[fingers].copy(), data.xpos[item].copy(), data.xquat[item].copy(),
                     plant.command[CLOSING].mean(), observation))  # fmt: skip
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
    arm = model.jnt_dofadr[arm_joints(model)]
    model.dof_armature[arm], model.dof_damping[arm] = CLAMP, CLAMP
    data = mujoco.MjData(model)
    plant.begin(0)
    data.qpos[:] = plant.data.qpos
    item = int(model.body(plant.env.item.root_body).jntadr[0])
    data.qpos[model.jnt_qposadr[item] : model.jnt_qposadr[item] + 3] = (3.0, 3.0, 1.0)
    joints, actuators = role_joints(model, robot), role_actuators(model, robot)
    outer = {side: _outermost(model, [joint for role, joint in joints.items() if role.startswith("TH") == (side == "thumb")])
             for side in ("thumb", "fingers")}  # fmt: skip
    fingers = [j for j in range(model.njnt) if model.joint(j).name.startswith(GRIPPER_PREFIX)]
    commands = np.linspace(-1.0, 1.0, GRIPPER_COMMANDS)
    openings, angles = [], []
    for command in commands:
        data.ctrl[[actuators[role] for role in robot.gripper.targets]] = plant.law.targets(np.full(len(COMMANDED_ROLES), command))
        mujoco.mj_step(model, data, int(GRIPPER_TIME / model.opt.timestep))
        mujoco.mj_forward(model, data)
        gaps = [mujoco.mj_geomDistance(model, data, a, b, 1.0, None) for a in outer["thumb"] for b in outer["fingers"]]
        openings.append(max(0.0, min(gaps)))
        angles.append(vector(data.qpos[model.jnt_qposadr[fingers]]))
    openings = np.minimum.accumulate(openings)
    return Gripper(
        law="command = clip(command + rate * sign(action), -1, 1)", rate=float(robot.gripper.rate),
        preshape=float(robot.gripper.preshape), open_sign=-1, close_sign=1,
        targets={robot.gripper.joints[role]: tuple(map(float, pair)) for role, pair in robot.gripper.targets.items()},
        command=tuple(commands.tolist()), opening_m=tuple(float(o) for o in openings),
        joints=tuple(model.joint(j).name.removeprefix(GRIPPER_PREFIX) for j in fingers),
        joint_units=tuple("m" if model.jnt_type[j] == mujoco.mjtJoint.mjJNT_SLIDE else "rad" for j in fingers),
        joint_positions=tuple(angles),
        fraction="opening_m / opening_m[0]: 1 open, 0 touching",
    )  # fmt: skip


def _outermost(model: mujoco.MjModel, joints: list[int]) -> list[int]:
    """Collision geoms of the links of these joints that carry no other of these joints."""
    bodies = {int(model.jnt_bodyid[joint]) for joint in joints}
    parents = {int(model.body_parentid[body]) for body in bodies}
    # An inner knuckle ends in no pad: of the last bodies, those with a primitive for a pad count, if there are any.
    geoms = [g for g in range(model.ngeom) if model.body_weldid[model.geom_bodyid[g]] in bodies - parents and model.geom_group[g] == 0]
    pads = [g for g in geoms if model.geom_type[g] != mujoco.mjtGeom.mjGEOM_MESH]
    return pads or geoms


# ---- the robot's model -----------------------------------------------------------------------------------------------


def robot_bodies(model: mujoco.MjModel) -> list[int]:
    """Ids of the robot's bodies in a robosuite scene, parents first."""
    return [b for b in range(1, model.nbody) if model.body(b).name.startswith(PREFIXES)]


def plain_name(name: str) -> str:
    """A body's, joint's or geom's name without robosuite's prefix."""
    for prefix in PREFIXES:
        name = name.removeprefix(prefix)
    return name


def vector(values: ArrayLike) -> Vector:
    """Numbers of any shape, one after another, as the manifest holds them."""
    return tuple(float(value) for value in np.ravel(values))


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


def robot_mjcf(plant: Plant, name: str) -> str:
    """The robot on its mount beside the table, as MJCF that MuJoCo alone loads, in the task frame.

    Frames, joints, limits and inertias are the simulated robot's own. Its meshes are replaced by the smaller of the
    enclosing box and capsule, so a shape never ends inside the real one; those of the gripper are there as convex hulls, too,
    which touch nothing and tell how high it hangs over the table. Couplings of finger joints and actuators are left out:
    the file serves kinematics and distances.
    """
    model = plant.model
    root = ET.Element("mujoco", model=name)
    ET.SubElement(root, "compiler", angle="radian", autolimits="false", inertiafromgeom="false", balanceinertia="false")
    assets, world = ET.SubElement(root, "asset"), ET.SubElement(root, "worldbody")
    table = next(g for g in range(model.ngeom) if model.geom(g).name == "table_collision")
    _shape(world, "table", model.geom_type[table], model.geom_size[table], plant.data.geom_xpos[table], np.array([1.0, 0, 0, 0]))
    effort = {int(model.actuator_trnid[a, 0]): model.actuator_ctrlrange[a] for a in range(model.nu)}
    arm = arm_joints(model)
    made: dict[int, ET.Element] = {}
    for body in robot_bodies(model):
        parent = made.get(int(model.body_parentid[body]), world)
        element = ET.SubElement(parent, "body", name=model.body(body).name.removeprefix("robot0_").removeprefix(GRIPPER_PREFIX),
                                pos=_text(model.body_pos[body]), quat=_text(model.body_quat[body]))  # fmt: skip
        made[body] = element
        if model.body_mass[body] > 0:
            ET.SubElement(element, "inertial", pos=_text(model.body_ipos[body]), quat=_text(model.body_iquat[body]),
                          mass=_text(model.body_mass[body]), diaginertia=_text(model.body_inertia[body]))  # fmt: skip
        for joint in (j for j in range(model.njnt) if model.jnt_bodyid[j] == body):
            dof = model.jnt_dofadr[joint]
            limited = bool(model.jnt_limited[joint])
            attributes = {"name": plain_name(model.joint(joint).name),
                          "type": "slide" if model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_SLIDE else "hinge",
                          "pos": _text(model.jnt_pos[joint]),
                          "axis": _text(model.jnt_axis[joint]), "limited": str(limited).lower(),
                          "ref": _text(model.qpos0[model.jnt_qposadr[joint]]), "damping": _text(model.dof_damping[dof]),
                          "armature": _text(model.dof_armature[dof]), "frictionloss": _text(model.dof_frictionloss[dof])}  # fmt: skip
            if limited:
                attributes["range"] = _text(model.jnt_range[joint])
            if joint in arm:
                attributes |= {"actuatorfrclimited": "true", "actuatorfrcrange": _text(effort[joint])}
            ET.SubElement(element, "joint", attributes)
        for geom in (g for g in range(model.ngeom) if model.geom_bodyid[g] == body and model.geom_group[g] == 0):
            _enclose(element, model, geom)
            if model.body(body).name.startswith(GRIPPER_PREFIX) and model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_MESH:
                _hull(assets, element, model, geom)
        for site in (s for s in range(model.nsite) if model.site_bodyid[s] == body and model.site(s).name == GRIP_SITE):
            ET.SubElement(element, "site", name="grasp", pos=_text(model.site_pos[site]), quat=_text(model.site_quat[site]))
    ET.indent(root)
    return ET.tostring(root, encoding="unicode") + "\n"


_KINDS = {
    int(mujoco.mjtGeom.mjGEOM_SPHERE): ("sphere", 1), int(mujoco.mjtGeom.mjGEOM_CAPSULE): ("capsule", 2),
    int(mujoco.mjtGeom.mjGEOM_CYLINDER): ("cylinder", 2), int(mujoco.mjtGeom.mjGEOM_BOX): ("box", 3),
    int(mujoco.mjtGeom.mjGEOM_ELLIPSOID): ("ellipsoid", 3),
}  # fmt: skip


def _shape(parent: ET.Element, name: str, kind: int, size: np.ndarray, position: np.ndarray, quaternion: np.ndarray) -> None:
    word, count = _KINDS[int(kind)]
    ET.SubElement(parent, "geom", name=name, type=word, size=_text(size[:count]), pos=_text(position), quat=_text(quaternion))


def _vertices(model: mujoco.MjModel, geom: int) -> np.ndarray:
    """Vertices (n, 3) [m] of a geom's mesh in its frame."""
    mesh = int(model.geom_dataid[geom])
    start = model.mesh_vertadr[mesh]
    return np.asarray(model.mesh_vert[start : start + model.mesh_vertnum[mesh]], float)


def _hull(assets: ET.Element, parent: ET.Element, model: mujoco.MjModel, geom: int) -> None:
    name, points = plain_name(model.geom(geom).name) + HULL, _vertices(model, geom)
    try:
        points = points[ConvexHull(points).vertices]
    except QhullError:
        pass  # flat: all of its vertices, then
    text = " ".join(f"{v:.7f}" for v in points.ravel())  # to 0.05 um
    ET.SubElement(assets, "mesh", name=name, vertex=text, inertia="shell")
    ET.SubElement(parent, "geom", name=name, type="mesh", mesh=name, pos=_text(model.geom_pos[geom]), quat=_text(model.geom_quat[geom]),
                  contype="0", conaffinity="0", group="3")  # fmt: skip


def _enclose(parent: ET.Element, model: mujoco.MjModel, geom: int) -> None:
    name, kind = plain_name(model.geom(geom).name), int(model.geom_type[geom])
    if kind in _KINDS:
        _shape(parent, name, kind, model.geom_size[geom], model.geom_pos[geom], model.geom_quat[geom])
        return
    points = _vertices(model, geom)
    centre, half = 0.5 * (points.max(axis=0) + points.min(axis=0)), 0.5 * np.ptp(points, axis=0)
    along = int(np.argmax(half))
    offset = points - centre
    aside = np.linalg.norm(np.delete(offset, along, axis=1), axis=1)
    radius = float(aside.max())
    length = max(0.0, float((np.abs(offset[:, along]) - np.sqrt(np.maximum(radius**2 - aside**2, 0.0))).max()))
    position, rotation = model.geom_pos[geom].copy(), np.empty(9)
    mujoco.mju_quat2Mat(rotation, model.geom_quat[geom])
    rotation = rotation.reshape(3, 3)
    position += rotation @ centre
    if 8 * half.prod() <= np.pi * radius**2 * (2 * length + 4 / 3 * radius):
        _shape(parent, name, mujoco.mjtGeom.mjGEOM_BOX, half, position, model.geom_quat[geom])
        return
    turned = rotation[:, [(along + 1) % 3, (along + 2) % 3, along]]  # a capsule lies along its z
    quaternion = np.empty(4)
    mujoco.mju_mat2Quat(quaternion, np.ascontiguousarray(turned).ravel())
    _shape(parent, name, mujoco.mjtGeom.mjGEOM_CAPSULE, np.array([radius, length, 0.0]), position, quaternion)


def _text(values: np.ndarray | float) -> str:
    return " ".join(repr(float(v)) for v in np.atleast_1d(values))

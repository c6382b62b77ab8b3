"""From a recorded hand to a robot hand: inverse kinematics frame by frame (mink), and what the policy's action can say of it.

Each of the 21 recorded joints that a robot hand has a counterpart for becomes a task: fingertips first, then the middle
joints, the palm's pose (fitted to wrist and knuckles by least squares, Kabsch 1976) and, last, a posture. Joint limits are
kept exactly. Two solutions per frame: within the hand's own joint limits, which gives the grasp frame's way and says how well the
hand can follow; and, with the palm held there, within what the policy's finger actions can command. Then contact: a finger
that touches in the recording is told to close on, as position servos grip by what their targets lie inside; one that does not
touch yet is opened until the robot's thicker finger is clear of the object, and where that is not enough the hand is raised.
"""

from collections.abc import Callable
from dataclasses import dataclass

import mink
import mujoco
import numpy as np
from robosuite.models.grippers import gripper_factory

from grippers.gripper import COMMANDED_ROLES, DIGITS, INDEX
from robots.robot import Robot
from tasks.dexycb.recording import FINGERS, JOINT_NAMES, Recording
from tasks.dexycb.scene import Scene
from tasks.objects import PickObject
from tasks.pick import START_ROTATION
from toolkit.demonstrations.tracks import Track
from toolkit.errors import ToolkitError

DIGIT = {digit.title: digit for digit in DIGITS}
"""The merged hand's digit of each finger of people's hands."""
TIP_COST, MIDDLE_COST, PALM_COST, POSTURE_COST = 1.0, 0.2, (0.2, 0.1), 1e-3
"""Weights: fingertips are where contact happens; the palm's is of its position and, per radian, of its rotation."""
HELD_COST = (10.0, 2.0)
"""The palm's weights where it is held and only fingers give way."""
REACHABLE = 0.02
"""[m] A frame is infeasible if its worst fingertip stays farther from the recorded one."""
CONTACT = 0.012
"""[m] from a finger's bone to the surface within which it touches: half a finger's thickness and what poses are wrong by."""
NEARLY = 0.006
"""[m] beyond CONTACT over which the tightening grows, so that a target does not jump."""
CLEAR = 0.002
"""[m] between an open hand and the object that it comes down over."""
HIGHEST = 0.012
"""[m] by which the hand is raised at most: what is left is pushed aside, as hands do."""
LOOSEN = 0.1
"""Command by which a finger is opened at a time until it is clear."""


@dataclass(frozen=True, eq=False)
class HandMotion:
    """A robot hand that follows a recording. F frames in which the hand was seen, the task's frame, n commanded joints.

    Attributes:
        raised: height [m] by which the hand is raised so that it comes down over the object without pushing it.
        frames: (F,) indices of the recording's frames.
        qpos: (F, 7 + n_joints) floating hand, of `HandModel.model`.
        grasp_position: (F, 3) [m] of the grasp frame.
        grasp_rotation: (F, 3, 3) grasp frame to task.
        commands: (F, n_roles) finger targets in [-1, 1], tightened; 0 for roles that the hand holds still.
        tip_error: (F, 5) [m] distance of each fingertip from the recorded one, thumb first, within the hand's joint limits.
        commanded_error: (F, 5) [m] the same with fingers where actions can command them.
        infeasible: indices of the recording's frames whose worst fingertip stays beyond REACHABLE.
    """

    raised: float
    frames: np.ndarray
    qpos: np.ndarray
    grasp_position: np.ndarray
    grasp_rotation: np.ndarray
    commands: np.ndarray
    tip_error: np.ndarray
    commanded_error: np.ndarray
    infeasible: tuple[int, ...]


class HandModel:
    """A robot's hand floating free, with sites at its fingertips, and the object that it is to grasp.

    Args:
        robot: whose hand.
        item: the object.

    Attributes:
        model: free joint and finger joints; no contacts are computed with it.

    Raises:
        ToolkitError: the gripper lacks a finger that people have.
    """

    def __init__(self, robot: Robot, item: PickObject) -> None:
        gripper = gripper_factory(robot.gripper.robosuite_type)
        self._prefix = gripper.naming_prefix
        self.gripper = robot.gripper
        tips = {finger: DIGIT[finger].tip for finger in FINGERS}
        missing = [role for role in tips.values() if role not in robot.gripper.joints]
        if missing:
            raise ToolkitError(f"gripper {robot.gripper.name} has no joint {missing[0]}; recordings of hands need a hand with five fingers")
        spec = mujoco.MjSpec.from_string(gripper.get_xml())
        spec.compiler.degree = False
        spec.worldbody.first_body().add_freejoint(name="float")
        bodies = {joint.name: body for body in spec.bodies for joint in body.joints}
        for finger, role in tips.items():
            body = bodies[self._prefix + robot.gripper.joints[role]]
            body.add_site(name=f"tip/{finger}", pos=_tip_of(body))
        kind = mujoco.mjtGeom.mjGEOM_BOX if item.shape == "box" else mujoco.mjtGeom.mjGEOM_CYLINDER
        body = spec.worldbody.add_body(name="object", mocap=True)
        body.add_geom(name="object", type=kind, size=[*item.half_size, 0.0][:3], contype=0, conaffinity=0, rgba=[0, 0, 0, 0])
        self.item, self.model = item, spec.compile()
        self._joint = {role: self.model.joint(self._prefix + name) for role, name in robot.gripper.joints.items()}
        self._body = {role: int(joint.bodyid[0]) for role, joint in self._joint.items()}
        palm = int(self.model.body_parentid[self._body[INDEX.joints[0]]])
        self._palm = self.model.body(palm).name
        self._roles = {finger: np.array([role in DIGIT[finger].chain for role in COMMANDED_ROLES]) for finger in FINGERS}
        self._solid = self._solid_geoms()
        data = mujoco.MjData(self.model)
        mujoco.mj_forward(self.model, data)
        knuckles = [data.xpos[self._body[DIGIT[finger].flexion]] for finger in FINGERS[1:]]
        # Wrist and knuckles in the palm's axes, as the recorded ones are fitted.
        self._palm_points = (np.array([data.xpos[palm], *knuckles]) - data.xpos[palm]) @ data.xmat[palm].reshape(3, 3)
        self._site = self.model.site(self._prefix + "grip_site").id
        self._middle = {finger: self.model.body(self._body[DIGIT[finger].pad]).name for finger in FINGERS}

    def _solid_geoms(self) -> dict[int, str]:
        """Geoms of the hand that collide, each with its finger or "palm"."""
        part = {self._body[role]: finger for finger in FINGERS for role in self._body if role in DIGIT[finger].chain}
        out = {}
        for geom in np.flatnonzero(self.model.geom_contype):
            body = int(self.model.geom_bodyid[geom])
            while body and body not in part:
                body = int(self.model.body_parentid[body])
            out[int(geom)] = part.get(body, "palm")
        return out

    def commanded(self) -> mujoco.MjModel:
        """The model with each finger joint limited to what its action can command."""
        model = self.model.__copy__()
        for role, (opened, closed) in self.gripper.targets.items():
            slack = max(0.0, 2e-3 - abs(closed - opened)) / 2  # mink wants a range, not a point
            model.jnt_range[self._joint[role].id] = min(opened, closed) - slack, max(opened, closed) + slack
        return model

    def configured(self, qpos: np.ndarray, commands: np.ndarray) -> np.ndarray:
        """The configuration (nq,) with the fingers where commands (n_roles,) send them."""
        out = qpos.copy()
        for role, (opened, closed) in self.gripper.targets.items():
            out[self._joint[role].qposadr[0]] = opened + 0.5 * (commands[COMMANDED_ROLES.index(role)] + 1.0) * (closed - opened)
        return out

    def depths(self, data: mujoco.MjData, qpos: np.ndarray, object_pose: np.ndarray) -> dict[str, float]:
        """How deep [m] each finger, and the palm, is in the object at a pose (4, 4); negative: how far from it, at most 0.05."""
        data.qpos[:] = qpos
        data.mocap_pos[0] = object_pose[:3, 3]
        mujoco.mju_mat2Quat(data.mocap_quat[0], np.ascontiguousarray(object_pose[:3, :3]).ravel())
        mujoco.mj_kinematics(self.model, data)
        thing = self.model.geom("object").id
        out = dict.fromkeys((*FINGERS, "palm"), -0.05)
        for geom, part in self._solid.items():
            out[part] = max(out[part], -mujoco.mj_geomDistance(self.model, data, geom, thing, 0.05, None))
        return out

    def cleared(self, qpos: np.ndarray, commands: np.ndarray, touch: np.ndarray, object_pose: np.ndarray) -> tuple[np.ndarray, float]:
        """Open fingers that do not touch yet until they are clear of the object.

        Args:
            qpos: (nq,) the hand.
            commands: (n_roles,) finger targets.
            touch: (5,) how far each finger touches.
            object_pose: (4, 4).

        Returns:
            commands (n_roles,), and how far [m] the hand has to be raised for palm and open fingers to be clear.
        """
        data, out = mujoco.MjData(self.model), commands.copy()
        while True:
            depths = self.depths(data, self.configured(qpos, out), object_pose)
            opening = np.zeros(len(out), bool)
            for finger, share in zip(FINGERS, touch, strict=True):
                mine = self._roles[finger] & (out > -1.0)
                if share < 1.0 and depths[finger] > -CLEAR and mine.any():
                    opening |= mine
            if not opening.any():
                return out, self._raise(data, qpos, out, object_pose)
            out[opening] = np.maximum(out[opening] - LOOSEN, -1.0)

    def _raise(self, data: mujoco.MjData, qpos: np.ndarray, commands: np.ndarray, object_pose: np.ndarray) -> float:
        """Height [m], at most HIGHEST, at which the palm and the open hand clear the object."""
        up = qpos.copy()
        for height in np.arange(0.0, HIGHEST, 0.002):
            up[2] = qpos[2] + height
            if max(self.depths(data, self.configured(up, np.full_like(commands, -1.0)), object_pose).values()) < 0.0:
                return float(height)
        return HIGHEST

    def start(self, joints: np.ndarray) -> np.ndarray:
        """Configuration (nq,) with open fingers and the palm where recorded joints (21, 3) [m] have it."""
        qpos = np.zeros(self.model.nq)
        R, p = self.palm_pose(joints)
        mujoco.mju_mat2Quat(qpos[3:7], R.ravel())
        for role, (opened, _) in self.gripper.targets.items():
            qpos[self._joint[role].qposadr[0]] = opened
        data = mujoco.MjData(self.model)
        data.qpos[:] = qpos
        mujoco.mj_forward(self.model, data)
        body = data.body(self._palm)
        turn = R @ body.xmat.reshape(3, 3).T
        mujoco.mju_mat2Quat(qpos[3:7], (turn @ R).ravel())
        data.qpos[:] = qpos
        mujoco.mj_forward(self.model, data)
        qpos[:3] = p - data.body(self._palm).xpos
        return qpos

    def palm_pose(self, joints: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Rotation (3, 3) and position (3,) [m] of the palm that fit wrist and knuckles of recorded joints (21, 3) best."""
        recorded = joints[[0, *(JOINT_NAMES.index(f"{finger}_mcp") for finger in FINGERS[1:])]]
        own, seen = self._palm_points - self._palm_points.mean(axis=0), recorded - recorded.mean(axis=0)
        U, _, Vt = np.linalg.svd(own.T @ seen)
        R = Vt.T @ np.diag([1.0, 1.0, np.sign(np.linalg.det(Vt.T @ U.T))]) @ U.T
        return R, recorded.mean(axis=0) - R @ self._palm_points.mean(axis=0)

    def grasp_pose(self, qpos: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Position (3,) [m] and rotation (3, 3) of the grasp frame."""
        data = mujoco.MjData(self.model)
        data.qpos[:] = qpos
        mujoco.mj_kinematics(self.model, data)
        return np.array(data.site_xpos[self._site]), np.array(data.site_xmat[self._site]).reshape(3, 3)

    def commands(self, qpos: np.ndarray) -> np.ndarray:
        """Finger targets (n_roles,) in [-1, 1] that come closest to a configuration (nq,)."""
        out = np.zeros(len(COMMANDED_ROLES))
        for role, (opened, closed) in self.gripper.targets.items():
            if abs(closed - opened) > 1e-3:
                angle = qpos[self._joint[role].qposadr[0]]
                out[COMMANDED_ROLES.index(role)] = np.clip(2.0 * (angle - opened) / (closed - opened) - 1.0, -1.0, 1.0)
        return out

    def tightened(self, commands: np.ndarray, touch: np.ndarray) -> np.ndarray:
        """Finger targets (n_roles,), those of a finger that touches (5,) moved towards fully closed."""
        shares = sum(share * self._roles[finger] for finger, share in zip(FINGERS, touch, strict=True))
        return commands + shares * (1.0 - commands)


def _tip_of(body: "mujoco.MjsBody") -> np.ndarray:
    """The point (3,) [m] of a last link's skin that is farthest along it, in its axes: the end of its longest capsule."""
    capsules = [geom for geom in body.geoms if geom.type == mujoco.mjtGeom.mjGEOM_CAPSULE]
    if not capsules:
        raise ToolkitError(f"body {body.name} has no capsule, so its fingertip is unknown")
    geom = max(capsules, key=lambda g: g.size[1])
    axis = np.empty(3)
    mujoco.mju_rotVecQuat(axis, np.array([0.0, 0.0, 1.0]), np.array(geom.quat))
    ends = [np.array(geom.pos) + sign * (geom.size[1] + geom.size[0]) * axis for sign in (-1, 1)]
    return max(ends, key=np.linalg.norm)


class _Follower:
    """Inverse kinematics of one hand: recorded joints in, configuration out, each from the last."""

    def __init__(self, hand: HandModel, model: mujoco.MjModel, joints: np.ndarray, palm_cost: tuple[float, float]) -> None:
        self.hand = hand
        self.configuration = mink.Configuration(model, q=hand.start(joints))
        self._tips = {f: mink.FrameTask(f"tip/{f}", "site", TIP_COST, 0.0, lm_damping=1e-6) for f in FINGERS}
        self._middles = {f: mink.FrameTask(hand._middle[f], "body", MIDDLE_COST, 0.0, lm_damping=1e-6) for f in FINGERS}
        self._palm = mink.FrameTask(hand._palm, "body", *palm_cost, lm_damping=1e-6)
        self._posture = mink.PostureTask(model, cost=np.r_[np.zeros(6), np.full(hand.model.nv - 6, POSTURE_COST)])
        self._posture.set_target(self.configuration.q)
        self._limits = [mink.ConfigurationLimit(model)]
        self._tasks = [*self._tips.values(), *self._middles.values(), self._palm, self._posture]

    def follow(self, joints: np.ndarray, palm: tuple[np.ndarray, np.ndarray], iterations: int) -> np.ndarray:
        """Configuration (nq,) for recorded joints (21, 3) [m] and a palm's rotation (3, 3) and position (3,) [m]."""
        still = mink.SO3.identity()
        for finger in FINGERS:
            tip, middle = (joints[JOINT_NAMES.index(f"{finger}_{part}")] for part in ("tip", "pip"))
            self._tips[finger].set_target(mink.SE3.from_rotation_and_translation(still, tip))
            self._middles[finger].set_target(mink.SE3.from_rotation_and_translation(still, middle))
        R, p = palm
        self._palm.set_target(mink.SE3.from_rotation_and_translation(mink.SO3.from_matrix(R), p))
        for _ in range(iterations):
            try:
                velocity = mink.solve_ik(self.configuration, self._tasks, 1.0, "daqp", damping=1e-6, limits=self._limits)
            except mink.MinkError as error:
                raise ToolkitError(f"inverse kinematics of {self.hand.gripper.name} found no solution ({error})") from None
            self.configuration.integrate_inplace(np.clip(velocity, -0.4, 0.4), 1.0)
            if np.abs(velocity).max() < 1e-4:
                break
        return np.array(self.configuration.q)

    def palm(self) -> tuple[np.ndarray, np.ndarray]:
        """Rotation (3, 3) and position (3,) [m] of the palm as it is."""
        body = self.configuration.data.body(self.hand._palm)
        return np.array(body.xmat).reshape(3, 3), np.array(body.xpos)

    def tips(self) -> np.ndarray:
        """(5, 3) [m] of the hand as it is."""
        return np.array([self.configuration.data.site(f"tip/{finger}").xpos for finger in FINGERS])


def touching(item: PickObject, object_pose: np.ndarray, joints: np.ndarray) -> np.ndarray:
    """(5,) how far each finger touches, 0 to 1, from recorded joints (21, 3) [m] and the object's pose (4, 4), same axes."""
    out = np.zeros(len(FINGERS))
    for i, finger in enumerate(FINGERS):
        dip, tip = (joints[JOINT_NAMES.index(f"{finger}_{part}")] for part in ("dip", "tip"))
        bone = np.array([dip + share * (tip - dip) for share in (0.0, 0.5, 1.0)])
        near = item.distance((bone - object_pose[:3, 3]) @ object_pose[:3, :3]).min()
        out[i] = np.clip(1.0 - (near - CONTACT) / NEARLY, 0.0, 1.0)
    return out


def retarget(
    hand: HandModel, recording: Recording, scene: Scene, progress: Callable[[int, int], None] = lambda done, total: None
) -> HandMotion:
    """Let a robot hand follow a recording in the task's frame.

    Args:
        hand: the robot hand.
        recording: frames without a hand are left out; where the object was not annotated nothing is tightened.
        scene: of the recording.
        progress: called with frames done and frames in all.

    Raises:
        ToolkitError: no frame with a hand before the object moves, or no solution.
    """
    joints, poses = scene.joints(recording), scene.object_poses(recording)
    frames = np.flatnonzero(recording.hand_seen & (np.arange(recording.frames) <= scene.last))
    if not len(frames) or frames[0] >= scene.grasped - 1:
        raise ToolkitError(f"{recording.name}: the hand is not seen before the object moves in frame {scene.grasped}")
    limited = hand.commanded()
    plain, commanded = (
        _Follower(hand, model, joints[frames[0]], cost) for model, cost in ((hand.model, PALM_COST), (limited, HELD_COST))
    )
    at_tips = [JOINT_NAMES.index(f"{finger}_tip") for finger in FINGERS]
    touch, raised = np.zeros(len(FINGERS)), 0.0
    rows: list[tuple[np.ndarray, ...]] = []
    for done, frame in enumerate(frames):
        wanted = joints[frame, at_tips]
        iterations = 20 if done else 100
        qpos = plain.follow(joints[frame], hand.palm_pose(joints[frame]), iterations)
        reached = commanded.follow(joints[frame], plain.palm(), iterations)
        errors = [np.linalg.norm(follower.tips() - wanted, axis=1) for follower in (plain, commanded)]
        commands = hand.commands(reached)
        if np.isfinite(poses[frame]).all():  # a grip is kept to the end of the recording
            touch = np.maximum(touch, touching(scene.task.object, poses[frame], joints[frame]))
            if frame <= scene.grasped:
                commands, height = hand.cleared(reached, commands, touch, poses[frame])
                raised = max(raised, height)
        rows.append((qpos, *hand.grasp_pose(qpos), hand.tightened(commands, touch), *errors))
        progress(done + 1, len(frames))
    qpos, position, rotation, commands, error, commanded_error = (np.array(column) for column in zip(*rows, strict=True))
    infeasible = tuple(int(f) for f in frames[error.max(axis=1) > REACHABLE])
    position[:, 2] += raised
    return HandMotion(raised, frames, qpos, position, rotation, commands, error, commanded_error, infeasible)


def track_of(motion: HandMotion, recording: Recording, scene: Scene, rate: float) -> Track:
    """The motion as points of a pick at the policy's rate [Hz], times between frames filled in linearly.

    Raises:
        ToolkitError: the object is annotated in too few of the motion's frames.
    """
    poses = scene.object_poses(recording)
    known = np.flatnonzero(np.isfinite(poses[:, 0, 0]))
    times = motion.frames / recording.frame_rate
    clock = np.arange(times[0], times[-1] + 1e-9, 1.0 / rate)

    def at(frames: np.ndarray, values: np.ndarray) -> np.ndarray:
        """(T, k) values given at frames, at the clock's times."""
        return np.stack([np.interp(clock, frames / recording.frame_rate, column) for column in values.T], axis=1)

    position = at(known, poses[known, :3, 3])
    turns = np.array([mink.SO3.from_matrix(R @ START_ROTATION.T).log() for R in motion.grasp_rotation])
    goal = poses[scene.last, :3, 3]
    lift = int(np.clip(np.searchsorted(clock, scene.grasped / recording.frame_rate), 1, len(clock) - 1))
    if len(clock) < 5 or len(clock) - lift < 3:
        raise ToolkitError(f"{recording.name}: {len(clock)} points, {len(clock) - lift} of them after the grasp, are too few to follow")
    return Track(
        recording.name, position - at(motion.frames, motion.grasp_position), at(motion.frames, turns),
        at(motion.frames, motion.commands), goal - position, lift, scene.task.object.shape == "cylinder",
    )

"""A plant: one compiled robot in its task, with everything the compiled control step needs to drive and observe it."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np

from grippers.gripper import CLOSING_ROLES, COMMANDED_ROLES, ROLE_COMMAND
from robots.robot import Robot
from tasks.env import Pick
from tasks.pick import START_POSITION, START_ROTATION, PickTask, at_goal, is_lost, observe
from toolkit.errors import ToolkitError
from toolkit.morphology.build import MergedRobot
from toolkit.morphology.grasp import Course
from toolkit.morphology.matching import finger_sign
from toolkit.morphology.native_scene import GRIP_SITE, NativeScene, role_actuators, role_joints
from toolkit.morphology.posture import native_env, start_of
from toolkit.morphology.space import GRIPPER_LOG_GAIN, HAND_LOG_GAIN, HAND_RATE
from toolkit.simulation import osc

CLOSING = np.array([COMMANDED_ROLES.index(role) for role in CLOSING_ROLES])
"""Indices of the closing roles among the commanded ones."""
WATCHED_WARNINGS = np.array([
    mujoco.mjtWarning.mjWARN_BADQPOS, mujoco.mjtWarning.mjWARN_BADQVEL, mujoco.mjtWarning.mjWARN_BADQACC,
    mujoco.mjtWarning.mjWARN_INERTIA, mujoco.mjtWarning.mjWARN_BADCTRL,
], np.int64)
"""MuJoCo warnings that mean a simulation has diverged."""
SPEED_LIMIT = 200.0
"""Speed [rad/s or m/s] of any joint from which a simulation counts as exploded."""

# Compiled apart from one another: Numba's files on disk follow the file of the function called, not those it calls.
_observe, _at_goal = osc.compiled(observe), osc.compiled(at_goal)


@osc.compiled
def _advance(
    state: np.ndarray, action: np.ndarray, closing: np.ndarray, common: float, gain: float, leak: float, rate: float
) -> np.ndarray:
    out = np.empty(state.size)
    mean = 0.0
    for i in closing:
        mean += action[i]
    mean /= closing.size
    for i in range(state.size):
        change = gain * ((1.0 - common) * action[i] + common * mean) - leak * state[i]
        out[i] = np.minimum(np.maximum(state[i] + np.minimum(np.maximum(change, -rate), rate), -1.0), 1.0)
    return out


@osc.compiled
def _progress(state: np.ndarray, closing: np.ndarray, preshape: float) -> float:
    mean = 0.0
    for i in closing:
        mean += state[i]
    return 2.0 * (mean / closing.size - preshape) / (1.0 - preshape) - 1.0


@osc.compiled
def _hand(
    state: np.ndarray, closing: np.ndarray, preshape: float,
    qpos: np.ndarray, role: np.ndarray, address: np.ndarray, sign: np.ndarray, start: np.ndarray,
) -> tuple[np.ndarray, float]:
    out = np.zeros(state.size)
    for i in range(role.size):
        out[role[i]] = sign[i] * (qpos[address[i]] - start[i])
    return out, _progress(state, closing, preshape)


@osc.compiled
def _targets(state: np.ndarray, role: np.ndarray, commands: np.ndarray, targets: np.ndarray) -> np.ndarray:
    out = np.empty(role.size)
    for i in range(role.size):
        out[i] = np.interp(state[role[i]], commands[i], targets[i])
    return out


@osc.compiled
def _exploded(qvel: np.ndarray, warnings: np.ndarray, watched: np.ndarray, limit: float) -> bool:
    for w in watched:
        if warnings[w] > 0:
            return True
    for speed in qvel:
        if not abs(speed) <= limit:
            return True
    return False


@dataclass
class CommandLaw:
    """How finger actions become position targets: s+ = clip(s + clip(K u - leak s, -rate, rate), -1, 1).

    u is each role's own action, blended by ``common`` with the mean action of the closing roles. A hand has K = leak = 1:
    s follows the action at its rate. robosuite's grippers integrate the sign of one action: common 1, leak 0, K large.

    Attributes:
        common: 0 every role its own action, 1 one closing action for all.
        gain: K.  leak: pull of s to zero.  rate: largest change of s per policy step.
        preshape: s at the start of an episode.
        course: position targets [rad, m for slides] (n_actuators,) over s.
        role: index (n_actuators,) into the commanded roles.
    """

    common: float
    gain: float
    leak: float
    rate: float
    preshape: float
    course: Course
    role: np.ndarray

    def advance(self, state: np.ndarray, action: np.ndarray) -> np.ndarray:
        """Next s (n_roles,) from s and the finger actions (n_roles,)."""
        return _advance(state, action, CLOSING, self.common, self.gain, self.leak, self.rate)

    def progress(self, state: np.ndarray) -> float:
        """How far the closing roles have closed since the start, from -1 (the preshape) to +1 (closed), at s (n_roles,)."""
        return _progress(state, CLOSING, self.preshape)

    def targets(self, state: np.ndarray) -> np.ndarray:
        """Position targets (n_actuators,) [rad] at s (n_roles,)."""
        return _targets(state, self.role, self.course.commands, self.course.targets)


class Plant:
    """One robot in its task, ready to be reset and stepped.

    Args:
        model, data: the compiled scene.
        arm: joint ids of the arm.
        arm_actuator, finger_actuator: actuator ids.
        site: name of the grasp frame's site.
        start: configuration (nq,) at the start, object excluded.
        fingers: for each commanded role (qpos address or -1, sign, start angle).
        law: the command law.
        base: (follows, axis, anchor, origin) of the OSC base frame.
        object_body: name of the object's body, whose first joint is free.
        task: the task.

    Attributes:
        command: (n_roles,) closing command.  goal: (3,) [m], world.
        before: (n_state,) STATE before the last policy step.
        substeps: of physics per policy step.
        object_body: id.
        env: robosuite's environment, of an unmodified robot alone.
    """

    env: Pick

    def __init__(
        self,
        model: mujoco.MjModel,
        data: mujoco.MjData,
        arm: Sequence[int],
        arm_actuator: Sequence[int],
        finger_actuator: Sequence[int],
        site: str,
        start: np.ndarray,
        fingers: Sequence[tuple[int, float, float]],
        law: CommandLaw,
        base: tuple[float, np.ndarray, np.ndarray, np.ndarray],
        object_body: str,
        task: PickTask,
    ) -> None:
        self.model, self.data, self.task, self.law = model, data, task, law
        self.start = np.array(start)
        self._site = model.site(site).id
        address = np.array([f[0] for f in fingers])
        present = np.flatnonzero(address >= 0)
        sign, start_angle = np.array([f[1:] for f in fingers])[present].T.copy()
        self._fingers = (present, address[present], sign, start_angle)
        self.object_body = model.body(object_body).id
        self._object_qpos = int(model.jnt_qposadr[model.body_jntadr[self.object_body]])
        self.substeps = int(round(1.0 / task.control_frequency / model.opt.timestep))
        self.command = np.zeros(len(COMMANDED_ROLES))
        self.goal = np.zeros(3)
        self.before = np.empty(mujoco.mj_stateSize(model, osc.STATE))
        self._drive = self._arm_drive(list(arm), list(arm_actuator), list(finger_actuator), base)
        self._osc_goal = np.zeros((4, 3))
        # Views: a property of mjData costs as much as a short function.
        self._qpos, self._qvel, self._warnings = data.qpos, data.qvel, data.warning.number
        self._grasp_position, self._grasp_rotation = data.site_xpos[self._site], data.site_xmat[self._site].reshape(3, 3)
        self._object_position = data.xpos[self.object_body]
        self._object_rotation = data.xmat[self.object_body].reshape(3, 3)

    def _arm_drive(
        self, arm: list[int], arm_actuator: list[int], finger_actuator: list[int],
        base: tuple[float, np.ndarray, np.ndarray, np.ndarray],
    ) -> tuple:
        """What control_step asks for after the finger controls."""
        model, data = self.model, self.data
        dofs = model.jnt_dofadr[arm]
        qpos = model.jnt_qposadr[arm]
        return (
            np.array([qpos, dofs, arm_actuator], np.int64), mass_addresses(model, dofs), np.array(finger_actuator, np.int64),
            self._site, int(model.body_rootid[model.site_bodyid[self._site]]), self.start[qpos],
            model.actuator_ctrlrange[arm_actuator, 1].copy(), float(base[0]),
            *(np.array(vector, float) for vector in base[1:]),
            data.qpos, data.qvel, data.ctrl, data.qfrc_bias, data.qM, data.site_xpos, data.site_xmat, data.cdof, data.subtree_com,
        )

    def begin(self, seed: int) -> np.ndarray:
        """Reset to the start that the seed determines; returns the observation (n_obs,)."""
        mujoco.mj_resetData(self.model, self.data)
        self.data.qpos[:] = self.start
        pose, self.goal = self.task.sample_start(np.random.default_rng(seed))
        self.data.qpos[self._object_qpos : self._object_qpos + 7] = pose
        self.command[:] = self.law.preshape
        mujoco.mj_forward(self.model, self.data)
        return self.observe()

    def step(self, action: np.ndarray) -> np.ndarray:
        """Play one policy action (n_act,); returns the next observation (n_obs,)."""
        self.set_command(action)
        self.play_substeps(action, self.substeps, sets_goal=True)
        return self.observe()

    def set_command(self, action: np.ndarray) -> None:
        """Advance the closing command by the finger part of an action (n_act,)."""
        self.command = self.law.advance(self.command, action[6:])

    def play_substeps(self, action: np.ndarray, count: int, sets_goal: bool) -> None:
        """``count`` steps of physics under the arm part of an action (n_act,), which sets the goal at the first or not."""
        osc.control_step(
            self.model._address, self.data._address, count, sets_goal, action[:6], self._osc_goal,
            self.before, self.law.targets(self.command), *self._drive,
        )

    def observe(self) -> np.ndarray:
        """The observation record as a vector (n_obs,)."""
        return _observe(
            *_hand(self.command, CLOSING, self.law.preshape, self._qpos, *self._fingers), self._grasp_position,
            self._grasp_rotation, self._object_position, self._object_rotation, self.goal, START_POSITION, START_ROTATION,
        )

    def aim(self, action: np.ndarray) -> np.ndarray:
        """Position (3,) [m], world, to which OSC would pull the grasp frame during a step with this action (n_act,)."""
        joint, follows, axis = self._drive[0][0, 0], self._drive[7], self._drive[8]
        base = osc.base_rotation(follows, self._qpos[joint] - self.start[joint], axis)
        return self.grasp_position + base @ (osc.POSITION_SCALE * np.clip(action[:3], -1.0, 1.0))

    @property
    def grasp_position(self) -> np.ndarray:
        """(3,) [m], world."""
        return np.array(self._grasp_position)

    @property
    def object_position(self) -> np.ndarray:
        """(3,) [m], world; a view."""
        return self._object_position

    @property
    def at_goal(self) -> bool:
        """Whether the object is at the goal now."""
        return _at_goal(self._object_position, self.goal, self.task.goal_tolerance)

    @property
    def lost(self) -> bool:
        """Whether the object has fallen off the table."""
        return is_lost(self._object_position)

    @property
    def torque_share(self) -> float:
        """Largest share of its limit that an arm joint's torque takes now; NaN if one is no number."""
        actuator, limit = self._drive[0][2], self._drive[6]
        return float(np.max(np.abs(self.data.ctrl[actuator]) / limit))

    @property
    def diverged(self) -> bool:
        """Whether MuJoCo warned of a bad state, or a joint of the robot moves impossibly fast."""
        return _exploded(self._qvel, self._warnings, WATCHED_WARNINGS, SPEED_LIMIT)


def blew_up(data: mujoco.MjData) -> bool:
    """As ``Plant.diverged``, of any simulation: MuJoCo resets a bad state and goes on, so that only its warnings still tell."""
    return _exploded(data.qvel, data.warning.number, WATCHED_WARNINGS, SPEED_LIMIT)


@osc.compiled
def all_finite(first: np.ndarray, second: np.ndarray) -> bool:
    """Whether no entry of two vectors is NaN or infinite."""
    for value in first:
        if not math.isfinite(value):
            return False
    for value in second:
        if not math.isfinite(value):
            return False
    return True


def mass_addresses(model: mujoco.MjModel, dofs: np.ndarray) -> np.ndarray:
    """Where the mass matrix's entries (n, n) between degrees of freedom (n,) of one chain stand in mjData.qM.

    A row of qM holds the degree of freedom itself, then its ancestors towards the root (MuJoCo, computation, sparse qM).

    Raises:
        ToolkitError: the degrees of freedom do not follow one another along a chain.
    """
    out = np.empty((len(dofs), len(dofs)), np.int64)
    place = {int(dof): i for i, dof in enumerate(dofs)}
    for i, dof in enumerate(map(int, dofs)):
        above, address, met = dof, int(model.dof_Madr[dof]), 0
        while above >= 0:
            if above in place:
                out[i, place[above]] = out[place[above], i] = address
                met += 1
            above, address = int(model.dof_parentid[above]), address + 1
        if met != i + 1:
            name = model.joint(model.dof_jntid[dof]).name
            raise ToolkitError(f"the arm's joint {name!r} does not follow the arm's others along one chain; list them base first")
    return out


def merged_arm_plant(merged: MergedRobot, alpha: np.ndarray, model: mujoco.MjModel, data: mujoco.MjData) -> Plant:
    """F(alpha) as a plant; patches ``model`` in place (see MergedRobot.become)."""
    course = merged.become(alpha, model, data)
    theta = merged.space.theta(alpha)
    slots = merged.space.matching.slots
    arm_size = merged.space.matching.arm_size
    index = {slot.name: i for i, slot in enumerate(slots)}
    roles = [index[role] for role in COMMANDED_ROLES]
    driven = [slot.name for slot in slots if slot.name in ROLE_COMMAND]
    law = CommandLaw(
        common=float(theta["common"][0, 0]), gain=float(10.0 ** theta["log_gain"][0, 0]),
        leak=float(theta["leak"][0, 0]), rate=float(10.0 ** theta["log_rate"][0, 0]),
        preshape=float(theta["preshape"][0, 0]), course=course,
        role=np.array([COMMANDED_ROLES.index(ROLE_COMMAND[role]) for role in driven]),
    )
    base = (
        theta["base_follows"][0, 0], model.jnt_axis[model.joint(slots[0].name).id], theta["anchor"][0],
        theta["base_position"][0],
    )
    present = theta["freeze"][roles, 0] < 1.0
    fingers = [(int(model.jnt_qposadr[model.joint(role).id]) if here else -1, 1.0, 0.0)
               for role, here in zip(COMMANDED_ROLES, present, strict=True)]
    return Plant(
        model, data, [model.joint(slots[i].name).id for i in range(arm_size)],
        [model.actuator(slots[i].name).id for i in range(arm_size)], [model.actuator(role).id for role in driven],
        "grasp", np.array(model.qpos0), fingers, law, base, "object", merged.task,
    )


def command_law(robot: Robot) -> CommandLaw:
    """The command law of a robot's own gripper, targets in its own joint angles, one per actuator in card order."""
    gripper = robot.gripper
    hand = gripper.rate is None
    targets = np.array([gripper.targets[role] for role in gripper.targets])
    return CommandLaw(
        common=float(not hand), gain=10.0 ** (HAND_LOG_GAIN if hand else GRIPPER_LOG_GAIN), leak=float(hand),
        rate=HAND_RATE if gripper.rate is None else gripper.rate, preshape=gripper.preshape, course=Course.straight(*targets.T),
        role=np.array([COMMANDED_ROLES.index(ROLE_COMMAND[role]) for role in gripper.targets]),
    )


def finger_map(robot: Robot, model: mujoco.MjModel, data: mujoco.MjData) -> list[tuple[int, float, float]]:
    """For each commanded role: qpos address (-1 if absent), sign and start angle [rad] in the native scene.

    ``data`` stands at the start posture, frames computed.
    """
    joints, start = role_joints(model, robot), start_of(robot)
    signs = {role: finger_sign(robot, role, np.array(data.xaxis[joint])) for role, joint in joints.items()}
    angle = dict(zip(NativeScene(model).fingers, () if start.fingers is None else start.fingers, strict=True))
    return [
        (int(model.jnt_qposadr[joints[role]]), signs[role], float(angle[joints[role]])) if role in joints else (-1, 1.0, 0.0)
        for role in COMMANDED_ROLES
    ]


def native_arm_plant(robot: Robot, task: PickTask) -> Plant:
    """The unmodified robosuite robot as a plant for the fast engine."""
    env = native_env(robot, task)
    env.begin(0)
    model, data = env.sim.model._model, env.sim.data._data
    mujoco.mj_forward(model, data)
    scene = NativeScene(model)
    frame = scene.osc_base(data)
    base = (float(frame[0]), *frame[1:])
    actuators = role_actuators(model, robot)
    plant = Plant(
        model, data, scene.arm, scene.arm_actuators, [actuators[role] for role in robot.gripper.targets], GRIP_SITE,
        np.array(data.qpos), finger_map(robot, model, data), command_law(robot), base, env.item.root_body, task,
    )
    plant.env = env  # robosuite's wrapper owns the mjData; keep it alive
    return plant

"""A plant: one compiled robot in its task, with everything the compiled control step needs to drive and observe it."""

from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np

from grippers.gripper import CLOSING_ROLES, COMMANDED_ROLES, ROLE_COMMAND
from robots.robot import Robot
from tasks.pick import START_POSITION, START_ROTATION, PickTask, observe, sine_of_rotation
from toolkit.morphology.build import MergedRobot
from toolkit.morphology.matching import BASE_SITE, finger_sign
from toolkit.morphology.posture import GRIP_SITE, arm_joints, native_env, role_actuators, role_joints, start_of
from toolkit.morphology.space import GRIPPER_LOG_GAIN, HAND_LOG_GAIN, HAND_RATE
from toolkit.simulation import osc

CLOSING = np.array([COMMANDED_ROLES.index(role) for role in CLOSING_ROLES])
"""Indices of the closing roles among the commanded ones."""
WATCHED_WARNINGS = (
    mujoco.mjtWarning.mjWARN_BADQPOS, mujoco.mjtWarning.mjWARN_BADQVEL, mujoco.mjtWarning.mjWARN_BADQACC,
    mujoco.mjtWarning.mjWARN_INERTIA, mujoco.mjtWarning.mjWARN_BADCTRL,
)  # fmt: skip
"""MuJoCo warnings that mean a simulation has diverged."""
SPEED_LIMIT = 200.0
"""Speed [rad/s or m/s] of any joint from which a simulation counts as exploded."""


@dataclass
class CommandLaw:
    """How finger actions become position targets: s+ = clip(s + clip(K u - leak s, -rate, rate), -1, 1).

    u is each role's own action, blended by ``common`` with the mean action of the closing roles. A hand has K = leak = 1:
    s follows the action at its rate. robosuite's grippers integrate the sign of one action: common 1, leak 0, K large.

    Attributes:
        common: 0 every role its own action, 1 one closing action for all.
        gain: K.  leak: pull of s to zero.  rate: largest change of s per policy step.
        preshape: s at the start of an episode.
        opened, closed: position targets [rad, m for slides] (n_actuators,) at s = -1 and s = +1.
        role: index (n_actuators,) into the commanded roles.
    """

    common: float
    gain: float
    leak: float
    rate: float
    preshape: float
    opened: np.ndarray
    closed: np.ndarray
    role: np.ndarray

    def advance(self, state: np.ndarray, action: np.ndarray) -> np.ndarray:
        """Next s (n_roles,) from s and the finger actions (n_roles,)."""
        u = (1.0 - self.common) * action + self.common * action[CLOSING].mean()
        return np.clip(state + np.clip(self.gain * u - self.leak * state, -self.rate, self.rate), -1.0, 1.0)

    def progress(self, state: np.ndarray) -> float:
        """How far the closing roles have closed since the start, from -1 (the preshape) to +1 (closed), at s (n_roles,)."""
        return float(2.0 * (state[CLOSING].mean() - self.preshape) / (1.0 - self.preshape) - 1.0)

    def targets(self, state: np.ndarray) -> np.ndarray:
        """Position targets (n_actuators,) [rad] at s (n_roles,)."""
        return self.opened + 0.5 * (state[self.role] + 1.0) * (self.closed - self.opened)


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
    """

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
        self._arm_qpos = np.array(model.jnt_qposadr[list(arm)], np.int64)
        self._arm_dof = np.array(model.jnt_dofadr[list(arm)], np.int64)
        self._arm_actuator = np.array(arm_actuator, np.int64)
        self._finger_actuator = np.array(finger_actuator, np.int64)
        self._site = model.site(site).id
        address = np.array([f[0] for f in fingers])
        self._present = address >= 0
        self._finger_qpos = address[self._present]
        self._finger_sign = np.array([f[1] for f in fingers])[self._present]
        self._finger_start = np.array([f[2] for f in fingers])[self._present]
        self._base = (float(base[0]), *(np.ascontiguousarray(v, float) for v in base[1:]))
        self._object = model.body(object_body).id
        joint = int(model.body_jntadr[self._object])
        self._object_qpos = int(model.jnt_qposadr[joint])
        self._object_dof = int(model.jnt_dofadr[joint])
        self._substeps = int(round(1.0 / task.control_frequency / model.opt.timestep))
        self.command = np.zeros(len(COMMANDED_ROLES))
        self.goal = np.zeros(3)

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
        self.command = self.law.advance(self.command, action[6:])
        model, data = self.model, self.data
        osc.control_step(
            model._address, data._address, self._substeps, action[:6], self.law.targets(self.command),
            self._arm_qpos, self._arm_dof, self._arm_actuator, self._finger_actuator, self._site,
            self.start[self._arm_qpos], model.actuator_ctrlrange[self._arm_actuator, 1], *self._base,
            data.qpos, data.qvel, data.ctrl, data.qfrc_bias, data.qM, data.site_xpos, data.site_xmat,
        )  # fmt: skip
        return self.observe()

    def observe(self) -> np.ndarray:
        """The observation record as a vector (n_obs,)."""
        fingers = np.zeros(len(COMMANDED_ROLES))
        fingers[self._present] = self._finger_sign * (self.data.qpos[self._finger_qpos] - self._finger_start)
        rotation = self.data.site_xmat[self._site].reshape(3, 3) @ START_ROTATION.T
        return observe(
            fingers, self.law.progress(self.command), self.data.site_xpos[self._site], sine_of_rotation(rotation),
            self.object_position, sine_of_rotation(self.data.xmat[self._object].reshape(3, 3)), self.goal, START_POSITION,
        )  # fmt: skip

    @property
    def object_position(self) -> np.ndarray:
        """(3,) [m], world."""
        return self.data.xpos[self._object]

    @property
    def diverged(self) -> bool:
        """Whether MuJoCo warned of a bad state, or a joint of the robot moves impossibly fast."""
        if any(self.data.warning[w].number for w in WATCHED_WARNINGS):
            return True
        speed = np.abs(self.data.qvel).max()
        return not np.isfinite(speed) or speed > SPEED_LIMIT


def merged_plant(merged: MergedRobot, alpha: np.ndarray, model: mujoco.MjModel, data: mujoco.MjData) -> Plant:
    """F(alpha) as a plant; patches ``model`` in place (see MergedRobot.become)."""
    merged.become(alpha, model, data)
    theta = merged.space.theta(alpha)
    slots = merged.space.matching.slots
    arm_size = merged.space.matching.arm_size
    index = {slot.name: i for i, slot in enumerate(slots)}
    roles = [index[role] for role in COMMANDED_ROLES]
    driven = [slot.name for slot in slots if slot.name in ROLE_COMMAND]
    targets = theta["target"][[index[role] for role in driven]]
    law = CommandLaw(
        common=float(theta["common"][0, 0]), gain=float(10.0 ** theta["log_gain"][0, 0]),
        leak=float(theta["leak"][0, 0]), rate=float(10.0 ** theta["log_rate"][0, 0]),
        preshape=float(theta["preshape"][0, 0]), opened=targets[:, 0], closed=targets[:, 1],
        role=np.array([COMMANDED_ROLES.index(ROLE_COMMAND[role]) for role in driven]),
    )  # fmt: skip
    base = (
        theta["base_follows"][0, 0], model.jnt_axis[model.joint(slots[0].name).id], theta["anchor"][0],
        theta["base_position"][0],
    )  # fmt: skip
    present = theta["freeze"][roles, 0] < 1.0
    fingers = [(int(model.jnt_qposadr[model.joint(role).id]) if here else -1, 1.0, 0.0)
               for role, here in zip(COMMANDED_ROLES, present, strict=True)]  # fmt: skip
    return Plant(
        model, data, [model.joint(slots[i].name).id for i in range(arm_size)],
        [model.actuator(slots[i].name).id for i in range(arm_size)], [model.actuator(role).id for role in driven],
        "grasp", np.array(model.qpos0), fingers, law, base, "object", merged.task,
    )  # fmt: skip


def command_law(robot: Robot) -> CommandLaw:
    """The command law of a robot's own gripper, targets in its own joint angles, one per actuator in card order."""
    gripper = robot.gripper
    hand = gripper.rate is None
    targets = np.array([gripper.targets[role] for role in gripper.targets])
    return CommandLaw(
        common=float(not hand), gain=10.0 ** (HAND_LOG_GAIN if hand else GRIPPER_LOG_GAIN), leak=float(hand),
        rate=HAND_RATE if hand else gripper.rate, preshape=gripper.preshape, opened=targets[:, 0], closed=targets[:, 1],
        role=np.array([COMMANDED_ROLES.index(ROLE_COMMAND[role]) for role in gripper.targets]),
    )  # fmt: skip


def finger_map(robot: Robot, model: mujoco.MjModel, data: mujoco.MjData) -> list[tuple[int, float, float]]:
    """For each commanded role: qpos address (-1 if absent), sign and start angle [rad] in the native scene.

    ``data`` stands at the start posture, frames computed.
    """
    joints, start = role_joints(model, robot), start_of(robot)
    signs = {role: finger_sign(robot, role, np.array(data.xaxis[joint])) for role, joint in joints.items()}
    own = [j for j in range(model.njnt) if model.joint(j).name.startswith("gripper0_right_")]
    angle = dict(zip(own, start.fingers, strict=True))
    return [
        (int(model.jnt_qposadr[joints[role]]), signs[role], float(angle[joints[role]])) if role in joints else (-1, 1.0, 0.0)
        for role in COMMANDED_ROLES
    ]


def native_plant(robot: Robot, task: PickTask) -> Plant:
    """The unmodified robosuite robot as a plant for the fast engine."""
    env = native_env(robot, task)
    env.begin(0)
    model, data = env.sim.model._model, env.sim.data._data
    mujoco.mj_forward(model, data)
    arm = arm_joints(model)
    site = model.site(BASE_SITE)
    follows = float(model.body_jntadr[model.site_bodyid[site.id]] == arm[0])
    base = (follows, np.array(data.xaxis[arm[0]]), np.array(data.xanchor[arm[0]]), np.array(data.site_xpos[site.id]))
    actuators = role_actuators(model, robot)
    plant = Plant(
        model, data, arm, list(range(len(arm))), [actuators[role] for role in robot.gripper.targets], GRIP_SITE,
        np.array(data.qpos), finger_map(robot, model, data), command_law(robot), base, env.item.root_body, task,
    )  # fmt: skip
    plant.env = env  # robosuite's wrapper owns the mjData; keep it alive
    return plant

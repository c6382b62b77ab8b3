"""Parity: how far F(beta_robot) is from the unmodified robosuite robot, in figures.

Every figure is a deterministic measurement of two simulations side by side. What the merge changes by design shows in
them: a merged gripper has no meshes, no contact with itself, and open chains in place of four-bar linkages.
"""

import copy
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from time import perf_counter

import mujoco
import numpy as np

from grippers.gripper import COMMANDED_ROLES, DIGIT_OF, ROLE_COMMAND, ROLES
from robots.robot import Robot
from tasks.pick import ACTION_SIZE, PickTask
from toolkit.errors import ToolkitError
from toolkit.morphology.build import MergedRobot
from toolkit.morphology.lab import Merged
from toolkit.morphology.linkage import CLOSING_STEP, CLOSING_STEPS, SETTLED, SQUEEZE, become_box, clamp, jaws_meet
from toolkit.morphology.matching import CUBE, System
from toolkit.morphology.native_scene import GRIPPER_PREFIX, NativeScene, role_actuators, role_joints, welded_bodies
from toolkit.simulation.laws import merged_plant, native_plant
from toolkit.simulation.plant import Plant

CONFIGURATIONS = 100
"""Random arm configurations for the forward kinematics and the mass matrix."""
COMMANDS = tuple(np.linspace(-1.0, 1.0, 9))
"""Closing commands at which pads are compared."""
SETTLING = 0.1
"""Time [s] at each closing command before pads are compared."""
WIDTH = 0.05
"""Width [m] of the box for the pad force, between the pads."""
NEARLY, PARTS, WAITING = 0.9, 5, 10
"""Share of the way that counts as closed; samples per policy step; policy steps that a lagging finger is given at the end."""
PAD_FINGERS = ("FF", "TH", "RF")
"""Fingers whose pads are compared, where the robot has them."""
START_SEED = 0
CHANGES = 200
"""Changes of robot over which F's median time is taken."""


@dataclass(frozen=True)
class Side:
    """One of the two robots that are compared: its plant, and where its parts are in the model.

    Attributes:
        site: of the grasp frame.
        arm: joint ids from base to flange.
        fingers: actuator ids, in the order of the plant's command law.
        pads: finger -> geom id of its outermost pad: the last primitive on the finger's last link.
        jaws: masks (nbody,) of the bodies of the thumb and of the other fingers; None: the gripper has no contact with itself.
        item: body id of the object.
    """

    plant: Plant
    site: int
    arm: list[int]
    fingers: list[int]
    pads: dict[str, int]
    jaws: tuple[np.ndarray, np.ndarray] | None
    item: int

    def clamped(self) -> tuple[mujoco.MjModel, mujoco.MjData]:
        """A copy at the start with the arm held still, to be stepped without touching the plant."""
        model = copy.copy(self.plant.model)
        clamp(model, model.jnt_dofadr[self.arm])
        data = mujoco.MjData(model)
        data.qpos[:] = self.plant.data.qpos
        return model, data

    def close_to(self, model: mujoco.MjModel, data: mujoco.MjData, command: float, seconds: float) -> None:
        """Simulate with every finger at one closing command."""
        data.ctrl[self.fingers] = self.plant.law.targets(np.full(len(COMMANDED_ROLES), command))
        mujoco.mj_step(model, data, int(round(seconds / model.opt.timestep)))
        mujoco.mj_forward(model, data)

    def closings(self, commands: Sequence[float]) -> Iterator[tuple[mujoco.MjData, bool]]:
        """For each of the rising commands: closed from the start to it at the gripper's own rate, and settled; whether the thumb has
        touched another finger. The way there is walked once, and left at each command by a copy."""
        model, data = self.clamped()
        law, before, met = self.plant.law, np.full(len(COMMANDED_ROLES), self.plant.law.preshape), False
        step = int(round(1.0 / self.plant.task.control_frequency / model.opt.timestep))
        settling = int(round(SETTLING / model.opt.timestep))
        for command in commands:
            while (after := law.advance(before, np.ones_like(before))).max() < command:
                met = self._close(model, data, float(after[0]), step) or met
                before = after
            settled, touched = copy.copy(data), False
            if before.max() < command:
                touched = self._close(model, settled, min(float(after[0]), command), step)
            touched = self._close(model, settled, command, settling) or touched
            yield settled, met or touched

    def _close(self, model: mujoco.MjModel, data: mujoco.MjData, command: float, steps: int) -> bool:
        """Simulate a number of physics steps at one closing command; whether the thumb touched another finger after any of them."""
        data.ctrl[self.fingers] = self.plant.law.targets(np.full(len(COMMANDED_ROLES), command))
        met = False
        for _ in range(steps):
            mujoco.mj_step(model, data)
            mujoco.mj_fwdPosition(model, data)  # contacts and poses of the state after the step
            met = met or self.jaws_met(model, data)
        return met

    def jaws_met(self, model: mujoco.MjModel, data: mujoco.MjData) -> bool:
        """Whether the thumb touches another finger."""
        return self.jaws is not None and jaws_meet(model, data, self.jaws)

    def pad_poses(self, data: mujoco.MjData) -> dict[str, tuple[np.ndarray, np.ndarray]]:
        """Finger -> position (3,) [m] and rotation (3, 3) of its pad in the grasp frame."""
        frame, origin = data.site_xmat[self.site].reshape(3, 3), data.site_xpos[self.site]
        return {
            finger: (frame.T @ (data.geom_xpos[geom] - origin), frame.T @ data.geom_xmat[geom].reshape(3, 3))
            for finger, geom in self.pads.items()
        }


# ---- the two sides ---------------------------------------------------------------------------------------------------


def _last_role(robot: Robot, finger: str) -> str | None:
    """The outermost link of a finger that the robot has; inner knuckles apart."""
    own = (*robot.gripper.joints, *robot.gripper.welded)
    roles = [role for role in ROLES if DIGIT_OF[role].name == finger and role in DIGIT_OF[role].chain and role in own]
    return roles[-1] if roles else None


def _native_side(robot: Robot, task: PickTask) -> Side:
    """The unmodified robosuite robot."""
    plant = native_plant(robot, task)
    plant.begin(START_SEED)
    model = plant.model
    joints, actuators = role_joints(model, robot), role_actuators(model, robot)
    body_of = {role: int(model.jnt_bodyid[joint]) for role, joint in joints.items()} | welded_bodies(model, robot)
    pads = {}
    for finger in PAD_FINGERS:
        role = _last_role(robot, finger)
        geoms = [] if role is None else [
            g for g in range(model.ngeom)
            if _link(model, int(model.geom_bodyid[g]), body_of.values()) == body_of[role] and _is_pad(model, g)
        ]
        if geoms:
            pads[finger] = geoms[-1]
    thumb = [body for role, body in body_of.items() if DIGIT_OF[role].opposes]
    others = [body for role, body in body_of.items() if not DIGIT_OF[role].opposes]
    jaws = (np.isin(np.arange(model.nbody), thumb), np.isin(np.arange(model.nbody), others))
    fingers = [actuators[role] for role in robot.gripper.targets]
    scene = NativeScene(model)
    return Side(plant, scene.grip_site, scene.arm, fingers, pads, jaws, plant.object_body)


def _link(model: mujoco.MjModel, body: int, links: Collection[int]) -> int:
    """The nearest of ``links`` from a body upwards, itself included; 0 if there is none."""
    while body and body not in links:
        body = int(model.body_parentid[body])
    return body


def _is_pad(model: mujoco.MjModel, geom: int) -> bool:
    """Whether a geom is a collision primitive of the gripper: what the merge keeps."""
    collides = bool(model.geom_contype[geom] | model.geom_conaffinity[geom])
    primitive = model.geom_type[geom] != mujoco.mjtGeom.mjGEOM_MESH
    return collides and primitive and model.geom(geom).name.startswith(GRIPPER_PREFIX)


def _merged_side(merged: MergedRobot, index: int) -> Side:
    """F(beta) of the robot at ``index``."""
    space, matching = merged.space, merged.space.matching
    plant = merged_plant(merged, space.betas[index], *merged.new())
    plant.begin(START_SEED)
    model, robot = plant.model, matching.systems[index].robot
    pads = {}
    for finger in PAD_FINGERS:
        role = _last_role(robot, finger)
        shapes = [s for s in space.shape_slots if matching.slots[s.slot].name == role and s.owners[index] is not None]
        if shapes:  # the robot's own order, which sorting by kind may have lost
            order = [id(shape) for shape in matching.systems[index].shapes]
            pads[finger] = model.geom(max(shapes, key=lambda s: order.index(id(s.read[index]))).name).id
    system = matching.systems[index]
    arm = [model.joint(slot.name).id for i, slot in enumerate(matching.slots[: matching.arm_size]) if system.present(i)]
    fingers = [model.actuator(slot.name).id for slot in matching.slots if slot.name in ROLE_COMMAND]
    return Side(plant, model.site("grasp").id, arm, fingers, pads, None, model.body("object").id)


# ---- figures ---------------------------------------------------------------------------------------------------------


def parity(merged: MergedRobot, robot: Robot) -> dict[str, str | float]:
    """Measure F(beta) of a robot against the unmodified robosuite robot.

    Args:
        merged: the merged robot in its task.
        robot: one of its robots.

    Returns:
        name;
        arm_fk_error_m: largest distance of the grasp frames over 100 random arm configurations within the limits;
        arm_mass_matrix_rel_error: largest entry of the difference of the arm's mass matrices over the largest entry of
        the robot's own, fingers at their start, over the same configurations;
        pad_position_error_m, pad_angle_error_deg: largest difference of the fingers' last pads in the grasp frame, both
        grippers closed from open to the same commands at the gripper's own rate, as in a task, in free air with the arm held
        still, until the robot's own thumb touches a finger;
        pad_force_rel_error: see ``squeeze``; the difference relative to the robot's own force;
        closing_time_difference_steps: see ``closing_steps``; the difference in policy steps;
        grasp_frame_drift_m: largest distance of the grasp frames during 1 s of the same random OSC commands in free
        space, gripper open.

    Raises:
        ToolkitError: the robot is not part of the merged robot.
    """
    names = merged.space.matching.names
    if robot.name not in names:
        raise ToolkitError(f"robot {robot.name!r} is not in this merged robot; it has {', '.join(names)}")
    index = names.index(robot.name)
    mine, own = _merged_side(merged, index), _native_side(robot, merged.task)
    fk, mass = arm_errors(mine, own, merged.space.matching.systems[index])
    position, angle = pad_errors(mine, own)
    force, own_force = squeeze(mine), squeeze(own)
    return {
        "name": robot.name,
        "arm_fk_error_m": fk,
        "arm_mass_matrix_rel_error": mass,
        "pad_position_error_m": position,
        "pad_angle_error_deg": angle,
        "pad_force_rel_error": abs(force - own_force) / max(own_force, 1e-9),
        "closing_time_difference_steps": float(abs(np.subtract(*closing_steps(mine, own)))),
        "grasp_frame_drift_m": drift(mine, own),
    }


def arm_errors(mine: Side, own: Side, system: System) -> tuple[float, float]:
    """Largest grasp frame distance [m] and relative arm mass matrix error over random configurations."""
    rng = np.random.default_rng(START_SEED)
    joints = [joint for joint in system.joints if joint is not None][: len(own.arm)]  # arm slots come first
    sign, start = np.array([j.sign for j in joints]), np.array([j.start for j in joints])
    limited = own.plant.model.jnt_limited[own.arm][:, None].astype(bool)
    low, high = np.where(limited, own.plant.model.jnt_range[own.arm], (-np.pi, np.pi)).T
    pair = [(side, mujoco.MjData(side.plant.model)) for side in (mine, own)]
    for side, data in pair:
        data.qpos[:] = side.plant.data.qpos
    worst_fk = worst_mass = 0.0
    for _ in range(CONFIGURATIONS):
        angles = rng.uniform(low, high)
        frames, matrices = [], []
        for (side, data), arm in zip(pair, (sign * (angles - start), angles), strict=True):
            model, dofs = side.plant.model, side.plant.model.jnt_dofadr[side.arm]
            data.qpos[model.jnt_qposadr[side.arm]] = arm
            mujoco.mj_forward(model, data)
            full = np.empty((model.nv, model.nv))
            mujoco.mj_fullM(model, full, data.qM)
            frames.append(np.array(data.site_xpos[side.site]))
            matrices.append(full[np.ix_(dofs, dofs)])
        off = np.abs(sign[:, None] * matrices[0] * sign - matrices[1]).max() / np.abs(matrices[1]).max()
        worst_fk = max(worst_fk, float(np.linalg.norm(frames[0] - frames[1])))
        worst_mass = max(worst_mass, float(off))
    return worst_fk, worst_mass


def pad_errors(mine: Side, own: Side) -> tuple[float, float]:
    """Largest pad position error [m] and angle error [degrees] from open until the robot's own jaws meet."""
    position = angle = 0.0
    for (theirs, met), (ours, _) in zip(own.closings(COMMANDS), mine.closings(COMMANDS), strict=True):
        if met:
            break
        poses = [mine.pad_poses(ours), own.pad_poses(theirs)]
        for finger in own.pads:
            (p, P), (q, Q) = poses[0][finger], poses[1][finger]
            position = max(position, float(np.linalg.norm(p - q)))
            # The merged robot may describe the same solid by other axes of its own.
            apart = min(np.linalg.norm(P - Q @ turn) for turn in CUBE.as_matrix())
            # Stable for tiny angles, where the arc cosine of the trace is not.
            angle = max(angle, float(np.rad2deg(2.0 * np.arcsin(min(1.0, apart / np.sqrt(8.0))))))
    return position, angle


def squeeze(side: Side, width: float = WIDTH) -> float:
    """Stall force [N]: sum of the normal contact forces on a box ``width`` [m] wide, 1.5 s after the full closing command.

    The box is fixed in the grasp frame's origin, its narrow side along the closing axis, and nearly without friction,
    so that the stall is one state and not one of many. The arm is held still and nothing weighs anything. The gripper
    closes from its start within 0.5 s, whatever its own rate. Meshes of the robosuite gripper that touch the box count.
    """
    model, data = side.clamped()
    become_box(model, side.item, width)
    address = int(model.jnt_qposadr[model.body_jntadr[side.item]])
    data.qpos[address : address + 7] = (*side.plant.data.site_xpos[side.site], 1.0, 0.0, 0.0, 0.0)
    start = side.plant.law.preshape
    for command in np.linspace(start, 1.0, CLOSING_STEPS + 1)[1:]:
        side.close_to(model, data, command, CLOSING_STEP)
    side.close_to(model, data, 1.0, SQUEEZE - SETTLED)
    samples = []
    for _ in range(int(round(SETTLED / model.opt.timestep))):
        mujoco.mj_step(model, data)
        samples.append(_force_on(model, data, side.item))
    return float(np.mean(samples))


def closing_steps(mine: Side, own: Side) -> tuple[float, float]:
    """Policy steps that either gripper takes, told to close at once, for nine tenths of the own one's way in free air.

    The way is that of index and thumb pad towards each other, until the own jaws meet or the closing command is spent.
    """
    law = own.plant.law
    theirs = _gaps(own, int(np.ceil((1.0 - law.preshape) / law.rate)) + WAITING)
    ours = _gaps(mine, len(theirs) // PARTS + WAITING)
    nearly = theirs[0] - NEARLY * (theirs[0] - theirs.min())
    reached = [float(np.argmax(gaps <= nearly)) / PARTS if gaps.min() <= nearly else np.inf for gaps in (ours, theirs)]
    return reached[0], reached[1]


def _gaps(side: Side, steps: int) -> np.ndarray:
    """Distance [m] of index and thumb pad, PARTS times per policy step, while closing until the jaws meet."""
    model, data = side.clamped()
    law, out = side.plant.law, []
    command = np.full(len(COMMANDED_ROLES), law.preshape)
    part = int(round(1.0 / side.plant.task.control_frequency / model.opt.timestep / PARTS))
    for _ in range(steps):
        command = law.advance(command, np.ones(len(COMMANDED_ROLES)))
        data.ctrl[side.fingers] = law.targets(command)
        for _ in range(PARTS):
            mujoco.mj_step(model, data, part)
            pads = [data.geom_xpos[side.pads[finger]] for finger in ("FF", "TH")]
            out.append(float(np.linalg.norm(np.subtract(*pads))))
            if side.jaws_met(model, data):
                return np.array(out)
    return np.array(out)


def _force_on(model: mujoco.MjModel, data: mujoco.MjData, body: int) -> float:
    """Sum of the normal contact forces [N] on a body."""
    force, total = np.zeros(6), 0.0
    for contact in range(data.ncon):
        geoms = data.contact[contact].geom
        if body in model.geom_bodyid[geoms]:
            mujoco.mj_contactForce(model, data, contact, force)
            total += abs(float(force[0]))
    return total


def drift(mine: Side, own: Side) -> float:
    """Largest distance [m] of the grasp frames in 1 s of the same random OSC commands in free space, gripper open."""
    rng = np.random.default_rng(START_SEED)
    sides = (mine, own)
    for side in sides:
        side.plant.begin(START_SEED)
    worst = 0.0
    for _ in range(int(mine.plant.task.control_frequency)):
        action = np.full(ACTION_SIZE, -1.0)
        action[:6] = np.array([0, 0, 0.4, 0, 0, 0]) + rng.uniform(-0.5, 0.5, 6)  # upwards, off the table
        for side in sides:
            side.plant.step(action)
        places = [side.plant.data.site_xpos[side.site] for side in sides]
        worst = max(worst, float(np.linalg.norm(places[0] - places[1])))
    return worst


def become_milliseconds(merged: Merged) -> float:
    """Median time [ms] of F in place, over changes from robot to robot in turn."""
    model, data = merged.new()
    betas, took = merged.space.betas, []
    for turn in range(CHANGES):
        started = perf_counter()
        merged.become(betas[turn % len(betas)], model, data)
        took.append(1e3 * (perf_counter() - started))
    return float(np.median(took))



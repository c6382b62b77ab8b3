"""The grip in between: what a robot's fingers do on a reference box, and the motors that make them do it.

Numbers that work together do not mean the same when each is interpolated by itself: a motor's limit falls in a straight line
while the spring, the tendon and the friction that it works against rise, and half way nothing is left for the object. So motors
are not interpolated. What is interpolated, in a straight line over alpha, is what a finger does: how hard it presses, where, and
in which posture, when the gripper is closed on a box of BOX_WIDTH. At any alpha the posture's Jacobian tells the torque that each
joint needs for it (principle of virtual work), the robot's springs, tendons and linkages there tell what they take of it, and the
rest is the motor's.

At each robot of the space that is, by construction, the robot's own motor.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import mujoco
import numpy as np

from grippers.gripper import DIGIT_OF, DIGITS, SLIDES, THUMB
from tasks.pick import START_POSITION, START_ROTATION
from toolkit.morphology.arithmetic import rotations
from toolkit.morphology.contact import FROZEN, STAY, YIELDING, gap_of, held, levers, meet, patch_of, place, tilt_of
from toolkit.morphology.linkage import BOX_HALF_SIZE, BOX_WIDTH, SETTLED, closed_on_box
from toolkit.morphology.patch import Patch
from toolkit.morphology.space import EvolutionSpace

MAIN_ROLES = (*SLIDES, *(digit.flexion for digit in DIGITS))
"""Joints whose motors close a finger and may stall; the finger's other joints hold its shape."""
PRESSING = 2.0
"""Pressure [N] from which a finger must touch the box, though at one robot it does not."""
HALF = np.array([BOX_HALF_SIZE[0], BOX_WIDTH / 2, BOX_HALF_SIZE[2]])
"""Half extents [m] of the reference box."""
SIDEWAYS = np.ascontiguousarray(START_ROTATION[:, 1])
"""Axis (3,) about which pads pitch, world."""
STRONGEST = 3.0
"""Torque [N m, N] that every finger motor may be given: as much as ADROIT's. More, only where a robot has more."""
LEEWAY, LEAVING = 0.1, 0.01
"""How far [rad] a joint's limits lie beyond the posture on the box, and the distance from the nearest robot (largest difference of a
finger's alphas) from which on they do."""
HEADROOM = 1.5
"""Share of the torque on the box that a joint's motor can give, at least, where it does not stall."""
TOUCH = 0.05
"""Pressure [N] from which a finger counts as touching the box."""
SHORT = 1e-3
"""Way [rad, m] from the start to a closed target below which a joint does not close."""
TOUCHING, RAMP = (0.1, 0.98), 0.02
"""Shares of that way within which a finger touches the box, and the least that it goes on from there until it presses."""
LED, FIRM, EASING = 3.0, 0.6, 0.1
"""Stiffness [N m/rad] and torque [N m] with which a joint that turns by itself at the robots, as a linkage leads a pad, is led to
where it lies flat; and the distance from the nearest robot (as LEAVING) at which that is whole."""
PADDED = 0.5
"""Part of pads in a finger's contact from which on their tilt is the finger's."""
FEEBLE = 1e-9
"""Torque limit [N m] of an actuator that a robot lacks: MuJoCo refuses none."""
LOCKED = 10.0
"""Stiffness [N m/rad] of a freezing joint's lock that bears half of the joint's torque; the motor bears the rest."""
WEAKEST = 1e-9
"""Stiffness [N m/rad] of an actuator below which it does nothing."""


@dataclass(frozen=True)
class Grasp:
    """What the fingers of one robot do on the reference box.

    Attributes:
        angles: (n_slots,) [rad, m].
        force: (n_fingers,) [N], each finger's own pressure across the jaws.
        point: (n_fingers, 3) [m] where it acts, on the finger's last link, at the start posture, world axes.
    """

    angles: np.ndarray
    force: np.ndarray
    point: np.ndarray


@dataclass(frozen=True)
class Course:
    """Position targets over the closing command: straight to where the fingers touch the box, to where they press, and on to the end.

    Attributes:
        commands: (n, 4) at which the targets turn: -1, touching, pressing, +1.
        targets: (n, 4) [rad, m] there.
    """

    commands: np.ndarray
    targets: np.ndarray

    @classmethod
    def straight(cls, opened: np.ndarray, closed: np.ndarray) -> "Course":
        """A robot's own: linear in the command."""
        ends = np.array([0.0, 1.0, 1.0, 1.0])
        return cls(np.tile([-1.0, 1.0, 1.0, 1.0], (len(closed), 1)), opened[:, None] + (closed - opened)[:, None] * ends)

    @classmethod
    def through(cls, start: np.ndarray, ways: Sequence[np.ndarray], shares: Sequence[np.ndarray], preshape: float) -> "Course":
        """With ``start`` (n,) at the preshape; the three targets ``ways`` after ``shares`` (n,) of the way from there to +1."""
        touching, first = ways[0], shares[0]
        opened = start - (touching - start) * (1.0 + preshape) / (first * (1.0 - preshape))
        commands, targets = np.empty((2, len(start), len(ways) + 1))
        commands[:, 0], targets[:, 0] = -1.0, opened
        for k, (way, share) in enumerate(zip(ways, shares, strict=True), 1):
            commands[:, k], targets[:, k] = preshape + share * (1.0 - preshape), way
        return cls(commands, targets)

    def __call__(self, command: float) -> np.ndarray:
        """Targets (n,)."""
        return np.array([np.interp(command, *row) for row in zip(self.commands, self.targets, strict=True)])


@dataclass(frozen=True)
class Motors:
    """What the law makes of the finger actuators and their joints, one entry per driven slot.

    Attributes:
        course: position targets over the closing command.
        gain: (n,) stiffnesses [N m/rad, N/m].
        limit: (n,) largest torques [N m, N].
        range: (n, 2) limits of the joints [rad, m].
        slips: (n_shapes, 3) [m] by which pads are moved along their links, at the start posture.
    """

    course: Course
    gain: np.ndarray
    limit: np.ndarray
    range: np.ndarray
    slips: np.ndarray


Write = Callable[[np.ndarray, mujoco.MjModel, mujoco.MjData], Patch]


class GraspLaw:
    """Motors of the merged robot's fingers, from what each robot's fingers do on the reference box.

    Args:
        space: the evolution space.
        driven: slots whose joints have actuators, as the merged robot orders them.
        write: F without the strengths of the actuators, in place.
        model, data: a merged robot to measure on.
    """

    def __init__(
        self, space: EvolutionSpace, driven: Sequence[int], write: Write, model: mujoco.MjModel, data: mujoco.MjData
    ) -> None:
        self._space = space
        slots = space.matching.slots
        self._arm = space.matching.arm_size
        self.driven = np.array(driven)
        self.fingers = tuple(dict.fromkeys(slots[i].element for i in self.driven))
        self._finger_of = np.array([self.fingers.index(slots[i].element) for i in self.driven])
        self._tips = np.array([max(i for i in self.driven if slots[i].element == finger) for finger in self.fingers])
        closing = START_ROTATION[:, 0]
        self._push = np.array([-closing if finger == THUMB.name else closing for finger in self.fingers])
        self._main = np.array([slots[i].name in MAIN_ROLES for i in self.driven])
        self._sliding = np.array([slots[i].name in SLIDES for i in self.driven])
        self._slides = np.flatnonzero(self._sliding)
        # Pads lie on the links that both hands and jaws have; the hand's last phalanx, beyond them, is round.
        self._pitching = np.array([slots[i].name not in (*SLIDES, DIGIT_OF[slots[i].name].tip) for i in self.driven])
        self._dimensions = [
            np.unique([p.dimension for p in space.parameters if p.element == finger]).astype(int) for finger in self.fingers
        ]
        # A finger on which no robots differ has no dimension; it shares the first one's, and moves with nothing.
        listed = [d if len(d) else np.zeros(1, int) for d in self._dimensions]
        self._all_dimensions = np.concatenate(listed)
        self._all_betas = space.betas[:, self._all_dimensions]
        self._first_dimension = np.cumsum([0, *(len(d) for d in listed[:-1])])
        self._joints = np.array([model.joint(slots[i].name).id for i in self.driven])
        self._qpos, self._dofs = model.jnt_qposadr[self._joints], model.jnt_dofadr[self._joints]
        self._tip_bodies = np.array([model.body(slots[i].name).id for i in self._tips])
        self._chains()
        self._constraints(model)
        joints = [[system.joints[i] for i in self.driven] for system in space.matching.systems]
        self._own_closed = np.array([[0.0 if joint is None else joint.target_closed for joint in row] for row in joints])
        self._own_limit = np.array([[0.0 if joint is None else joint.force_limit for joint in row] for row in joints])
        self.grasps = [self._measured(robot, write, model, data) for robot in range(len(space.betas))]
        self._presses = np.max([grasp.force for grasp in self.grasps], axis=0) > 0
        self._fit(write, model, data)

    def _chains(self) -> None:
        """The fingers as chains of driven joints, base first, and their collision geoms."""
        shapes = self._space.shape_slots
        index = {slot: k for k, slot in enumerate(self.driven)}
        self._chain = [np.flatnonzero(self._finger_of == f) for f in range(len(self.fingers))]
        carrying = [k for k, shape in enumerate(shapes) if shape.slot in index]
        finger = np.array([self._finger_of[index[shapes[k].slot]] for k in carrying])
        self._carrying, self._carrier = np.array(carrying), np.array([shapes[k].slot for k in carrying])
        self._own_shapes = [np.flatnonzero(finger == f) for f in range(len(self.fingers))]
        self._link = np.array([int(np.flatnonzero(self._chain[f] == index[shapes[k].slot])[0])
                               for k, f in zip(carrying, finger, strict=True)])
        self._faces = self._facing(carrying, finger)
        self._boxes = np.array([shapes[k].kind == mujoco.mjtGeom.mjGEOM_BOX for k in carrying])

    def _facing(self, carrying: Sequence[int], finger: np.ndarray) -> np.ndarray:
        """Axis of each carrying shape that points to the box when its first owner's gripper is closed on it; -1: it is round."""
        out, shapes = np.full(len(carrying), -1), self._space.shape_slots
        for n, (k, f) in enumerate(zip(carrying, finger, strict=True)):
            shape = shapes[k]
            if shape.kind == mujoco.mjtGeom.mjGEOM_BOX:
                first, its = shape.first
                turned = self._space.turn_at_contact(first, shape.slot) @ its.rotation
                out[n] = int(np.argmax(np.abs(turned.T @ self._push[f])))
        return out

    def _solids(self, p: Patch) -> tuple[np.ndarray, ...]:
        """Centres, axes, sizes, kinds and how much they touch of the fingers' geoms at the start posture."""
        centres = p.shape_pos[self._carrying] + p.anchor[self._carrier]
        frames = rotations(p.shape_quat[self._carrying])
        return centres, frames, p.shape_size[self._carrying], self._boxes, p.shape_activity[self._carrying]

    def _nearest(self, p: Patch, angles: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Distances (n_fingers,) [m] of the fingers from the box; of ``points`` (n_fingers, 3) on their last links, at the start posture,
        the heights (n_fingers,) [m], world, and the places (n_fingers, 3), in half extents of what they touch with, from its middle
        (``patch_of``); and the tilts (n_fingers,) [rad] of their pads, NaN without."""
        (gaps, heights, tilts), offs = np.empty((3, len(self.fingers))), np.empty((len(self.fingers), 3))
        solids = self._solids(p)
        for f, chain in enumerate(self._chain):
            turns, shifts, _, _ = place(angles, chain, p.anchor[self.driven], p.axis[self.driven], self._sliding)
            gaps[f], where, shares, _ = gap_of(  # type: ignore[call-arg]  # compiled; what is starred has its length by construction
                turns, shifts, self._own_shapes[f], self._link, *solids, self._push[f], START_POSITION, HALF)
            lean, part = tilt_of(turns, self._own_shapes[f], self._link, solids[1], self._faces, shares, self._push[f], SIDEWAYS)
            tilts[f] = lean if part > PADDED else np.nan
            middle, extent = patch_of(  # type: ignore[call-arg]  # as above
                turns, shifts, self._own_shapes[f], self._link, *solids[:4], shares, where, self._push[f])
            pressed = turns[-1] @ points[f] + shifts[-1]
            heights[f], offs[f] = pressed[2], (pressed - middle) / np.maximum(extent, 1e-9)
        return gaps, heights, offs, tilts

    def _meeting(
        self, p: Patch, angles: np.ndarray, gap: np.ndarray, height: np.ndarray, minding: np.ndarray, tilt: np.ndarray,
        off: np.ndarray,
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """The posture (n_driven,) next to ``angles`` in which the fingers are as far from the box, as high and as flat as asked; where they
        press (n_fingers, 3), ``off`` as ``_nearest`` tells it, on their last links; and how much of each finger is there to touch
        (n_fingers,), 0 to 1."""
        out, points, solids, touches = angles.copy(), p.anchor[self._tips], self._solids(p), np.zeros(len(self.fingers))
        slips = np.zeros_like(p.shape_pos)
        anchors, axes, stay = p.anchor[self.driven], p.axis[self.driven], self._staying(p)
        for f, chain in enumerate(self._chain):
            if not self._presses[f]:
                continue
            out[chain], points[f], touches[f], slips[self._carrying[self._own_shapes[f]]] = meet(  # type: ignore[call-arg]  # as above
                angles, stay, chain, anchors, axes, self._sliding, self._own_shapes[f], self._link,
                *solids, self._push[f], START_POSITION, HALF, SIDEWAYS, self._pitching, self._faces,  # type: ignore[arg-type]
                gap[f], height[f], minding[f], tilt[f], off[f],
            )
        return out, points, touches, slips

    def _staying(self, p: Patch) -> np.ndarray:
        """Weights (n_driven,) of the joints' departures from a guess: those that freeze move less, and a slide no farther than its lock
        lets its motor."""
        out = STAY + FROZEN * p.freeze[self.driven]
        out[self._slides] = STAY + p.lock[self.driven[self._slides]] / YIELDING
        return out

    # ---- the robots' own grasps --------------------------------------------------------------------------------

    def _measured(self, robot: int, write: Write, model: mujoco.MjModel, data: mujoco.MjData) -> Grasp:
        """What a robot's own motors do on the box."""
        slots, beta = self._space.matching.slots, self._space.betas[robot]
        p = write(beta, model, data)
        actuators = [model.actuator(slots[i].name).id for i in self.driven]
        model.actuator_forcerange[actuators] = np.maximum(self._own_limit[robot], FEEBLE)[:, None] * (-1.0, 1.0)
        arm = [model.joint(slot.name).id for slot in slots[: self._arm]]
        own, item = self._own_closed[robot], model.body("object").id
        course = Course.through(p.start_target, [own] * 3, [np.ones(len(own))] * 3, p.preshape)
        bench, data = closed_on_box(model, model.qpos0, arm, item, actuators, course, p.preshape)
        force, moment = np.zeros(len(self.fingers)), np.zeros((len(self.fingers), 3))
        angles, samples = np.zeros(len(slots)), int(round(SETTLED / bench.opt.timestep))
        qpos = bench.jnt_qposadr[[bench.joint(slot.name).id for slot in slots]]
        for _ in range(samples):
            mujoco.mj_step(bench, data)
            self._add_contacts(bench, data, item, force, moment)
            angles += data.qpos[qpos] / samples
        tips = p.anchor[self._tips]
        turns = data.xmat[self._tip_bodies].reshape(-1, 3, 3)
        away = moment / np.maximum(force, 1e-12)[:, None] - data.xpos[self._tip_bodies]
        touched = force > TOUCH * samples
        point = tips + np.einsum("fji,fj->fi", turns, away) * touched[:, None]
        return Grasp(angles, force / samples * touched, point)

    def _add_contacts(
        self, model: mujoco.MjModel, data: mujoco.MjData, item: int, force: np.ndarray, moment: np.ndarray
    ) -> None:
        wrench = np.zeros(6)
        element = {slot.name: slot.element for slot in self._space.matching.slots}
        for index in np.flatnonzero(np.any(model.geom_bodyid[data.contact.geom] == item, axis=1)):
            contact = data.contact[index]
            bodies = model.geom_bodyid[contact.geom]
            finger = element.get(model.body(bodies[0] if bodies[1] == item else bodies[1]).name)
            if finger in self.fingers:
                mujoco.mj_contactForce(model, data, index, wrench)
                normal = contact.frame[:3] * (1.0 if bodies[1] == item else -1.0)
                which = self.fingers.index(finger)
                across = float(wrench[0] * (normal @ self._push[which]))
                force[which] += across
                moment[which] += across * contact.pos

    # ---- straight lines over alpha -----------------------------------------------------------------------------

    def _fit(self, write: Write, model: mujoco.MjModel, data: mujoco.MjData) -> None:
        """The affine maps of least gradient, over each finger's own dimensions, that meet every robot."""
        space, count = self._space, len(self.driven)
        size, robots = space.size, len(self.grasps)
        angles = np.array([grasp.angles[self.driven] for grasp in self.grasps])
        force = np.array([grasp.force for grasp in self.grasps])
        point = np.array([grasp.point for grasp in self.grasps])
        rows, ways, fulls = np.zeros((robots, 4, count)), [], []
        motors, off = np.zeros((robots, count)), np.zeros((robots, len(self.fingers), 3))
        gaps, heights, shares, tilts = np.zeros((4, robots, len(self.fingers)))
        ramps, early, late = np.zeros((robots, len(self.fingers))), np.zeros((robots, count)), np.zeros((robots, count))
        strong, passive = np.zeros((robots, count), bool), np.zeros((robots, count))
        for robot, beta in enumerate(space.betas):
            p = write(beta, model, data)
            angles[robot] *= 1.0 - p.freeze[self.driven]  # what sags in a frozen joint is no posture
            gaps[robot], heights[robot], off[robot], tilts[robot] = self._nearest(p, angles[robot], point[robot])
            off[robot, force[robot] == 0.0] = np.nan
            point[robot] = np.where(self._presses[:, None], point[robot], p.anchor[self._tips])
            stiffness, limit = p.gain, self._own_limit[robot]
            wanted = stiffness * (self._own_closed[robot] - angles[robot])
            own = np.clip(wanted, -limit, limit)
            beyond = np.where(self._main & (stiffness > WEAKEST), wanted - own, 0.0)
            slack = np.where(self._main, limit - own, 0.0)
            needed = self._needed(model, data, p, angles[robot], force[robot], point[robot])
            motors[robot] = own
            way = self._own_closed[robot] - p.start_target
            presses = angles[robot] + own / np.maximum(stiffness, WEAKEST)
            shares[robot], full = (self._share(at - p.start_target, way) for at in (angles[robot], presses))
            full = np.maximum(full, shares[robot] + RAMP)
            ramps[robot] = np.log((full - shares[robot]) * (1.0 - p.preshape) / p.rate)
            early[robot], late[robot] = (at - p.start_target for at in (angles[robot], presses))
            ways.append(way)
            strong[robot] = stiffness > WEAKEST
            passive[robot] = ~strong[robot] & (p.freeze[self.driven] < 1.0)
            fulls.append(full)
            rows[robot] = own - self._borne(p) * needed, beyond / np.maximum(stiffness, WEAKEST), slack, np.minimum(beyond, slack)
        each = np.arange(len(self.fingers))
        # Where a finger presses, and its tilt, are told by the robots whose finger does; the others' are nobody's concern.
        pressing = force > 0
        tilts = self._known(np.where(pressing, tilts, np.nan), 0.0)
        off = self._known(off.reshape(robots, -1), 0.0)
        heights = self._known(np.where(pressing, heights, np.nan), heights.mean(axis=0))
        shares, ramps = self._known(shares, 0.5), self._known(ramps, 0.0)
        filled = self._known(np.array(fulls), 1.0)
        # A joint without a motor has no course of its own to keep to.
        early, late = (
            self._known(np.where(strong, at - part[:, self._finger_of] * np.array(ways), np.nan), 0.0)
            for at, part in ((early, shares), (late, filled))
        )
        self._strongest = np.maximum(np.abs(motors).max(axis=0), STRONGEST)
        blocks = [
            ("angles", angles, self._finger_of), ("force", force, each), ("gap", gaps, each), ("height", heights, each),
            ("tilt", tilts, each),
            ("off", off, np.repeat(each, 3)),
            *((name, rows[:, k], self._finger_of) for k, name in enumerate(("error", "beyond", "slack", "both"))),
            ("limit", self._own_limit, self._finger_of), ("share", shares, each), ("early", early, self._finger_of),
            ("ramp", ramps, each), ("late", late, self._finger_of), ("passive", passive, self._finger_of),
        ]
        values = np.concatenate([block for _, block, _ in blocks], axis=1)
        owners = np.concatenate([owner for _, _, owner in blocks])
        ends = np.cumsum([block.shape[1] for _, block, _ in blocks])
        self._cuts = {name: slice(end - block.shape[1], end) for (name, block, _), end in zip(blocks, ends, strict=True)}
        self._slope = np.zeros((size, values.shape[1]))
        for finger, dimensions in enumerate(self._dimensions):
            mine = np.flatnonzero(owners == finger)
            steps = space.betas[1:, dimensions] - space.betas[0, dimensions]
            self._slope[np.ix_(dimensions, mine)] = np.linalg.pinv(steps, rcond=1e-9) @ (values[1:, mine] - values[0, mine])
        self._offset = values[0] - space.betas[0] @ self._slope
        self._low, self._high = values.min(axis=0), values.max(axis=0)

    def _share(self, part: np.ndarray, way: np.ndarray) -> np.ndarray:
        """(n_fingers,) of its way from the preshape to the closed target that a finger's main joint has gone; NaN: it has none."""
        out = np.full(len(self.fingers), np.nan)
        for k in np.flatnonzero(self._main & (np.abs(way) > SHORT)):
            out[self._finger_of[k]] = np.clip(part[k] / way[k], *TOUCHING)
        return out

    @staticmethod
    def _known(values: np.ndarray, otherwise: float | np.ndarray) -> np.ndarray:
        """(n_robots, n) with the mean over the robots that know it where one does not (NaN); nobody does: ``otherwise``."""
        lacking = np.isnan(values)
        known = np.where(lacking, 0.0, values).sum(axis=0) / np.maximum((~lacking).sum(axis=0), 1)
        return np.where(lacking, np.where(lacking.all(axis=0), otherwise, known), values)

    # ---- the motors --------------------------------------------------------------------------------------------

    def _needed(
        self, model: mujoco.MjModel, data: mujoco.MjData, p: Patch, angles: np.ndarray, force: np.ndarray, point: np.ndarray
    ) -> np.ndarray:
        """Motor torques (n_driven,) [N m, N] in equilibrium with a finger's pressure on the box and its springs, at rest."""
        data.qpos[:] = model.qpos0
        data.qpos[self._qpos] = angles
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_tendon(model, data)
        mujoco.mj_passive(model, data)
        lever = levers(
            self._joints, self._finger_of, self._sliding, data.xaxis, data.xanchor, self._tip_bodies, data.xpos, data.xmat,
            point - p.anchor[self._tips], self._push,
        )
        return lever * force[self._finger_of] - (data.qfrc_spring + self._held(model, data))[self._dofs]

    def _borne(self, p: Patch) -> np.ndarray:
        """Shares (n_driven,) of the torques on joints that their motors bear, not the locks of those that freeze."""
        out = 1.0 / (1.0 + p.lock[self.driven] / LOCKED)
        out[self._slides] = 1.0
        return out

    def _held(self, model: mujoco.MjModel, data: mujoco.MjData) -> np.ndarray:
        """(nv,) torques of the soft constraints on fingers at rest."""
        out = np.zeros(model.nv)
        solimp, time, active, goal = model.eq_solimp, model.eq_solref[:, 0], model.eq_active0, model.eq_data
        if self._tendons is not None:
            e, t = self._tendons
            residual = data.ten_length[t] - model.tendon_length0[t] - goal[e, 0]
            force = held(residual, solimp[e], time[e], model.tendon_invweight0[t], active[e])
            np.add.at(out, self._wrapped, force[self._of_tendon] * model.wrap_prm[self._wraps])
        if self._curves is not None:
            e, pads, drives = self._curves
            x, bend = data.qpos[self._qpos_of[drives]], goal[e, 1:3]
            inverse = model.dof_invweight0[pads] + model.dof_invweight0[drives]
            residual = data.qpos[self._qpos_of[pads]] - bend[:, 0] * x - bend[:, 1] * x * x
            force = held(residual, solimp[e], time[e], inverse, active[e])
            out[pads] += force
            out[drives] -= force * (bend[:, 0] + 2.0 * bend[:, 1] * x)
        return out

    def _constraints(self, model: mujoco.MjModel) -> None:
        """Where the soft constraints stand in the model: on tendons, and on pads that follow curves."""
        tendon = np.flatnonzero(model.eq_type == mujoco.mjtEq.mjEQ_TENDON)
        joint = np.flatnonzero(model.eq_type == mujoco.mjtEq.mjEQ_JOINT)
        self._tendons = (tendon, model.eq_obj1id[tendon]) if len(tendon) else None
        first, count = model.tendon_adr, model.tendon_num
        held = model.eq_obj1id[tendon]
        self._of_tendon = np.repeat(np.arange(len(held)), count[held])
        self._wraps = np.array([wrap for t in held for wrap in range(first[t], first[t] + count[t])], int)
        self._wrapped = model.jnt_dofadr[model.wrap_objid[self._wraps]]
        follow = (joint, model.jnt_dofadr[model.eq_obj1id[joint]], model.jnt_dofadr[model.eq_obj2id[joint]])
        self._curves = follow if len(joint) else None
        self._qpos_of = model.jnt_qposadr[model.dof_jntid]  # of a degree of freedom; the free object's are not asked for

    def _interpolated(self, alpha: np.ndarray) -> np.ndarray:
        """All that the law interpolates, in the order of its cuts."""
        return np.minimum(np.maximum(alpha @ self._slope + self._offset, self._low), self._high)

    def posture(self, alpha: np.ndarray) -> dict[str, float]:
        """Angle [rad, m] of every driven joint by its slot's name, with the gripper closed on the reference box, at ``alpha`` (D,).

        As it is meant there; the posture in which the finger meets the box, next to it, takes a model.
        """
        angles = self._interpolated(alpha)[self._cuts["angles"]] * (1.0 - self._space.theta(alpha)["freeze"][self.driven, 0])
        return {self._space.matching.slots[slot].name: float(angle) for slot, angle in zip(self.driven, angles, strict=True)}

    def motors(self, alpha: np.ndarray, p: Patch, model: mujoco.MjModel, data: mujoco.MjData) -> Motors:
        """The finger actuators at ``alpha`` (D,), in the order of the driven slots.

        Args:
            p: what F writes there.
            model, data: patched; the configuration in ``data`` is overwritten.
        """
        value = self._interpolated(alpha)
        angles, force, gap, height, tilt, off, error, beyond, slack, both, most, share, early, ramp, late, passive = (
            value[cut] for cut in self._cuts.values()
        )
        minding = np.minimum(np.maximum(force / PRESSING, 0.0), 1.0)
        gap = gap - np.maximum(gap, 0.0) * minding
        off = off.reshape(-1, 3)
        angles, points, touches, slips = self._meeting(p, angles * (1.0 - p.freeze[self.driven]), gap, height, minding, tilt, off)
        torque = self._borne(p) * self._needed(model, data, p, angles, touches * force, points) + error
        torque = np.minimum(np.maximum(torque, -self._strongest), self._strongest)
        apart = np.abs(self._all_betas - alpha[self._all_dimensions])
        nearest = np.maximum.reduceat(apart, self._first_dimension, axis=1).min(axis=0)
        away = np.minimum(1.0, nearest / LEAVING)[self._finger_of]
        near = np.minimum(1.0, nearest / EASING)[self._finger_of]
        led = ~self._main * self._presses[self._finger_of] * (1.0 - p.freeze[self.driven]) * passive
        stiffness = np.maximum(p.gain, LED * near * led)
        excess = p.gain * beyond
        shared = np.minimum(excess, slack)
        excess, slack = excess - shared + both, slack - shared + both
        pressing = angles + torque / np.maximum(stiffness, WEAKEST)
        closed = pressing + np.where(self._main, excess, 0.0) / np.maximum(stiffness, WEAKEST)
        full = np.minimum(share + np.exp(ramp) * p.rate / (1.0 - p.preshape), 1.0)
        shares = [share[self._finger_of], full[self._finger_of], np.ones(len(closed))]
        ways = [np.where(stiffness > WEAKEST, way, p.start_target) for way in (angles - early, pressing - late, closed)]
        holding = np.maximum(most, HEADROOM * np.abs(torque) + FIRM * near * led)
        # A gripper may close beyond a limit that is soft on its own light links, and hard on heavier ones.
        own = p.limits[self.driven]
        wide = np.empty_like(own)
        np.minimum(own[:, 0], angles - LEEWAY, out=wide[:, 0])
        np.maximum(own[:, 1], angles + LEEWAY, out=wide[:, 1])
        return Motors(
            course=Course.through(p.start_target, ways, shares, p.preshape),
            gain=stiffness,
            limit=np.maximum(np.where(self._main, np.abs(torque) + slack, holding), FEEBLE),
            range=own + away[:, None] * (wide - own),
            slips=slips,
        )

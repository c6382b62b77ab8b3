"""The evolution space of arms with grippers: what the matched robots are, in named physical parameters.

An element is an arm joint, or a finger with its links. What a robot lacks is absent: no mass, no size, frozen; an absent element borrows
the geometry of the robots that have it, so that only its presence changes.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from grippers.gripper import DIGIT_OF, DIGITS, THUMB
from tasks.pick import START_ROTATION
from toolkit.errors import ToolkitError
from toolkit.morphology.matching import CUBE, UNLIMITED_ANGLE, UNLIMITED_LENGTH, Coupling, Curve, Joint, Matching, Shape, System
from toolkit.morphology.parameters import Field, ParameterSpace

FROZEN_STIFFNESS = 200.0
"""Spring [N m/rad] that holds a frozen joint: 0.1 N m at a fingertip moves it by half a milliradian."""
FROZEN_ARMATURE = 0.1
"""Armature [kg m^2] of a frozen joint: keeps the mass matrix regular when its link has no mass; with the spring, 45 rad/s."""
FROZEN_DAMPING = 2.0 * np.sqrt(FROZEN_STIFFNESS * FROZEN_ARMATURE)
"""Damping [N m s/rad]: critical."""
FREEZE_DECADES = 6.0
"""A joint stiffens over this many decades as its ``freeze`` goes from 0 to 1, so that it fades out before it locks."""
FROZEN_SLIDE_STIFFNESS, FROZEN_SLIDE_ARMATURE = 2e5, 100.0
"""The same [N/m, kg] for a jaw's slide: 100 N at the pads move it by half a millimetre."""
FROZEN_ARM_STIFFNESS, FROZEN_ARM_ARMATURE = 2e6, 1e3
"""The same [N m/rad, kg m^2] for an arm joint: so heavy beside a link that operational-space control, which reads the mass
matrix but not the springs, moves the other joints exactly as if this one were not there (error 1/1000 of a link's share)."""
FROZEN_WIDE_DECADES = 10.0
"""FREEZE_DECADES of slides and arm joints, so that they begin to stiffen where finger joints do."""
SLIDE_UNITS = {
    "limits": "m", "damping": "N s/m", "armature": "kg", "friction_loss": "N", "limit_margin": "m", "stiffness": "N/m",
    "start_target": "m",
}
"""Units of a joint's fields where the joint is a slide."""
HAND_LOG_GAIN, GRIPPER_LOG_GAIN = 0.0, 3.0
"""log10 of the command gain: a hand tracks its targets; robosuite's grippers take the sign of the action, which a gain of
1000 reproduces for every action above rate/1000."""
HAND_RATE = 0.2
"""Command change per policy step [command/step] of a hand: robosuite's own rate for two-jaw grippers, so that hand and
gripper close in the same time when told to close at once."""


CLOSING = START_ROTATION[:, 0]
"""Direction in which the fingers close, world; the thumb closes against it."""



def gyration(mass: float, inertia: np.ndarray) -> np.ndarray:
    """Square root (6,) [m] of a link's second moment of mass per unit mass: entries xx, yy, zz, xy, xz, yz.

    The second moment is tr(I)/2 - I (Wensing, Kim and Slotine 2018); interpolating its square root keeps every
    in-between inertia physically consistent, whatever the entries.
    """
    moment = (0.5 * np.trace(inertia) * np.eye(3) - inertia) / max(mass, 1e-12)
    values, vectors = np.linalg.eigh(moment)
    root = vectors @ np.diag(np.sqrt(np.clip(values, 0.0, None))) @ vectors.T
    return root[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]


def tangent_basis(reference: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Two unit vectors orthogonal to the unit vector ``reference`` (3,) and to each other."""
    helper = np.eye(3)[np.argmin(np.abs(reference))]
    first = np.cross(reference, helper)
    first /= np.linalg.norm(first)
    return first, np.cross(reference, first)


def axis_to_tangent(axis: np.ndarray, reference: np.ndarray) -> np.ndarray:
    """Logarithm (2,) [rad] of a direction on the sphere at ``reference``; every tangent maps back to a direction."""
    first, second = tangent_basis(reference)
    angle = np.arctan2(np.linalg.norm(np.cross(reference, axis)), reference @ axis)
    flat = np.array([first @ axis, second @ axis])
    norm = np.linalg.norm(flat)
    return angle * flat / norm if norm > 0 else np.array([angle, 0.0])


def _borrowed(rows: list[np.ndarray | None]) -> np.ndarray:
    """Values (n_robots, columns) of one item: who lacks it takes the source's, or the median of those who have it."""
    owned = [row for row in rows if row is not None]
    if not owned:
        raise ToolkitError("an item of the merged robot is owned by no robot")
    fallback = rows[0] if rows[0] is not None else np.median(owned, axis=0)
    return np.array([fallback if row is None else row for row in rows])


@dataclass(frozen=True)
class ShapeSlot:
    """A collision geom of the merged robot: the n-th of its kind on a link.

    Attributes:
        slot: index of the link's slot.  kind: mjtGeom.  name: unique.  condim: the largest of its owners'.
        reference: rotation (3, 3) from which its rotation vector counts.
        owners: the robots' shapes, None if absent, each described as near to the reference as its symmetry allows.
        read: the same shapes as the robots describe them.
    """

    slot: int
    kind: int
    name: str
    condim: int
    reference: np.ndarray
    owners: tuple[Shape | None, ...]
    read: tuple[Shape | None, ...]

    @property
    def first(self) -> tuple[int, Shape]:
        """The first robot that has it, and its shape."""
        return next((robot, owner) for robot, owner in enumerate(self.owners) if owner is not None)


def _aligned(shape: Shape, reference: np.ndarray) -> Shape:
    """The same solid, described by the rotation nearest to ``reference`` (3, 3).

    A box can be written in 24 ways and a capsule in a circle of ways. Between two that differ by a quarter turn, a pad would
    tumble and swell on its way, though the two solids hardly differ.
    """
    if shape.kind == mujoco.mjtGeom.mjGEOM_BOX:
        turns = CUBE.as_matrix()
        best = turns[int(np.argmax(np.einsum("ij,ik,nkj->n", reference, shape.rotation, turns)))]  # the largest trace
        return replace(shape, rotation=shape.rotation @ best, size=np.abs(best.T) @ shape.size)
    if shape.kind in (mujoco.mjtGeom.mjGEOM_CAPSULE, mujoco.mjtGeom.mjGEOM_CYLINDER):
        axis = shape.rotation[:, 2] if shape.rotation[:, 2] @ reference[:, 2] >= 0 else -shape.rotation[:, 2]
        turn, _ = Rotation.align_vectors(axis[None], reference[:, 2][None])
        return replace(shape, rotation=turn.as_matrix() @ reference)
    return shape


def _shape_slots(matching: Matching) -> list[ShapeSlot]:
    table: dict[tuple[int, int, int], list[Shape | None]] = {}
    count = len(matching.systems)
    for robot, system in enumerate(matching.systems):
        seen: dict[tuple[int, int], int] = {}
        for shape in system.shapes:
            ordinal = seen.get((shape.slot, shape.kind), 0)
            seen[shape.slot, shape.kind] = ordinal + 1
            table.setdefault((shape.slot, shape.kind, ordinal), [None] * count)[robot] = shape
    out = []
    for (slot, kind, ordinal), owners in sorted(table.items()):
        first = next(shape for shape in owners if shape is not None)
        label = mujoco.mjtGeom(kind).name.removeprefix("mjGEOM_").lower()
        name = f"{matching.slots[slot].name}/{label}{ordinal}"
        condim = max(shape.condim for shape in owners if shape is not None)
        aligned = tuple(None if shape is None else _aligned(shape, first.rotation) for shape in owners)
        out.append(ShapeSlot(slot, kind, name, condim, first.rotation, aligned, tuple(owners)))
    return out


def _extent(shape: Shape, direction: np.ndarray) -> float:
    """How far [m] a shape reaches from its centre along a direction (3,)."""
    local = shape.rotation.T @ direction
    if shape.kind == mujoco.mjtGeom.mjGEOM_BOX:
        return float(np.abs(local) @ shape.size)
    return float(abs(local[2]) * shape.size[1] + shape.size[0])


@dataclass(frozen=True)
class CouplingSlot:
    """A fixed tendon of the merged robot; ``slots`` are the joints that any owner's tendon touches."""

    name: str
    element: str
    slots: tuple[int, ...]
    owners: tuple[Coupling | None, ...]


def _coupling_slots(matching: Matching) -> list[CouplingSlot]:
    """Tendons that start at the same finger's driven joint match, and inner-knuckle tendons among themselves.

    One that is held, and turns the pad, is no stop that a pad runs into: half of the one and half of the other would be neither.
    """
    table: dict[tuple[str, str], list[Coupling | None]] = {}
    count = len(matching.systems)
    for robot, system in enumerate(matching.systems):
        for coupling in system.couplings:
            names = [matching.slots[slot].name for slot in coupling.coefficients]
            driven = any(name == DIGIT_OF[name].flexion for name in names)
            key = (DIGIT_OF[names[0]].name, "knuckle" if not driven else "drive" if coupling.held else "stop")
            table.setdefault(key, [None] * count)[robot] = coupling
    out = []
    for (finger, kind), owners in sorted(table.items()):
        slots = sorted({slot for owner in owners if owner for slot in owner.coefficients})
        out.append(CouplingSlot(f"{finger}/{kind}", finger, tuple(slots), tuple(owners)))
    return out


@dataclass(frozen=True)
class CurveSlot:
    """A finger of the merged robot whose pad joint (a slot) may follow its driven joint (a slot)."""

    name: str
    element: str
    driven: int
    pad: int
    owners: tuple[Curve | None, ...]


def _curve_slots(matching: Matching) -> list[CurveSlot]:
    table: dict[tuple[int, int], list[Curve | None]] = {}
    for robot, system in enumerate(matching.systems):
        for curve in system.curves:
            table.setdefault((curve.driven, curve.pad), [None] * len(matching.systems))[robot] = curve
    # A tendon that is held leads a pad as well, though rigidly: the way is the same, so that pads that hang on it for a part only
    # are led between the two ways.
    for (driven, pad), owners in table.items():
        for robot, system in enumerate(matching.systems):
            for coupling in system.couplings:
                if owners[robot] is None and coupling.held and set(coupling.coefficients) == {driven, pad}:
                    ratio = -coupling.coefficients[driven] / coupling.coefficients[pad]
                    owners[robot] = Curve(driven, pad, (ratio, 0.0), 0.0)
    return [
        CurveSlot(f"{matching.slots[pad].name}/curve", matching.slots[pad].element, driven, pad, tuple(owners))
        for (driven, pad), owners in sorted(table.items())
    ]


class EvolutionSpace(ParameterSpace):
    """The space of matched arms with grippers.

    Args:
        matching: the merged tree; robot 0 is the source.

    Attributes:
        matching: the same.
    """

    def __init__(self, matching: Matching) -> None:
        self.matching = matching
        self.shape_slots = _shape_slots(matching)
        self.coupling_slots = _coupling_slots(matching)
        self.curve_slots = _curve_slots(matching)
        self.axis_references = self._axis_references()
        self.axis_bases = np.array([tangent_basis(reference) for reference in self.axis_references])
        sliding = {slot.name for slot in matching.slots if slot.sliding}

        def unit(field: Field, row: int) -> str:
            return SLIDE_UNITS.get(field.name, field.unit) if field.items[row] in sliding else field.unit

        super().__init__(matching.names, self._fields(), unit)

    def side(self, name: str) -> np.ndarray:
        """Indices of the parameters of one side of the grasp: "thumb", or the "fingers" that oppose it."""
        arm = {slot.element for slot in self.matching.slots[: self.matching.arm_size]}
        hand = {slot.element for slot in self.matching.slots} - arm
        mine = hand & {THUMB.name} if name == "thumb" else hand - {THUMB.name}
        return np.unique([p.dimension for p in self.parameters if p.element in mine]).astype(int)

    def digits(self) -> dict[str, np.ndarray]:
        """Indices of the parameters of each finger and of the thumb."""
        found = {digit.name: np.unique([p.dimension for p in self.parameters if p.element == digit.name]).astype(int) for digit in DIGITS}
        return {name: dimensions for name, dimensions in found.items() if len(dimensions)}

    def groups(self) -> dict[str, np.ndarray]:
        """Indices of the parameters, each in one group: "thumb axis", "fingers axis", "rest axis" and the like.

        A parameter that is several quantities, all of which change together, belongs to the first of them.
        """
        sides = {int(dimension): side for side in ("fingers", "thumb") for dimension in self.side(side)}
        found: dict[str, list[int]] = {}
        named: set[int] = set()
        for parameter in self.parameters:
            if parameter.dimension not in named:
                named.add(parameter.dimension)
                quantity = parameter.name.split(".")[1]
                found.setdefault(f"{sides.get(parameter.dimension, 'rest')} {quantity}", []).append(parameter.dimension)
        return {name: np.array(dimensions) for name, dimensions in sorted(found.items())}

    # ---- what the parameters are -------------------------------------------------------------------------------

    def _axis_references(self) -> np.ndarray:
        """(n_slots, 3): direction halfway between the robots' axes, at which axis tangents are taken."""
        out = []
        for index in range(len(self.matching.slots)):
            axes = [joint.screw.axis for s in self.matching.systems if (joint := s.joints[index]) is not None]
            mean = np.sum(np.unique(np.round(axes, 6), axis=0), axis=0) if axes else np.array([0.0, 0.0, 1.0])
            out.append(mean / np.linalg.norm(mean) if np.linalg.norm(mean) > 1e-3 else axes[0])
        return np.array(out)

    def _slot_field(
        self, name: str, unit: str, components: Sequence[str], get: Callable, absent: Sequence[float] | None = None,
        nobody: Sequence[float] | None = None,
    ) -> Field:
        """A field over the slots: ``get(joint, slot)`` where present; absent or None, they read ``absent`` or borrow; what no robot
        has reads ``nobody``, or 0."""
        rows = []
        for index in range(len(self.matching.slots)):
            read = [None if s.joints[index] is None else get(s.joints[index], index) for s in self.matching.systems]
            owned = [None if value is None else np.atleast_1d(value).astype(float) for value in read]
            if absent is not None:
                rows.append(np.array([np.array(absent, float) if row is None else row for row in owned]))
            elif all(row is None for row in owned):
                rows.append(np.tile(np.zeros(len(components)) if nobody is None else nobody, (len(owned), 1)))
            else:
                rows.append(_borrowed(owned))
        slots = self.matching.slots
        return Field(name, tuple(s.name for s in slots), tuple(s.element for s in slots), tuple(components), unit,
                     np.stack(rows, axis=1))

    def _fields(self) -> list[Field]:
        return [*self._joint_fields(), *self._shape_fields(), *self._coupling_fields(), *self._curve_fields(),
                *self._control_fields()]

    def _joint_fields(self) -> list[Field]:
        xyz = ("x", "y", "z")
        root = ("xx", "yy", "zz", "xy", "xz", "yz")
        references = self.axis_references
        slot_field = self._slot_field
        return [
            slot_field("anchor", "m", xyz, lambda j, i: j.screw.anchor),
            slot_field("axis", "rad", ("u", "v"), lambda j, i: axis_to_tangent(j.screw.axis, references[i])),
            slot_field("mass", "kg", ("",), lambda j, i: j.screw.mass, absent=[0.0]),
            slot_field("com", "m", xyz, lambda j, i: j.screw.com),
            slot_field("gyration", "m", root, lambda j, i: gyration(j.screw.mass, j.screw.inertia)),
            slot_field("air_edges", "m", xyz, lambda j, i: j.air_edges, absent=[0.0, 0.0, 0.0]),
            slot_field("air_position", "m", xyz, lambda j, i: j.air_position),
            slot_field("air_rotation", "rad", xyz, lambda j, i: j.air_rotation),
            slot_field("freeze", "1", ("",), lambda j, i: float(j.locked), absent=[1.0]),
            slot_field("limits", "rad", ("low", "high"), lambda j, i: j.limits, nobody=(-UNLIMITED_ANGLE, UNLIMITED_ANGLE)),
            slot_field("damping", "N m s/rad", ("",), lambda j, i: j.damping),
            slot_field("armature", "kg m^2", ("",), lambda j, i: j.armature),
            slot_field("friction_loss", "N m", ("",), lambda j, i: j.friction_loss, absent=[0.0]),
            slot_field("limit_margin", "rad", ("",), lambda j, i: j.margin),
            # A spring pulls against the joint's actuator, which may be twenty times weaker at the other end of the way: as a
            # share of the actuator's stiffness it moves the joint evenly along it.
            slot_field("spring_share", "1", ("",), lambda j, i: j.spring and j.spring / j.stiffness, absent=[0.0]),
            slot_field("spring_share_quadratic", "1/rad", ("",), lambda j, i: j.spring and j.spring_quadratic / j.stiffness,
                       absent=[0.0]),
            slot_field("spring_rest", "rad", ("",), lambda j, i: j.spring_rest),
            slot_field("stiffness", "N m/rad", ("",), lambda j, i: j.stiffness, absent=[0.0]),
            self._targets(),
        ]

    def _targets(self) -> Field:
        """Targets at the start's closing command, where every gripper rests.

        The target at the command -1 would belong to the preshape: a tree may take one from one robot, the other from another,
        and their gripper would move before it is told to. What the motors do closed is derived (``GraspLaw``).
        """
        slots, systems = self.matching.slots, self.matching.systems
        rows = []
        for index in range(len(slots)):
            owned: list[np.ndarray | None] = []
            for system in systems:
                joint, share = system.joints[index], 0.5 * (system.robot.gripper.preshape + 1.0)
                owned.append(None if joint is None else np.array([(1.0 - share) * joint.target_open + share * joint.target_closed]))
            rows.append(np.zeros((len(systems), 1)) if all(row is None for row in owned) else _borrowed(owned))
        elements = tuple(slot.element for slot in slots)
        return Field("start_target", tuple(s.name for s in slots), elements, ("",), "rad", np.stack(rows, axis=1))

    def _item_field(self, name: str, unit: str, components: Sequence[str], items: Sequence, get: Callable,
                    absent: float | tuple[float, ...] | None = None) -> Field:
        """A field over shape, coupling or curve slots."""
        rows = []
        for item in items:
            owned = [None if owner is None else np.atleast_1d(get(owner, item)).astype(float) for owner in item.owners]
            if absent is not None:
                owned = [np.zeros(len(components)) + absent if row is None else row for row in owned]
            rows.append(_borrowed(owned))
        slots = self.matching.slots
        elements = [slots[item.slot].element if isinstance(item, ShapeSlot) else item.element for item in items]
        values = np.stack(rows, axis=1) if rows else np.zeros((len(self.matching.systems), 0, len(components)))
        return Field(name, tuple(item.name for item in items), tuple(elements), tuple(components), unit, values)

    def _shape_fields(self) -> list[Field]:
        shapes, xyz = self.shape_slots, ("x", "y", "z")
        return [
            self._shape_positions(),
            self._shape_rotations(),
            self._item_field("shape_size", "m", xyz, shapes, lambda o, _: o.size),
            self._item_field("shape_presence", "1", ("",), shapes, lambda o, _: 1.0, absent=0.0),
            self._item_field("shape_friction", "1", ("slide", "spin", "roll"), shapes, lambda o, _: o.friction),
            self._item_field("shape_solref", "s, 1", ("time", "damping"), shapes, lambda o, _: o.solref),
            self._item_field("shape_margin", "m", ("",), shapes, lambda o, _: o.margin),
        ]

    def _shape_positions(self) -> Field:
        """Positions of the shapes; where a robot lacks one it hides inside the finger that the robot has.

        A shape that grew in free air, or faded there, would prick the object from where no finger is.
        """
        shapes = self.shape_slots
        rows = [
            _borrowed([owner.position if owner else self._hiding_place(robot, shape)
                       for robot, owner in enumerate(shape.owners)])
            for shape in shapes
        ]
        elements = tuple(self.matching.slots[shape.slot].element for shape in shapes)
        values = np.stack(rows, axis=1)
        return Field("shape_position", tuple(s.name for s in shapes), elements, ("x", "y", "z"), "m", values)

    def _shape_rotations(self) -> Field:
        """Rotations of the shapes; a pad that the source lacks lies flat on the box at every robot, as it does at its owner.

        A hand is curled by two radians where a jaw is straight. A pad that kept its turn from the link would grow askew.
        """
        rows = []
        for shape in self.shape_slots:
            first, its = shape.first
            own = self.turn_at_contact(first, shape.slot) @ its.rotation
            turns = [None if owner is None else owner.rotation for owner in shape.owners]
            if turns[0] is None:
                turns = [self.turn_at_contact(robot, shape.slot).T @ own if turn is None else turn for robot, turn in enumerate(turns)]
            rows.append(_borrowed([None if t is None else Rotation.from_matrix(t @ shape.reference.T).as_rotvec() for t in turns]))
        elements = tuple(self.matching.slots[shape.slot].element for shape in self.shape_slots)
        return Field("shape_rotation", tuple(s.name for s in self.shape_slots), elements, ("x", "y", "z"), "rad", np.stack(rows, axis=1))

    def turn_at_contact(self, robot: int, slot: int) -> np.ndarray:
        """Rotation (3, 3) of a finger's link from its start, with the robot's gripper closed on the reference box."""
        system, turn = self.matching.systems[robot], np.eye(3)
        while slot >= self.matching.arm_size:
            joint = system.joints[slot]
            if joint is not None and not self.matching.slots[slot].sliding:
                turn = Rotation.from_rotvec(joint.screw.axis * system.closed[slot]).as_matrix() @ turn
            slot = self.matching.slots[slot].parent
        return turn

    def _hiding_place(self, robot: int, shape: ShapeSlot) -> np.ndarray | None:
        """Inside (3,) [m] of what a robot has on a link, or on the nearest link above it in the finger; None: nothing.

        Among shapes it hides behind the face with which they touch the box, so that it stands out of the finger nowhere on its way.
        """
        system, slots, slot = self.matching.systems[robot], self.matching.slots, shape.slot
        while slot >= self.matching.arm_size:
            own = [found for found in system.shapes if found.slot == slot]
            if own:
                toward = self.turn_at_contact(robot, slot).T @ (-CLOSING if slots[slot].element == THUMB.name else CLOSING)
                first, its = shape.first
                there = self.turn_at_contact(first, shape.slot).T @ (-CLOSING if slots[slot].element == THUMB.name else CLOSING)
                front = max(found.position @ toward + _extent(found, toward) for found in own)
                middle = np.mean([found.position for found in own], axis=0)
                return middle + (front - _extent(its, there) - middle @ toward) * toward
            joint, below = system.joints[slot], self._next_below(system, slot)
            if joint is not None and below is not None:
                return 0.5 * (joint.screw.anchor + below.screw.anchor)
            slot = slots[slot].parent
        return None

    def _next_below(self, system: System, slot: int) -> Joint | None:
        """The nearest joint that a robot has below a slot, through those that it lacks."""
        for child, record in enumerate(self.matching.slots):
            if record.parent == slot:
                found = system.joints[child] or self._next_below(system, child)
                if found is not None:
                    return found
        return None

    def _coupling_fields(self) -> list[Field]:
        couplings = self.coupling_slots
        width = max((len(c.slots) for c in couplings), default=0)

        def coefficients(owner: Coupling, item: CouplingSlot) -> np.ndarray:
            return np.array([owner.coefficients.get(slot, 0.0) for slot in item.slots] + [0.0] * (width - len(item.slots)))

        return [
            self._item_field("coupling", "1", tuple(f"c{i}" for i in range(width)), couplings, coefficients),
            self._item_field("coupling_stiffness", "N/m", ("",), couplings, lambda o, _: o.stiffness, absent=0.0),
            self._item_field("coupling_slack", "m", ("low", "width"), couplings, lambda o, _: o.slack),
            self._item_field("coupling_limits", "m", ("low", "high"), couplings, lambda o, _: o.limits,
                             absent=(-UNLIMITED_LENGTH, UNLIMITED_LENGTH)),
            self._item_field("coupling_friction", "N", ("",), couplings, lambda o, _: o.friction_loss, absent=0.0),
            self._item_field("coupling_held", "1", ("",), couplings, lambda o, _: float(o.held), absent=0.0),
            self._item_field("coupling_length", "m", ("",), couplings, lambda o, _: o.held_length),
        ]

    def _curve_fields(self) -> list[Field]:
        curves = self.curve_slots
        return [
            self._item_field("curve", "1, 1/rad", ("c1", "c2"), curves, lambda o, _: o.coefficients),
            self._item_field("curve_stiffness", "N m/rad", ("",), curves, lambda o, _: o.stiffness, absent=0.0),
        ]

    def _control_fields(self) -> list[Field]:
        systems = self.matching.systems
        grips = [s.robot.gripper for s in systems]
        rates = [HAND_RATE if g.rate is None else g.rate for g in grips]
        rows: list[tuple[str, str, str, list[float]]] = [
            ("common", "1", "gripper", [float(g.rate is not None) for g in grips]),
            ("log_gain", "1", "gripper", [HAND_LOG_GAIN if g.rate is None else GRIPPER_LOG_GAIN for g in grips]),
            ("log_rate", "log10(command/step)", "gripper", list(np.log10(rates))),
            ("leak", "1", "gripper", [float(g.rate is None) for g in grips]),
            ("preshape", "command", "gripper", [g.preshape for g in grips]),
            ("grasp_offset", "m", "gripper", [g.grasp_offset for g in grips]),
            ("base_follows", "1", "arm1", [s.base_follows for s in systems]),
        ]
        out = [Field(name, (element,), (element,), ("",), unit, np.array(values)[:, None, None])
               for name, unit, element, values in rows]
        arm = tuple(slot.name for slot in self.matching.slots[: self.matching.arm_size])
        limits = np.array([s.torque_limits for s in systems])[:, :, None]
        base = np.array([s.base_position for s in systems])[:, None, :]
        out.append(Field("torque_limit", arm, arm, ("",), "N m", limits))
        out.append(Field("base_position", ("arm1",), ("arm1",), ("x", "y", "z"), "m", base))
        return out

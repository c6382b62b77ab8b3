"""Matching: which joint of each robot is which, and the merged tree that holds them all.

Arms are matched by geometry (``proposal``), fingers by the roles that the grippers declare. The merged tree is the graph
union: a slot per matched joint, with the robots that own it.

Every robot is read at its start posture, where all grasp frames coincide, as a list of screws in world axes (product
of exponentials; Brockett 1984): a joint is a point and a direction, a link is a mass, a centre and an inertia. The
merged joint angle (of a slide the displacement: radians below are then metres) counts from the start posture; fingers
close in the positive sense, every other joint turns in the source's sense. So zero and plus mean the same for all.
"""

from collections.abc import Container, Sequence
from dataclasses import dataclass, field, replace

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from grippers.gripper import COMMANDED_ROLES, DIGIT_OF, ROLE_PARENT, ROLE_SENSE, ROLES, SLIDES
from robots.robot import Robot
from toolkit.errors import ToolkitError
from toolkit.morphology.linkage import Linkage, closed_on_box, equivalent_linkages
from toolkit.morphology.native_scene import (
    BASE_SITE,
    GRIP_SITE,
    GRIPPER_PREFIX,
    NativeScene,
    plain_name,
    role_actuators,
    role_joints,
    welded_bodies,
)
from toolkit.morphology.posture import NOMINAL_TASK, native_env, target_at
from toolkit.morphology.proposal import ALONE, Finger, align, pair_cost, propose_roles
from toolkit.morphology.tree import KinematicTree, Screw

UNLIMITED_ANGLE = 4 * np.pi
"""Range [rad] given to a joint without limits: two turns either way, never reached in an episode."""
UNLIMITED_LENGTH = 10.0
"""Range given to a coupling without limits: joint angles times coefficients stay well below."""
SMALL_TO_AIR = 0.02
"""Area [m^2] that is nothing to the air: 3 mN at half a metre per second."""
CUBE = Rotation.create_group("O")
"""Turns that leave a cube as it was, and a box a box, its edges renamed."""
EQUAL_MOMENTS, TELLING_MOMENTS = 1e-6, 1e-7
"""Principal moments within so much of each other, relatively, get a difference of so much along their body's own axes."""


@dataclass(frozen=True)
class Slot:
    """A joint of the merged tree with its link.

    Attributes:
        name: "arm1".. or a finger role.
        parent: index of the parent slot, -1 for the world.
        element: arm joint or finger to which the slot belongs; parameters are grouped by it.
        sliding: whether the joint is a slide [m] rather than a hinge [rad].
    """

    name: str
    parent: int
    element: str
    sliding: bool = False


@dataclass(frozen=True)
class Joint:
    """A robot's joint in merged coordinates: angle 0 at the start posture, positive as in the source.

    Attributes:
        screw: joint and link at the start posture, world axes, axis already signed.
        sign: +1 or -1: merged angle = sign * (robot's angle - start angle).
        start: the robot's own angle at the start posture [rad].
        mujoco_joint: id in the robot's native scene; -1 for a body that is welded to its parent there.
        limits: (low, high) [rad], merged.
        damping: [N m s/rad].  armature: [kg m^2].  friction_loss: [N m].  margin: limit margin [rad].
        spring: stiffness of its own spring [N m/rad] at the angle ``spring_rest`` [rad], and ``spring_quadratic`` its growth
            [N m/rad^2] with the distance from there; 0 without one.
        stiffness: position gain of its actuator [N m/rad], 0 without one.
        force_limit: largest actuator torque [N m].
        target_open, target_closed: merged position targets [rad] at closing command -1 and +1.
        air_edges: (3,) [m] of the box that the air drags on besides the link itself, 0 for none; see ``_air``.
        air_position, air_rotation: its centre (3,) [m] and its axes as a rotation vector (3,) [rad], world, or None.
        locked: True if the link is there but its joint is held still (inner knuckles of an equivalent linkage).
    """

    screw: Screw
    sign: float
    start: float
    mujoco_joint: int
    limits: tuple[float, float]
    damping: float
    armature: float
    friction_loss: float
    margin: float
    spring: float = 0.0
    spring_quadratic: float = 0.0
    spring_rest: float | None = None
    stiffness: float = 0.0
    force_limit: float = 0.0
    target_open: float = 0.0
    target_closed: float = 0.0
    air_edges: np.ndarray | tuple[float, float, float] = (0.0, 0.0, 0.0)
    air_position: np.ndarray | None = None
    air_rotation: np.ndarray | None = None
    locked: bool = False


@dataclass(frozen=True)
class Shape:
    """A primitive collision geom of a gripper at the start posture.

    Attributes:
        slot: index of the slot whose link carries it.
        kind: mjtGeom.
        position: (3,) [m], world.  rotation: (3, 3), geom to world.  size: (3,) [m] as MuJoCo's geom_size.
        friction: (3,).  solref: (2,).  condim: contact dimensionality.  margin: [m].
    """

    slot: int
    kind: int
    position: np.ndarray
    rotation: np.ndarray
    size: np.ndarray
    friction: np.ndarray
    solref: np.ndarray
    condim: int
    margin: float


@dataclass(frozen=True)
class Coupling:
    """A fixed tendon between joints of one finger, in merged angles.

    Attributes:
        coefficients: slot index -> coefficient.
        stiffness: [N/m].  slack: (length [m], merged, below which its spring pulls; how much longer it may be before it pushes).
        limits: (low, high) [m], merged.  friction_loss: [N].
        held: whether an equality constraint holds its length.  held_length: at this merged length [m].
    """

    coefficients: dict[int, float]
    stiffness: float
    slack: tuple[float, float]
    limits: tuple[float, float]
    friction_loss: float
    held: bool
    held_length: float


@dataclass(frozen=True)
class Curve:
    """A pad held softly to the way P(q) = c1 q + c2 q^2 that its linkage leads it, in merged angles.

    Attributes:
        driven, pad: slots of the joint q and of the pad's joint.
        coefficients: (c1 [1], c2 [1/rad]).  stiffness: [N m/rad].
    """

    driven: int
    pad: int
    coefficients: tuple[float, float]
    stiffness: float


@dataclass(frozen=True)
class System:
    """One robot in the merged tree's slots.

    Attributes:
        robot: its card.
        joints: one per slot, None where the robot has none.
        shapes: primitive collision geoms of the gripper, in MuJoCo's order.
        couplings: fixed tendons of the gripper.
        curves: how its pads follow their driven joints, where they hang on linkages.
        torque_limits: one per arm slot (n,) [N m], 0 where the robot has no joint.
        base_follows: 1 if the OSC base frame turns with joint 1 (KUKA's site sits on link 1), else 0.
        base_position: origin of the OSC base frame at the start [m].
        model: the unmodified robosuite scene.  start: its configuration (nq,) at the start posture.
        closed: (n_slots,) merged angles [rad] with the gripper closed on the reference box; 0 where the robot has no joint.
    """

    robot: Robot
    joints: tuple[Joint | None, ...]
    shapes: tuple[Shape, ...]
    couplings: tuple[Coupling, ...]
    curves: tuple[Curve, ...]
    torque_limits: np.ndarray
    base_follows: float
    base_position: np.ndarray
    model: mujoco.MjModel
    start: np.ndarray
    closed: np.ndarray

    def present(self, slot: int) -> bool:
        """Whether the robot has the slot's joint."""
        return self.joints[slot] is not None


@dataclass(frozen=True)
class Pair:
    """A robot's joint and the slot that it plays, with what the geometry alone proposes.

    Attributes:
        robot, joint: whose, and its own name there without robosuite's prefix.
        slot: name of the slot.
        proposed: name of the slot that the geometry proposes; None where it finds no partner.
        by_card: whether the card names the slot (every finger; an arm joint only to overrule the geometry).
    """

    robot: str
    joint: str
    slot: str
    proposed: str | None
    by_card: bool

    @property
    def overridden(self) -> bool:
        """Whether the card overrules the geometry."""
        return self.by_card and self.slot != self.proposed


@dataclass(frozen=True)
class Matching:
    """The merged tree with every robot in it; robot 0 is the source.

    Attributes:
        slots: joints of the merged tree, parents first.
        systems: the robots.
        arm_size: how many of the slots, from the first, are the arm's.
        dropped_meshes: robot -> collision meshes of its gripper that the merged robot leaves out.
        pairs: every target's joints with their slots.
    """

    slots: tuple[Slot, ...]
    systems: tuple[System, ...]
    arm_size: int
    dropped_meshes: dict[str, int] = field(default_factory=dict)
    pairs: tuple[Pair, ...] = ()

    @property
    def names(self) -> list[str]:
        """Robot names, the source first."""
        return [system.robot.name for system in self.systems]


def merged_slots(arm: Sequence[str], owned: Container[str] = ()) -> tuple[Slot, ...]:
    """Slots of the merged tree: the arm's joints in order, then the finger roles on the flange.

    Args:
        arm: names of the merged arm's joints.
        owned: roles that some robot has; those that nobody commands are left out where none does.
    """
    slots = [Slot(name, i - 1, name) for i, name in enumerate(arm)]
    index: dict[str | None, int] = {None: len(arm) - 1}
    for role in ROLES:
        parent = index[ROLE_PARENT[role]]
        index[role] = parent
        if role in COMMANDED_ROLES or role in owned:
            index[role] = len(slots)
            slots.append(Slot(role, parent, DIGIT_OF[role].name, role in SLIDES))
    return tuple(slots)


def _side(axis: np.ndarray, reference: Sequence[float] | np.ndarray | None) -> float:
    """+1 if an axis (3,) lies on the reference's side (or there is none), else -1."""
    return -1.0 if reference is not None and axis @ np.asarray(reference) < 0 else 1.0


def finger_sign(robot: Robot, role: str, axis: np.ndarray) -> float:
    """Sign of a gripper joint's angle in the merged robot: closing is positive, else ROLE_SENSE decides.

    Args:
        robot: whose gripper.
        role: of the joint.
        axis: its axis (3,) at the start posture, world.
    """
    opened, closed = robot.gripper.targets.get(role, (0.0, 0.0))
    return float(np.sign(closed - opened)) if closed != opened else _side(axis, ROLE_SENSE.get(role))


def _joint(model: mujoco.MjModel, joint: int, screw: Screw, sign: float, start: float) -> Joint:
    dof = model.jnt_dofadr[joint]
    limits = (-UNLIMITED_ANGLE, UNLIMITED_ANGLE)
    if model.jnt_limited[joint]:
        low, high = sorted(sign * (model.jnt_range[joint] - start))
        limits = (min(low, 0.0), max(high, 0.0))  # a jaw at rest may lean a little on its limit
    return Joint(
        screw, sign, start, joint, limits, float(model.dof_damping[dof]), float(model.dof_armature[dof]),
        float(model.dof_frictionloss[dof]), float(model.jnt_margin[joint]),
    )


def _drive(model: mujoco.MjModel, actuator: int, joint: Joint, targets: tuple[float, float]) -> Joint:
    """The joint with its position actuator."""
    gain = float(model.actuator_gainprm[actuator, 0])
    low, high = model.actuator_ctrlrange[actuator]
    unlimited = gain * float(high - low) * 2.0  # more than the servo can ask for within its range
    limit = float(model.actuator_forcerange[actuator, 1]) if model.actuator_forcelimited[actuator] else unlimited
    opened, closed = (joint.sign * (target - joint.start) for target in targets)
    return replace(joint, stiffness=gain, force_limit=limit, target_open=opened, target_closed=closed)


def _shapes(model: mujoco.MjModel, data: mujoco.MjData, carrier: dict[int, int]) -> tuple[tuple[Shape, ...], int]:
    """Primitive collision geoms of the gripper, and how many meshes were left out."""
    shapes, meshes = [], 0
    for geom in range(model.ngeom):
        body = int(model.geom_bodyid[geom])
        if not model.geom(geom).name.startswith("gripper0_") or not (model.geom_contype[geom] | model.geom_conaffinity[geom]):
            continue
        if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_MESH:
            meshes += 1
            continue
        shapes.append(
            Shape(
                carrier[body], int(model.geom_type[geom]), np.array(data.geom_xpos[geom]),
                np.array(data.geom_xmat[geom]).reshape(3, 3), np.array(model.geom_size[geom]),
                np.array(model.geom_friction[geom]), np.array(model.geom_solref[geom]), int(model.geom_condim[geom]),
                float(model.geom_margin[geom]),
            )
        )
    return tuple(shapes), meshes


def _owned(joints: Sequence[Joint | None], slot: int) -> Joint:
    """The robot's joint in a slot.

    Raises:
        ToolkitError: it has none there.
    """
    joint = joints[slot]
    if joint is None:
        raise ToolkitError(f"a coupling or linkage needs a joint in slot {slot} of the merged tree, where the gripper's card names none")
    return joint


def _couplings(model: mujoco.MjModel, slot_of: dict[int, int], joints: Sequence[Joint | None]) -> tuple[Coupling, ...]:
    out = []
    held = {int(model.eq_obj1id[e]): e for e in range(model.neq) if model.eq_type[e] == mujoco.mjtEq.mjEQ_TENDON}
    for tendon in range(model.ntendon):
        first, count = int(model.tendon_adr[tendon]), int(model.tendon_num[tendon])
        start_length, coefficients = 0.0, {}
        for wrap in range(first, first + count):
            slot = slot_of[int(model.wrap_objid[wrap])]
            coefficient = float(model.wrap_prm[wrap])
            joint = _owned(joints, slot)
            start_length += coefficient * joint.start
            coefficients[slot] = coefficient * joint.sign
        low, high = model.tendon_range[tendon] if model.tendon_limited[tendon] else (-UNLIMITED_LENGTH, UNLIMITED_LENGTH)
        pulls, pushes = map(float, model.tendon_lengthspring[tendon])
        equality = held.get(tendon)
        length = float(model.tendon_length0[tendon]) + (float(model.eq_data[equality, 0]) if equality is not None else 0.0)
        out.append(
            Coupling(
                coefficients, float(model.tendon_stiffness[tendon]), (pulls - start_length, pushes - pulls),
                (float(low) - start_length, float(high) - start_length), float(model.tendon_frictionloss[tendon]),
                equality is not None, length - start_length,
            )
        )
    return tuple(out)


def _open_chains(
    linkages: Sequence[Linkage], joints: list[Joint | None], index: dict[str, int]
) -> tuple[tuple[Coupling, ...], tuple[Curve, ...]]:
    """A four-bar gripper's linkages as springs: edits ``joints``, returns the stops of the pads and their curves."""
    stops, curves = [], []
    for linkage in linkages:
        driven, pad, knuckle = (index[role] for role in (linkage.driven, linkage.pad, linkage.knuckle))
        joints[driven] = replace(
            _owned(joints, driven), damping=linkage.damping, spring=linkage.stiffness, spring_quadratic=linkage.quadratic,
            spring_rest=linkage.rest,
        )
        wide = (-UNLIMITED_ANGLE, UNLIMITED_ANGLE)  # nothing may push against the lock
        joints[knuckle] = replace(_owned(joints, knuckle), locked=True, limits=wide)
        unlimited = (-UNLIMITED_LENGTH, UNLIMITED_LENGTH)
        stop = {driven: -linkage.gear, pad: linkage.turn}
        stops.append(Coupling(stop, linkage.stop, (linkage.slack, UNLIMITED_LENGTH), unlimited, 0.0, False, 0.0))
        way = (linkage.turn * linkage.curve[0], linkage.turn * linkage.curve[1])
        curves.append(Curve(driven, pad, way, linkage.hold))
    return tuple(stops), tuple(curves)


def _carriers(model: mujoco.MjModel, slot_of: dict[int, int], welded: dict[int, int], flange_slot: int) -> dict[int, int]:
    """Body id -> slot of the nearest joint or welded body above it (the flange for what is fixed to the arm's last link)."""
    carrier: dict[int, int] = {}
    for body in range(1, model.nbody):
        joint = int(model.body_jntadr[body])
        inherited = carrier.get(int(model.body_parentid[body]), flange_slot)
        carrier[body] = slot_of.get(joint, inherited) if joint >= 0 else welded.get(body, inherited)
    return carrier


def _drag_areas(mass: float, moments: np.ndarray) -> np.ndarray:
    """Faces (3,) [m^2] that a body shows MuJoCo's air along its principal axes: those of the box of its mass and moments."""
    edges = np.sqrt(np.maximum(moments.sum() - 2.0 * moments, 0.0) * 6.0 / mass)
    return edges[[1, 2, 0]] * edges[[2, 0, 1]]


def _seen_along(axes: np.ndarray, own: np.ndarray, areas: np.ndarray) -> np.ndarray:
    """Areas (3,) along the columns of ``axes`` of a body with ``areas`` along the columns of ``own``."""
    return (axes.T @ own) ** 2 @ areas


def _air(model: mujoco.MjModel, data: mujoco.MjData, carrier: dict[int, int], joints: list[Joint | None]) -> None:
    """Where a link's bodies show the air more than their lump does, keep a box that shows it the rest; edits ``joints``.

    robosuite gives some helper bodies a moment of 1 kg m^2 per kg: to the air they are cubes of 2.4 m, to the link nothing.
    """
    for slot, joint in enumerate(joints):
        bodies = _bodies_of(model, carrier, slot)
        if joint is None or not bodies:
            continue
        own = [data.ximat[body].reshape(3, 3) for body in bodies]
        faces = [_drag_areas(model.body_mass[body], model.body_inertia[body]) for body in bodies]
        weights = np.mean(faces, axis=1)
        axes = own[int(np.argmax(weights))]
        moments, lump = np.linalg.eigh(joint.screw.inertia)
        areas = np.sum([_seen_along(axes, o, f) for o, f in zip(own, faces, strict=True)], axis=0)
        areas -= _seen_along(axes, lump, _drag_areas(joint.screw.mass, moments))
        if areas.max() < SMALL_TO_AIR:
            continue
        areas = np.maximum(areas, 0.1 * areas.max())  # no needle: its length would drag on turning
        edges = np.sqrt(areas.prod()) / areas
        turned = Rotation.from_matrix(axes).reduce(right=CUBE)
        joints[slot] = replace(
            joint, air_edges=np.abs(turned.as_matrix().T @ axes).round() @ edges, air_rotation=turned.as_rotvec(),
            air_position=weights @ data.xipos[bodies] / weights.sum(),
        )


def _bodies_of(model: mujoco.MjModel, carrier: dict[int, int], slot: int) -> list[int]:
    """Moving bodies with mass that are lumped into a slot's link."""
    return [body for body, place in carrier.items() if place == slot and model.body_weldid[body] and model.body_mass[body] > 0.0]


def _keep_axes(model: mujoco.MjModel, data: mujoco.MjData, carrier: dict[int, int], joints: list[Joint | None]) -> None:
    """Let inertias with equal moments tell their axes, along which MuJoCo's air drags on each by itself; edits ``joints``."""
    for slot, joint in enumerate(joints):
        bodies = _bodies_of(model, carrier, slot)
        if joint is None or not bodies:
            continue
        moments = np.linalg.eigvalsh(joint.screw.inertia)
        if np.diff(moments).min() > EQUAL_MOMENTS * moments[2]:
            continue
        axes = data.ximat[max(bodies, key=lambda body: model.body_mass[body])].reshape(3, 3)
        telling = TELLING_MOMENTS * moments[2] * axes @ np.diag([-1.0, 0.0, 1.0]) @ axes.T
        joints[slot] = replace(joint, screw=replace(joint.screw, inertia=joint.screw.inertia + telling))


@dataclass(frozen=True)
class Reading:
    """A robot's scene at its start posture, as far as it can be read without the other robots.

    Attributes:
        robot: its card.
        model, data: the native scene; ``env`` keeps them alive.
        arm: ids of the arm's joints, base to flange.
        welded: role -> body id.
        tree: kinematic tree.  screws: of its joints.
        role: joint id -> role.
    """

    robot: Robot
    env: object
    model: mujoco.MjModel
    data: mujoco.MjData
    arm: list[int]
    welded: dict[str, int]
    tree: KinematicTree
    screws: list[Screw]
    role: dict[int, str]

    @property
    def arm_screws(self) -> list[Screw]:
        """Screws of the arm's joints, base to flange."""
        by_joint = dict(zip(self.tree.joints, self.screws, strict=True))
        return [by_joint[joint] for joint in self.arm]

    @property
    def fingers(self) -> list[Finger]:
        """The gripper's chains of joints, the palm's first."""
        model, by_joint = self.model, dict(zip(self.tree.joints, self.screws, strict=True))
        driven = {int(model.actuator_trnid[a, 0]) for a in range(model.nu)}
        chains: list[list[int]] = []
        for index, joint in enumerate(self.tree.joints):
            if joint in self.arm:
                continue
            parent = self.tree.joints[self.tree.parent(index)]
            chain = next((chain for chain in chains if chain[-1] == parent), None)
            if chain is None:
                chains.append([joint])
            else:
                chain.append(joint)
        return [
            Finger(
                tuple(self.name(joint) for joint in chain), tuple(by_joint[joint] for joint in chain),
                any(joint in driven for joint in chain),
            )
            for chain in chains
        ]

    def joint_id(self, name: str) -> int:
        """The id of a gripper's joint by its own name."""
        return int(self.model.joint(GRIPPER_PREFIX + name).id)

    def name(self, joint: int) -> str:
        """The robot's own name of a joint, without robosuite's prefix."""
        return plain_name(self.model.joint(joint).name)

    def arm_name(self, index: int) -> str:
        """The arm's own name of its joint at an index, without robosuite's prefix."""
        return self.name(self.arm[index])


def read(robot: Robot) -> Reading:
    """Load a robot's native scene at its start posture.

    Raises:
        ToolkitError: the card names what the models lack, or the robot cannot start where the task asks.
    """
    env = native_env(robot, NOMINAL_TASK)
    env.begin(0)
    model, data = env.sim.model._model, env.sim.data._data
    mujoco.mj_forward(model, data)
    role = {joint: role for role, joint in role_joints(model, robot).items()}
    welded = welded_bodies(model, robot)
    tree = KinematicTree(model, "robot0_base", welded.values())
    arm = NativeScene(model).arm
    return Reading(robot, env, model, data, arm, welded, tree, tree.screws(data.qpos), role)


def match_arms(readings: Sequence[Reading]) -> tuple[list[str], list[list[int]], list[Pair]]:
    """The merged arm: the source's joints, and in between any joint of another arm that has no partner among them.

    Returns:
        names of the merged arm's joints, base to flange; for every robot the index of each of its own joints among them;
        the targets' pairs.

    Raises:
        ToolkitError: a card asks for a pair that is not possible.
    """
    names = [f"arm{i + 1}" for i in range(len(readings[0].arm))]
    screws = list(readings[0].arm_screws)
    found, pairs = [list(names)], []
    for reading in readings[1:]:
        own = reading.arm_screws
        costs = np.array([[pair_cost(a, b) for b in own] for a in screws])
        proposed = {j: names[i] for i, j in align(costs) if i is not None and j is not None}
        for joint, role in reading.robot.arm_roles.items():
            row, column = _override(reading, names, joint, role)
            costs[row], costs[:, column], costs[row, column] = np.inf, np.inf, -ALONE
        merged: list[tuple[str, Screw]] = []
        slot_names: list[str] = []
        for i, j in align(costs):
            if i is not None:
                name, screw = names[i], screws[i]
            elif j is not None:
                name, screw = f"{merged[-1][0] if merged else 'arm0'}b", own[j]
            merged.append((name, screw))
            if j is not None:
                slot_names.append(name)
                joint = reading.arm_name(j)
                pairs.append(Pair(reading.robot.name, joint, name, proposed.get(j), joint in reading.robot.arm_roles))
        names, screws = [name for name, _ in merged], [screw for _, screw in merged]
        found.append(slot_names)
    return names, [[names.index(name) for name in own] for own in found], pairs


def match_fingers(readings: Sequence[Reading]) -> list[Pair]:
    """The targets' gripper joints with the roles that their cards give them, beside those that the geometry proposes.

    Raises:
        ToolkitError: a joint has no role; the sentence says which one the geometry proposes.
    """
    source = readings[0]
    hand = [
        Finger(tuple(source.role[joint] for joint in map(source.joint_id, finger.joints)), finger.screws, finger.driven)
        for finger in source.fingers if finger.driven
    ]
    pairs = []
    for reading in readings:
        proposed = propose_roles(reading.fingers, hand)
        for joint in reading.tree.joints:
            name = reading.name(joint)
            if joint in reading.role and reading is not source:
                pairs.append(Pair(reading.robot.name, name, reading.role[joint], proposed.get(name), True))
            elif joint not in reading.role and joint not in reading.arm:
                hint = f"by its geometry it is {proposed[name]}: " if name in proposed else ""
                raise ToolkitError(f"gripper {reading.robot.gripper.name}: joint {name!r} has no role; {hint}add it to the card's joints")
    return pairs


def _override(reading: Reading, names: list[str], joint: str, role: str) -> tuple[int, int]:
    own = [reading.arm_name(i) for i in range(len(reading.arm))]
    if role not in names:
        raise ToolkitError(f"robot {reading.robot.name}: arm_roles pairs {joint!r} with {role!r}; there are {', '.join(names)}")
    if joint not in own:
        raise ToolkitError(f"robot {reading.robot.name}: arm_roles names joint {joint!r}, which its arm lacks; it has {', '.join(own)}")
    return names.index(role), own.index(joint)


def read_system(reading: Reading, slots: Sequence[Slot], arm: Sequence[int], axes: dict[int, np.ndarray]) -> tuple[System, int]:
    """A robot's screws, limits, actuators, shapes and couplings at its start posture.

    Args:
        reading: its scene.
        slots: the merged tree.
        arm: slot of each of its arm joints.
        axes: slot -> axis that fixes the sign; axes of slots met for the first time are added.

    Returns:
        the system; the number of collision meshes of its gripper that the merged robot leaves out.

    Raises:
        ToolkitError: its OSC base frame stands askew.
    """
    robot, model, data = reading.robot, reading.model, reading.data
    arm_size = sum(slot.name.startswith("arm") for slot in slots)
    index = {slot.name: i for i, slot in enumerate(slots)}
    slot_of = dict(zip(reading.arm, arm, strict=True))
    slot_of |= {joint: index[role] for joint, role in reading.role.items()}
    joints: list[Joint | None] = [None] * len(slots)
    for joint, screw in zip(reading.tree.joints, reading.screws, strict=True):
        slot = slot_of[joint]
        sign = finger_sign(robot, slots[slot].name, screw.axis) if slot >= arm_size else _side(screw.axis, axes.get(slot))
        screw = replace(screw, axis=sign * screw.axis)
        axes.setdefault(slot, screw.axis)
        own = _joint(model, joint, screw, sign, float(data.qpos[model.jnt_qposadr[joint]]))
        held = robot.arm_friction.get(plain_name(model.joint(joint).name), 0.0)
        joints[slot] = replace(own, friction_loss=own.friction_loss + held)
    for role, body in reading.welded.items():
        axis = axes.get(index[role], np.array([1.0, 0.0, 0.0]))
        joints[index[role]] = _welded(reading.tree.welded(body, data.qpos, axis))
    for role, actuator in role_actuators(model, robot).items():
        targets = (target_at(robot, role, -1.0), target_at(robot, role, 1.0))
        joints[index[role]] = _drive(model, actuator, _owned(joints, index[role]), targets)
    welded = {body: index[role] for role, body in reading.welded.items()}
    carrier = _carriers(model, slot_of, welded, arm_size - 1)
    shapes, meshes = _shapes(model, data, carrier)
    _air(model, data, carrier, joints)
    _keep_axes(model, data, carrier, joints)
    site = model.site(BASE_SITE)
    if not np.allclose(data.site_xmat[site.id], np.eye(3).ravel(), atol=1e-4):
        raise ToolkitError(f"robot {robot.name}: its OSC base frame is turned at the start; OSC deltas would differ")
    follows = float(slot_of.get(int(model.body_jntadr[model.site_bodyid[site.id]]), -1) == 0)
    couplings, curves = _couplings(model, slot_of, joints), tuple[Curve, ...]()
    start = np.array(data.qpos)
    if robot.gripper.four_bar:
        signs = {role: _owned(joints, index[role]).sign for role in robot.gripper.joints}
        linkages = equivalent_linkages(model, data, robot, signs, np.array(data.site(GRIP_SITE).xpos))
        couplings, curves = _open_chains(linkages, joints, index)
    limits = np.zeros(arm_size)
    limits[list(arm)] = [model.actuator_ctrlrange[a, 1] for a in range(len(arm))]
    origin = np.array(data.site_xpos[site.id])
    closed = _closed(robot, model, start, joints)
    return System(robot, tuple(joints), shapes, couplings, curves, limits, follows, origin, model, start, closed), meshes


def _closed(robot: Robot, model: mujoco.MjModel, start: np.ndarray, joints: Sequence[Joint | None]) -> np.ndarray:
    """Merged angles (n_slots,) of the robot's own gripper, closed on the reference box."""
    actuators, scene = role_actuators(model, robot), NativeScene(model)

    def targets(command: float) -> np.ndarray:
        return np.array([target_at(robot, role, command) for role in actuators])

    _, data = closed_on_box(model, start, scene.arm, int(model.jnt_bodyid[scene.object_joint]), list(actuators.values()), targets,
                            robot.gripper.preshape)
    return np.array([
        0.0 if joint is None or joint.mujoco_joint < 0 else joint.sign * (data.qpos[model.jnt_qposadr[joint.mujoco_joint]] - joint.start)
        for joint in joints
    ])


def _welded(screw: Screw) -> Joint:
    wide = (-UNLIMITED_ANGLE, UNLIMITED_ANGLE)
    return Joint(screw, 1.0, 0.0, -1, wide, 0.0, 0.0, 0.0, 0.0, locked=True)


def match(robots: Sequence[Robot]) -> Matching:
    """The merged tree of several robots, the source first.

    Raises:
        ToolkitError: fewer than two robots, or one named twice.
    """
    names = [robot.name for robot in robots]
    if len(robots) < 2 or len(set(names)) != len(names):
        raise ToolkitError(f"a merged tree needs at least two different robots; got {', '.join(names) or 'none'}")
    readings = [read(robot) for robot in robots]
    fingers = match_fingers(readings)
    arm, places, arm_pairs = match_arms(readings)
    slots = merged_slots(arm, {role for robot in robots for role in (*robot.gripper.joints, *robot.gripper.welded)})
    axes: dict[int, np.ndarray] = {}
    systems = [read_system(reading, slots, place, axes) for reading, place in zip(readings, places, strict=True)]
    return Matching(
        slots, tuple(system for system, _ in systems), len(arm),
        {robot.name: meshes for robot, (_, meshes) in zip(robots, systems, strict=True)}, (*arm_pairs, *fingers),
    )

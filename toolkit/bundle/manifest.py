"""The manifest of a bundle: what a robot PC must know to play a policy, as validated records.

Every number says its unit in its name or in the record that holds it; frames are named in ``Manifest.frames``. A
manifest that lacks an entry, holds one of another kind, or a number that is not finite is refused with the entry's path.
Needs only the standard library.
"""

import json
import math
import types
import typing
from dataclasses import asdict, dataclass, fields, is_dataclass
from typing import Any, Literal

from toolkit.errors import ToolkitError

FORMAT, FORMAT_VERSION = "meta-evolve bundle", 6
READABLE = (2, 3, 4, 5, 6)
"""Versions that this release reads. Version 2 has neither ``simulation`` nor ``licence``: golden.npz alone settles what they say. Version
3 lacks ``holds``, and the files scene.xml and robot.urdf; version 4 ``braking``; version 5 ``borne_delay_steps``."""
SINCE = {"simulation": 3, "licence": 3, "holds": 4, "braking": 5, "borne_delay_steps": 6}
"""Entry -> the version that brought it."""

Vector = tuple[float, ...]


def _require(good: bool, what: str) -> None:
    if not good:
        raise ValueError(what)


@dataclass(frozen=True)
class Observed:
    """One entry of the observation record, in the policy's order.

    Attributes:
        name, size: as in the ONNX graph's inputs.
        unit, frame, meaning: of each of its ``size`` numbers.
        low, high: (size,) range seen in the training episodes on this robot, exploration noise included.
        step: (size,) largest change from one policy step to the next seen in undisturbed episodes.
        jump: (size,) change per policy step from which the runtime holds the arm.
    """

    name: str
    size: int
    unit: str
    frame: str
    meaning: str
    low: Vector
    high: Vector
    step: Vector
    jump: Vector

    def __post_init__(self) -> None:
        _require(self.size >= 1, f"size {self.size} is not positive")
        for key in ("low", "high", "step", "jump"):
            _require(len(getattr(self, key)) == self.size, f"{key} has {len(getattr(self, key))} numbers for size {self.size}")
        _require(all(a <= b for a, b in zip(self.low, self.high, strict=True)), "low lies above high")
        _require(all(j > 0 for j in self.jump), "jump is not positive")


@dataclass(frozen=True)
class Acted:
    """One number of the action, in the graph's order.

    Attributes:
        name, unit, frame, meaning: of the number.
        low, high: limits.
        step: largest allowed change from one policy step to the next.
        seen_low, seen_high, seen_step: in undisturbed episodes.
    """

    name: str
    unit: str
    frame: str
    meaning: str
    low: float
    high: float
    step: float
    seen_low: float
    seen_high: float
    seen_step: float

    def __post_init__(self) -> None:
        _require(self.low < self.high, f"low {self.low} is not below high {self.high}")
        _require(self.step > 0, f"step {self.step} is not positive")


@dataclass(frozen=True)
class Joint:
    """One joint of the arm, from base to flange.

    Attributes:
        name: in robot.xml, robosuite's without its prefix.
        low, high: [rad]; None: the joint turns without end.
        speed: limit [rad/s].  acceleration: limit [rad/s^2].  effort: limit [N m].
        seen_speed, seen_acceleration, seen_effort: largest in undisturbed episodes.
    """

    name: str
    low: float | None
    high: float | None
    speed: float
    acceleration: float
    effort: float
    seen_speed: float
    seen_acceleration: float
    seen_effort: float

    def __post_init__(self) -> None:
        _require((self.low is None) == (self.high is None), "has one position limit but not the other")
        _require(self.low is None or self.high is None or self.low < self.high, f"low {self.low} is not below high {self.high}")
        _require(min(self.speed, self.acceleration, self.effort) > 0, "a limit is not positive")


@dataclass(frozen=True)
class Cartesian:
    """Limits of the grasp frame, in the task frame.

    Its six coordinates are its origin (x, y, z) [m] and its rotation vector from the start rotation [rad].

    Attributes:
        low, high: (6,) the workspace box, and how far the grasp frame may turn.
        speed: (6,) [m/s, rad/s].  acceleration: (6,) [m/s^2, rad/s^2].
        lead: (6,) how far a commanded pose may run ahead of the measured one.
        table_top_m: height of the table.
        table_clearance_m: smallest height above it of the gripper's lowest point where a command leads; negative for a gripper that
            brushes the table in undisturbed episodes, as MuJoCo's contacts give way a little.
    """

    low: Vector
    high: Vector
    speed: Vector
    acceleration: Vector
    lead: Vector
    table_top_m: float
    table_clearance_m: float

    def __post_init__(self) -> None:
        for key in ("low", "high", "speed", "acceleration", "lead"):
            _require(len(getattr(self, key)) == 6, f"{key} has {len(getattr(self, key))} numbers, not 6")
        _require(all(a < b for a, b in zip(self.low, self.high, strict=True)), "low is not below high")
        _require(min(*self.speed, *self.acceleration, *self.lead) > 0, "a limit is not positive")


@dataclass(frozen=True)
class Response:
    """How the arm answers a delta in simulation, axis by axis, measured on the unmodified robosuite robot.

    Attributes:
        impulse: (6, n) share of one commanded delta by which the grasp frame moves in the k-th policy step after it.
        steady: (6,) sum of each row: metres moved per metre commanded.
        amplitude: action at which it was measured.
    """

    impulse: tuple[Vector, ...]
    steady: Vector
    amplitude: float

    def __post_init__(self) -> None:
        _require(len(self.impulse) == len(self.steady) == 6, "is not one row for each of 6 axes")
        _require(len({len(row) for row in self.impulse}) == 1 and len(self.impulse[0]) > 0, "impulse has rows of different lengths")


@dataclass(frozen=True)
class Controller:
    """The controller under which the policy was trained.

    Attributes:
        type, input, goal: robosuite's controller, "delta", and when and from where its goal is set.
        kp: stiffness [1/s^2].  damping_ratio: 1 is critical.
        translation_m, rotation_rad: delta of the goal per unit of action.
        base_site: whose frame the deltas are given in.  base_axis: (3,) task frame; base_anchor_m: (3,) a point on it.
        turns_with_first_joint: whether that frame turns with the arm's first joint, about that axis.
        response: measured.
    """

    type: str
    input: Literal["delta"]
    goal: str
    kp: float
    damping_ratio: float
    translation_m: float
    rotation_rad: float
    base_site: str
    base_axis: Vector
    base_anchor_m: Vector
    turns_with_first_joint: bool
    response: Response

    def __post_init__(self) -> None:
        _require(len(self.base_axis) == len(self.base_anchor_m) == 3, "base_axis or base_anchor_m is no vector of 3")
        _require(min(self.translation_m, self.rotation_rad) > 0, "a delta is not positive")


@dataclass(frozen=True)
class Gripper:
    """The gripper's law and its measured opening.

    Attributes:
        law: how the last number of the action becomes the closing command, -1 open to +1 closed.
        rate: change of the closing command per policy step.  preshape: closing command at the start of an episode.
        open_sign, close_sign: of the action.
        targets: driven joint -> (open, closed) position target, in the joint's unit.
        command: (n,) closing commands, rising, at which the empty gripper was measured.
        opening_m: (n,) smallest gap between thumb side and finger side there; 0 once they touch.
        joints: finger joints.  joint_units: "rad", or "m" for a slide.  joint_positions: (n, joints) where they stand there.
        fraction: "1 is opening_m[0], 0 is touching".
    """

    law: str
    rate: float
    preshape: float
    open_sign: Literal[-1]
    close_sign: Literal[1]
    targets: dict[str, Vector]
    command: Vector
    opening_m: Vector
    joints: tuple[str, ...]
    joint_units: tuple[str, ...]
    joint_positions: tuple[Vector, ...]
    fraction: str

    def __post_init__(self) -> None:
        _require(0 < self.rate <= 2, f"rate {self.rate} lies outside (0, 2]")
        _require(-1 <= self.preshape < 1, f"preshape {self.preshape} lies outside [-1, 1)")
        n = len(self.command)
        lengths = {n, len(self.opening_m), len(self.joint_positions)}
        _require(n >= 2 and len(lengths) == 1, "command, opening_m and joint_positions differ in length")
        _require(all(a < b for a, b in zip(self.command, self.command[1:], strict=False)), "command does not rise")
        _require(all(a >= b for a, b in zip(self.opening_m, self.opening_m[1:], strict=False)), "opening_m rises")
        fits = len(self.joint_units) == len(self.joints) and set(self.joint_units) <= {"rad", "m"}
        _require(fits, "joint_units does not fit joints")
        _require(all(len(row) == len(self.joints) for row in self.joint_positions), "joint_positions has rows that do not fit joints")
        _require(self.opening_m[0] > 0, "never opens")
        _require(all(len(pair) == 2 for pair in self.targets.values()), "targets has a joint without (open, closed)")


@dataclass(frozen=True)
class Finger:
    """How a finger's entry of the observation comes from its joint, a hinge: sign * (angle - start_rad)."""

    joint: str
    sign: float
    start_rad: float


@dataclass(frozen=True)
class Start:
    """The start of an episode.

    Attributes:
        arm_rad: (n,).  fingers: finger joint -> where it stands, in its unit.
        grasp_position_m, grasp_quaternion: of the grasp frame, task frame, w first.
        tolerance_rad: of every arm joint; from format version 5 on the largest error tried with which the policy still succeeded in at
            least 0.9 of the episodes.  tolerance_m, tolerance_rotation_rad: of the grasp frame; as far as such postures bring it.
    """

    arm_rad: Vector
    fingers: dict[str, float]
    grasp_position_m: Vector
    grasp_quaternion: Vector
    tolerance_rad: float
    tolerance_m: float
    tolerance_rotation_rad: float

    def __post_init__(self) -> None:
        _require(len(self.grasp_position_m) == 3 and len(self.grasp_quaternion) == 4, "is no pose")
        _require(abs(math.hypot(*self.grasp_quaternion) - 1) < 1e-6, "grasp_quaternion is not of unit length")
        _require(min(self.tolerance_rad, self.tolerance_m, self.tolerance_rotation_rad) > 0, "a tolerance is not positive")


@dataclass(frozen=True)
class RobotCard:
    """Which robot, and where its frames are.

    Attributes:
        name, arm, gripper: the toolkit's and robosuite's names.
        model_sha256: of the simulated robot's kinematics, masses and limits (see toolkit/morphology/native_scene.py).
        base_body, base_position_m, base_quaternion: the arm's base frame in the task frame, w first.
        flange_body, tool_position_m, tool_quaternion: the grasp frame in the flange's frame.
    """

    name: str
    arm: str
    gripper: str
    model_sha256: str
    base_body: str
    base_position_m: Vector
    base_quaternion: Vector
    flange_body: str
    tool_position_m: Vector
    tool_quaternion: Vector

    def __post_init__(self) -> None:
        for key, size in (("base_position_m", 3), ("base_quaternion", 4), ("tool_position_m", 3), ("tool_quaternion", 4)):
            _require(len(getattr(self, key)) == size, f"{key} has {len(getattr(self, key))} numbers, not {size}")


@dataclass(frozen=True)
class TaskCard:
    """The task: table, object, goal, and what counts as success.

    Attributes:
        name: on the command line.
        object: its shape, size [m] and mass [kg].
        object_xy_m, noise_xy_m, noise_yaw_rad: where it starts.
        table_top_m, table_size_m: the table.
        goal_offset_m: goal from the object's start.  goal_tolerance_m: distance that counts as reached.
        hold_steps: policy steps at the goal that make a success.  horizon_steps: of an episode.
        lost_below_m: height of the object under which it has fallen off the table.
    """

    name: str
    object: dict[str, Any]
    object_xy_m: Vector
    noise_xy_m: float
    noise_yaw_rad: float
    table_top_m: float
    table_size_m: Vector
    goal_offset_m: Vector
    goal_tolerance_m: float
    hold_steps: int
    horizon_steps: int
    lost_below_m: float


@dataclass(frozen=True)
class Watch:
    """When the runtime stops trusting what it is told.

    Attributes:
        stale_s: age of a state from which the arm is held.
        late_ticks: consecutive ticks that end after their period from which the arm is held.
        hold_ticks: ticks that the arm is held before it is stopped.
        held_m: distance of object from grasp frame from which a lifted object counts as lost.
        tracking_rad: difference of measured from commanded joint angle from which the arm is held.
    """

    stale_s: float
    late_ticks: int
    hold_ticks: int
    held_m: float
    tracking_rad: float

    def __post_init__(self) -> None:
        _require(min(self.stale_s, self.late_ticks, self.hold_ticks, self.held_m, self.tracking_rad) > 0, "a limit is not positive")


@dataclass(frozen=True)
class Lineage:
    """Where the policy comes from.

    Attributes:
        source: robot of the expert.  route: robots on the evolution tree, source first.
        alpha: (D,) the target in the evolution space.
        kind, metric: of the tree.  train_iterations, sim_epochs: updates and training episodes along the route.
    """

    source: str
    route: tuple[str, ...]
    alpha: Vector
    kind: str
    metric: str
    train_iterations: int
    sim_epochs: int


@dataclass(frozen=True)
class Success:
    """The label: success on the unmodified robosuite robot.

    Attributes:
        episodes, successes, success_rate: counts.  ci95: 95 % Wilson interval.
        seed: of the first episode; the others follow.
        measured: how.
    """

    episodes: int
    successes: int
    success_rate: float
    ci95: Vector
    seed: int
    measured: str

    def __post_init__(self) -> None:
        _require(0 <= self.successes <= self.episodes and self.episodes > 0, f"{self.successes} of {self.episodes} is no count")
        _require(len(self.ci95) == 2 and 0 <= self.ci95[0] <= self.success_rate <= self.ci95[1] <= 1, "ci95 does not hold success_rate")


@dataclass(frozen=True)
class Golden:
    """The recorded proof in golden.npz.

    Attributes:
        tolerance: of the ONNX action against the recorded one.
        vectors: observations with their expected actions.
        seed, steps, success: of the closed-loop episode.
        onnx_max_abs_error: of the ONNX file against the trained policy over that episode, at export.
    """

    tolerance: float
    vectors: int
    seed: int
    steps: int
    success: bool
    onnx_max_abs_error: float


@dataclass(frozen=True)
class Graph:
    """The ONNX graph.

    Attributes:
        opset, ir_version: of ONNX.  type: of inputs and output.  output: its name.
    """

    opset: int
    ir_version: int
    type: Literal["float32"]
    output: Literal["action"]


@dataclass(frozen=True)
class NullSpace:
    """What the arm's redundant joints do, in the null space of the six goals.

    Attributes:
        posture_rad: (n,) where they are pulled.
        kp: [1/s^2].  kd: [1/s].
        law: torque, before it is projected by N^T, N = I - M^-1 J^T L J.
    """

    posture_rad: Vector
    kp: float
    kd: float
    law: str


@dataclass(frozen=True)
class Osc:
    """robosuite's controller as it stands in the simulation, for who writes one of his own.

    Attributes:
        config: robosuite's whole configuration of it; arrays as lists.
        goal_from: "achieved": a delta is added to the pose where the grasp frame is; "desired": to the last goal.
        reference_frame: "base": deltas and the goal between two actions are kept in the base site's frame.
        base_position_m, base_quaternion: of that site at the start, task frame, w first.
        decoupled: whether force and torque have an inertia each (L_p, L_r), not one of both.
        null_space: of the redundant joints.
        torque_limit_nm: (n,) to which the torques are cut.  compensation: what is added to them.
        law: of the torques, every physics step.  orientation_error: e_R in it.
    """

    config: dict[str, Any]
    goal_from: str
    reference_frame: str
    base_position_m: Vector
    base_quaternion: Vector
    decoupled: bool
    null_space: NullSpace
    torque_limit_nm: Vector
    compensation: str
    law: str
    orientation_error: str


@dataclass(frozen=True)
class Actuator:
    """One motor of the gripper, a position servo.

    Attributes:
        name: robosuite's, without its prefix.  joint: that it drives.
        start: robosuite's integrated state at the start of an episode, -1 to 1.
        sign: of that state's change when the action closes; it changes by gripper.rate per policy step, and is cut to -1 to 1.
        low, high: position target at the states -1 and +1, in the joint's unit.
        nonlinearity: largest distance of the target in between from the straight line, in the joint's unit.
        stiffness, damping: of the servo, per radian or metre.  force: (2,) range of what it gives [N m or N]; None: any.
    """

    name: str
    joint: str
    start: float
    sign: float
    low: float
    high: float
    nonlinearity: float
    stiffness: float
    damping: float
    force: Vector | None


@dataclass(frozen=True)
class ClosingProgress:
    """The observation's entry of that name.

    Attributes:
        formula: of ``command``, gripper.law's number, and ``preshape``, gripper.preshape.
        low, high: its values at the commands -1 and +1; below -1 where the preshape is not quite open.
    """

    formula: str
    low: float
    high: float


@dataclass(frozen=True)
class Material:
    """How a shape touches, in MuJoCo's terms. Of two that touch the larger friction counts, the mean of solref and solimp.

    Attributes:
        friction: (3,) sliding [1], spinning [m], rolling [m].  solref: (2,) time constant [s], damping ratio.
        solimp: (5,).  margin_m, gap_m: distances at which contacts begin and push.  condim, priority: MuJoCo's.
    """

    friction: Vector
    solref: Vector
    solimp: Vector
    margin_m: float
    gap_m: float
    condim: int
    priority: int


@dataclass(frozen=True)
class Physics:
    """MuJoCo's options.

    Attributes:
        timestep_s: of a physics step.  substeps: of them per policy step.
        integrator, cone, solver: by MuJoCo's names.  iterations, tolerance, impratio, noslip_iterations: of the solver.
        gravity_m_s2: (3,) task frame.
    """

    timestep_s: float
    substeps: int
    integrator: str
    cone: str
    solver: str
    iterations: int
    tolerance: float
    impratio: float
    noslip_iterations: int
    gravity_m_s2: Vector


@dataclass(frozen=True)
class Sampling:
    """When an observation is taken.

    Attributes:
        when: in words.
        joint_age_s, pose_age_s: of joint angles, and of the poses of grasp frame and object, when the policy sees them.
        golden_pose_age_s: the same of poses in golden.npz.
    """

    when: str
    joint_age_s: float
    pose_age_s: float
    golden_pose_age_s: float


@dataclass(frozen=True)
class Starts:
    """Where the episodes of the label began.

    Attributes:
        generator: of random numbers, one per episode, from its seed.
        seed, episodes: of the first episode, and how many; each next seed is larger by one.
        draws: in this order, each uniform from ``low`` to ``high`` (n,) [m, m, rad].
        meaning: of the draws.
        goal_from: what task.goal_offset_m is added to.
        examples: (k, 7) of the first k seeds: object's x, y, z [m], its yaw [rad], goal's x, y, z [m]; task frame.
    """

    generator: str
    seed: int
    episodes: int
    draws: tuple[str, ...]
    low: Vector
    high: Vector
    meaning: str
    goal_from: str
    examples: tuple[Vector, ...]

    def __post_init__(self) -> None:
        _require(len(self.draws) == len(self.low) == len(self.high), "draws, low and high differ in length")


@dataclass(frozen=True)
class Holding:
    """How steps at the goal are counted.

    Attributes:
        consecutive: whether one step away from the goal begins the count anew.
        strict: whether a distance of exactly the tolerance is away.
        counted: when.
    """

    consecutive: bool
    strict: bool
    counted: str


@dataclass(frozen=True)
class Stopping:
    """How far the arm still goes when it is held in motion, under `osc`, without load, in simulation.

    Attributes:
        action: delta that moved it, of 1.  speed_m_s: when it was held.
        distance_m: farthest that the grasp frame came from where it was then, the worst of the directions tried.
        time_s: until it moved by less than a tenth of a millimetre per policy step.
    """

    action: float
    speed_m_s: float
    distance_m: float
    time_s: float


@dataclass(frozen=True)
class BrakingDistance:
    """How far the arm still goes when it is held in motion, without load, in simulation; under `pose` and `joint` on a stiff arm.

    Attributes:
        form: of the commands.  speed_m_s: of the grasp frame when it was held.
        distance_m: farthest that the grasp frame came from where it was then, the worst of the directions tried.
        time_s: until it moved by less than a tenth of a millimetre per policy step.
    """

    form: Literal["osc", "pose", "joint"]
    speed_m_s: float
    distance_m: float
    time_s: float


@dataclass(frozen=True)
class Braking:
    """Where the arm would come to rest, were it held now.

    Attributes:
        distances: measured; form by form, slowest first.
        table_clearance_m: smallest height above the table at which the gripper's lowest point would then be; from undisturbed episodes and,
            from format version 6 on, those that are late by up to Manifest.borne_delay_steps; negative where the gripper comes down to the
            object so fast that a hold would set it on the table.
    """

    distances: tuple[BrakingDistance, ...]
    table_clearance_m: float

    def __post_init__(self) -> None:
        _require(len(self.distances) > 0, "distances is empty")
        _require(min(min(d.speed_m_s, d.distance_m) for d in self.distances) >= 0, "a speed or a distance is negative")

    @property
    def curves(self) -> dict[str, tuple[Vector, Vector]]:
        """Form -> rising speeds [m/s], from rest on, and the distance [m] gone from each; between them it is taken as linear."""
        forms = dict.fromkeys(d.form for d in self.distances)
        return {form: ((0.0, *(d.speed_m_s for d in self.distances if d.form == form)),
                       (0.0, *(d.distance_m for d in self.distances if d.form == form))) for form in forms}


@dataclass(frozen=True)
class Simulation:
    """All that closes the loop around the policy where its label was measured, read there at export.

    Attributes:
        environment: what it was.  mount_position_m: of the robot's mount, task frame, as given to robosuite's set_base_xpos.
        osc: the controller.  actuators: of the gripper, in robosuite's order.  closing_progress: see there.
        materials: shape -> how it touches; "table", "object" and the gripper's shapes by name.
        object_density_kg_m3: that gives its mass.
        physics, sampling, starts, holding: see there.  stopping: slowest first; empty from format version 5 on, which has it for every
            form of command in Manifest.braking.
    """

    environment: str
    mount_position_m: Vector
    osc: Osc
    actuators: tuple[Actuator, ...]
    closing_progress: ClosingProgress
    materials: dict[str, Material]
    object_density_kg_m3: float
    physics: Physics
    sampling: Sampling
    starts: Starts
    holding: Holding
    stopping: tuple[Stopping, ...]

    def __post_init__(self) -> None:
        _require(len(self.mount_position_m) == 3, "mount_position_m is no vector of 3")
        _require({"table", "object"} <= set(self.materials), "materials lacks table or object")


@dataclass(frozen=True)
class Held:
    """Where the policy holds in one condition of a laboratory, all others as in training; measured by ``meta-evolve stress``.

    Attributes:
        name, unit, meaning: of the condition.  nominal: in training.
        low, high: interval of tried values around the nominal one in which at least 0.9 of the episodes succeeded.
        lowest, highest: values that were tried: where they are ``low`` and ``high``, the end was not found.
        episodes: of each value.
    """

    name: str
    unit: str
    meaning: str
    nominal: float
    low: float
    high: float
    lowest: float
    highest: float
    episodes: int

    def __post_init__(self) -> None:
        _require(self.lowest <= self.low <= self.nominal <= self.high <= self.highest, "low, nominal and high are in no order")
        _require(self.episodes > 0, "episodes is not positive")


@dataclass(frozen=True)
class Manifest:
    """All of it; see the records.

    Attributes:
        format, format_version: of this file.  robot, task, lineage, success, golden, graph: see the records.
        frames: name -> what it is.  policy_hz: actions per second.  controller_hz: physics steps and torques per second.
        controller: under which it was trained.  observation, action: in the graph's order.  joints: of the arm, base to flange.
        fingers: entry of the observation -> its joint; an entry that is not there is 0.  gripper: its law.
        start: of an episode.  cartesian, watch: limits.  versions: software that exported it.
        run: the configuration of the run that trained the policy.  sha256: file -> digest.
        simulation: all that else closes the loop.  licence: of the bundle, by SPDX. Both None in format version 2.
        holds: under which conditions of a laboratory the policy holds; empty: not measured. None before format version 4.
        braking: where the arm would come to rest, were it held. None before format version 5.
        borne_delay_steps: policy steps by which states, or orders, may be late in simulation: the policy succeeds in at least 0.9 of the
            episodes, and the gripper comes as little on the table as undisturbed. Longer delays were not tried than those after which a
            state counts as stale. None before format version 6.
    """

    format: str
    format_version: int
    robot: RobotCard
    task: TaskCard
    frames: dict[str, str]
    policy_hz: float
    controller_hz: float
    controller: Controller
    observation: tuple[Observed, ...]
    action: tuple[Acted, ...]
    fingers: dict[str, Finger]
    gripper: Gripper
    start: Start
    joints: tuple[Joint, ...]
    cartesian: Cartesian
    watch: Watch
    lineage: Lineage
    success: Success
    golden: Golden
    graph: Graph
    versions: dict[str, str]
    run: dict[str, Any]
    sha256: dict[str, str]
    simulation: Simulation | None = None
    licence: str | None = None
    holds: tuple[Held, ...] | None = None
    braking: Braking | None = None
    borne_delay_steps: int | None = None

    def __post_init__(self) -> None:
        for key, version in SINCE.items():
            fits = (getattr(self, key) is None) == (self.format_version < version)
            _require(fits, f"{key} does not fit format version {self.format_version}")
        _require((self.borne_delay_steps or 0) >= 0, "borne_delay_steps is negative")
        _require(self.policy_hz > 0 and self.controller_hz >= self.policy_hz, "policy_hz and controller_hz are no rates")
        for key in ("observation", "action", "joints"):
            names = [entry.name for entry in getattr(self, key)]
            _require(len(names) > 0 and len(set(names)) == len(names), f"{key} is empty or names an entry twice")
        _require(len(self.start.arm_rad) == len(self.joints), "start.arm_rad does not fit joints")
        fingers = set(self.gripper.joints)
        _require(set(self.start.fingers) == fingers, "start.fingers does not fit gripper.joints")
        used = {finger.joint for finger in self.fingers.values()} | set(self.gripper.targets)
        _require(used <= fingers, f"{sorted(used - fingers)} is not among gripper.joints")
        named = {entry.name for entry in self.observation}
        _require(set(self.fingers) <= named, f"fingers names {sorted(set(self.fingers) - named)}, which the observation lacks")

    def to_json(self) -> dict[str, Any]:
        """As it is written, JSON values only."""
        content = json.loads(json.dumps(asdict(self), allow_nan=False))
        return {key: value for key, value in content.items() if self.format_version >= SINCE.get(key, 0)}

    def label(self) -> dict[str, Any]:
        """What the ONNX file carries: all but the files' hashes, of which its own would be one."""
        return {key: value for key, value in self.to_json().items() if key != "sha256"}


def read_manifest(content: Any, where: str) -> Manifest:
    """A manifest from JSON values.

    Args:
        content: as ``json.loads`` gave it.
        where: file, for messages.

    Raises:
        ToolkitError: another format or version, or an entry that is missing, unknown, of another kind or out of range.
    """
    if not isinstance(content, dict) or content.get("format") != FORMAT:
        raise ToolkitError(f"{where} is no manifest of a {FORMAT}; give a folder that an export wrote")
    version = content.get("format_version")
    if type(version) is not int or version not in READABLE:
        raise ToolkitError(
            f"{where} has format version {_shown(version)}; this release reads {READABLE[0]} to {READABLE[-1]}; export the "
            "bundle again, with: meta-evolve export"
        )
    content = {key: None for key, since in SINCE.items() if version < since} | content
    return _read(Manifest, content, where, "")


def _read(kind: Any, value: Any, where: str, path: str) -> Any:
    """The value as the annotated kind, or a sentence that names its path."""

    def refuse(why: str) -> ToolkitError:
        return ToolkitError(f"{where} lacks or garbles {path.removeprefix('.')!r} ({why}); export the bundle again")

    origin, arguments = typing.get_origin(kind), typing.get_args(kind)
    if is_dataclass(kind):
        if not isinstance(value, dict):
            raise refuse(f"{_shown(value)} is no record")
        hints = typing.get_type_hints(kind)
        names = [f.name for f in fields(kind)]
        odd = [name for name in names if name not in value] + [name for name in value if name not in names]
        if odd:
            path = f"{path}.{odd[0]}"
            raise refuse("missing" if odd[0] in names else "unknown")
        read = {name: _read(hints[name], value[name], where, f"{path}.{name}") for name in names}
        try:
            record: Any = kind  # is_dataclass leaves open whether it is the class or one of its records
            return record(**read)
        except ValueError as error:
            raise refuse(str(error)) from None
    if origin is tuple:
        if not isinstance(value, list):
            raise refuse(f"{_shown(value)} is no list")
        return tuple(_read(arguments[0], item, where, f"{path}[{i}]") for i, item in enumerate(value))
    if origin is dict:
        if not isinstance(value, dict):
            raise refuse(f"{_shown(value)} is no object")
        return {key: _read(arguments[1], item, where, f"{path}.{key}") for key, item in value.items()}
    if origin in (types.UnionType, typing.Union):
        return None if value is None else _read(arguments[0], value, where, path)
    if origin is Literal:
        if not isinstance(value, str | int | float) or value not in arguments or isinstance(value, bool) != isinstance(arguments[0], bool):
            raise refuse(f"{_shown(value)} is not {arguments[0]!r}")
        return value
    if kind is Any:
        if not _plain(value):
            raise refuse("it holds a number that is not finite")
        return value
    if kind is float:
        try:
            number = math.nan if isinstance(value, bool) or not isinstance(value, int | float) else float(value)
        except OverflowError:  # a whole number beyond all floats
            number = math.inf
        if not math.isfinite(number):
            raise refuse(f"{_shown(value)} is no finite number")
        return number
    if not isinstance(value, kind) or (kind is int and isinstance(value, bool)):
        raise refuse(f"{_shown(value)} is no {kind.__name__}")
    return value


def _plain(value: Any) -> bool:
    """Whether all numbers in a JSON value are finite."""
    if isinstance(value, dict | list):
        return all(map(_plain, value.values() if isinstance(value, dict) else value))
    return not isinstance(value, float) or math.isfinite(value)


def _shown(value: Any) -> str:
    try:
        text = repr(value)
    except (ValueError, RecursionError):  # a whole number of thousands of digits; levels without end
        text = f"a {type(value).__name__} beyond showing"
    return text if len(text) <= 40 else text[:37] + "..."

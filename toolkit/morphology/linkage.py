"""Four-bar fingers as open chains: what a gripper's linkages do to its knuckles and pads, measured on the gripper itself.

robosuite keeps such a linkage in shape by soft meshes that press on each other and by tendons between the joints. All that
an object feels of it are two torques on a finger, one on its driven knuckle and one on its pad joint. They are recorded where
the gripper has closed at its own rate, as it does in a task, in free air and on boxes of several widths, and an elastic model
of two angles is fitted to them: with the knuckle at q, the pad at p (merged angles, zero at the start posture),

    on the knuckle  -R(q) + K P'(q) (p - P(q)) - g k max(0, s - (p - g q))      R(q) = u + a q + b q^2
    on the pad              -K      (p - P(q)) +   k max(0, s - (p - g q))      P(q) = c1 q + c2 q^2

R is what the linkage costs the motor, P the pad's way in free air, K how softly it keeps to it, and the last term the stop
against which an object turns the pad. A damper on the knuckle, fitted with them, lets it arrive in the same time. Friction within
the linkage is left out: closing is fitted, opening lags by it. But it decides where a pad goes: closed 25 times slower than a task
does, or with slippery meshes, the Robotiq 85's pads turn three times as far in free air and feel a fifth of the hold. So the rate
is the gripper's own, and a box is slippery while the linkage is not.
"""

import copy
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import product

import mujoco
import numpy as np
from scipy.optimize import least_squares

from grippers.gripper import DIGIT_OF
from robots.robot import Robot
from tasks.pick import START_POSITION
from toolkit.errors import ToolkitError
from toolkit.morphology.native_scene import NativeScene, role_actuators, role_joints
from toolkit.morphology.posture import target_at

CLAMP = 1e6
"""Armature [kg, kg m^2] and damping [N s/m, N m s/rad] that hold an arm, or a box, still."""
SLIPPERY = 1e-3
"""Friction coefficient on a squeezed box: with more, the stall depends on how the fingers came to stick."""
BOX_HALF_SIZE = (0.04, 0.025, 0.025)
"""Half extents [m] of a squeezed box, its second axis across the jaws unless a width is given."""
CLOSING_STEPS, CLOSING_STEP = 10, 0.05
"""Steps, and seconds each, in which a gripper closes on a box: robosuite's rate for its two-jaw grippers."""
BOX_WIDTH = 0.05
"""Width [m] of the reference box across the jaws: the foam brick's, and the middle of what the grippers hold."""
SQUEEZE, SETTLED = 1.5, 0.1
"""Time [s] from the full closing command on it to a measurement, and the last part of that, over which forces are averaged."""
OUT_OF_REACH = (3.0, 3.0, 3.0)
"""Where the object waits [m] while a gripper moves in free air."""
COMMANDS = tuple(np.linspace(-1.0, 1.0, 17))
"""Closing commands at which the linkage is recorded in free air."""
WIDTHS = (0.03, 0.05, 0.07, 0.09)
"""Widths [m] of the boxes on which it is recorded."""
SQUEEZES = (0.3, 1.0)
"""Closing commands at which it is recorded on each box."""
MOVING, SETTLING, AVERAGED, SAMPLES = 0.01, 0.1, 0.1, 10
"""Time [s] at the end of the last step that closes, after it, and that over which what has settled is recorded; records are means
of so many samples: soft meshes never quite rest, and over seconds pads creep."""
AIR_WEIGHT, CURVE_WEIGHT, STOP_WEIGHT = 4.0, 20.0, 0.1
"""Weights of the fit beside 1 per N m on a knuckle or a pad that squeezes: per N m on a knuckle in free air, where poses are all
there is to keep; per rad by which the stop pushes a pad off its curve there; and per N m/rad of the stop, which few squeezes tell
from the hold: without it the two fingers of one Robotiq 85 come out as different."""


@dataclass(frozen=True)
class Linkage:
    """One finger's linkage as springs of an open chain, in merged angles.

    Attributes:
        driven, pad, knuckle: roles of the driven joint, of the pad's joint and of the inner knuckle.
        turn: +1 if the pad's merged axis points as the driven joint's, else -1: in what follows p is turn times its angle.
        stiffness: of the driven joint's spring [N m/rad], at rest.  quadratic: its growth [N m/rad^2].  rest: [rad].
        damping: of the driven joint [N m s/rad].
        curve: (c1, c2) of the pad's way P(q) [1, 1/rad].  hold: K [N m/rad].
        stop: k [N m/rad].  gear: g.  slack: s [rad].
    """

    driven: str
    pad: str
    knuckle: str
    turn: float
    stiffness: float
    quadratic: float
    rest: float
    damping: float
    curve: tuple[float, float]
    hold: float
    stop: float
    gear: float
    slack: float


# ---- a gripper on a bench --------------------------------------------------------------------------------------------


def clamp(model: mujoco.MjModel, dofs: np.ndarray) -> None:
    """Hold degrees of freedom still."""
    model.dof_armature[dofs], model.dof_damping[dofs] = CLAMP, CLAMP


def become_box(model: mujoco.MjModel, body: int, width: float) -> None:
    """Turn a body's geoms into one slippery box, ``width`` [m] across the jaws, clamped in the air."""
    half = np.array(BOX_HALF_SIZE)
    half[1] = width / 2
    geoms = np.flatnonzero(model.geom_bodyid == body)
    model.geom_type[geoms] = mujoco.mjtGeom.mjGEOM_BOX
    model.geom_size[geoms] = half
    model.geom_rbound[geoms] = np.linalg.norm(half)
    model.geom_aabb[geoms] = (0.0, 0.0, 0.0, *half)
    nodes = np.arange(model.body_bvhadr[body], model.body_bvhadr[body] + model.body_bvhnum[body])
    model.bvh_aabb[nodes, 3:] = 2.0 * half.max()  # loose: only the broad phase looks at it
    model.geom_friction[geoms] = SLIPPERY
    model.geom_priority[geoms] = model.geom_priority.max() + 1  # else MuJoCo takes the larger friction of two geoms that touch
    model.opt.gravity[:] = 0.0
    clamp(model, model.jnt_dofadr[model.body_jntadr[body]] + np.arange(6))


def closed_on_box(
    model: mujoco.MjModel, start: np.ndarray, arm: Sequence[int], item: int, actuators: Sequence[int],
    targets: Callable[[float], np.ndarray], preshape: float, width: float = BOX_WIDTH, steps: int = CLOSING_STEPS,
) -> tuple[mujoco.MjModel, mujoco.MjData]:
    """A gripper closed on a box in its grasp frame, the arm and the box held still.

    Args:
        model: the scene; not changed.  start: (nq,) at the start posture.
        arm: joint ids.  item: body id of what becomes the box.
        actuators: finger actuators.  targets: closing command -> theirs (n,).
        preshape: closing command at the start.
        width: of the box across the jaws [m].
        steps: in which it closes; 0: it is not told to.

    Returns:
        the bench's own model, and its data after SQUEEZE.
    """
    bench = copy.copy(model)
    clamp(bench, bench.jnt_dofadr[list(arm)])
    become_box(bench, item, width)
    data = mujoco.MjData(bench)
    data.qpos[:] = start
    data.qpos[bench.jnt_qposadr[bench.body_jntadr[item]] + np.arange(7)] = (*START_POSITION, 1.0, 0.0, 0.0, 0.0)
    seconds = [CLOSING_STEP] * steps + [SQUEEZE - SETTLED] * (steps > 0)
    commands = [*np.linspace(preshape, 1.0, steps + 1)[1:], *([1.0] * (steps > 0))]
    for command, time in zip(commands, seconds, strict=True):
        data.ctrl[list(actuators)] = targets(command)
        mujoco.mj_step(bench, data, int(round(time / bench.opt.timestep)))
    return bench, data


def jaws_meet(model: mujoco.MjModel, data: mujoco.MjData, jaws: Sequence[np.ndarray]) -> bool:
    """Whether a body of one jaw touches one of the other; each jaw is a mask (nbody,)."""
    touching = model.geom_bodyid[data.contact.geom]
    one, other = (jaw[touching] for jaw in jaws)
    return bool(np.any(one[:, 0] & other[:, 1] | one[:, 1] & other[:, 0]))


class _Bench:
    """A gripper's native scene with the arm and the object held still.

    Args:
        model: of the scene.
        start: (nq,) configuration at the start posture.
        robot: whose gripper it is.
        signs: role -> sense of the merged angle.
        roles: whose joints are recorded.
    """

    def __init__(
        self, model: mujoco.MjModel, start: np.ndarray, robot: Robot, signs: Mapping[str, float], roles: Sequence[str]
    ) -> None:
        self.robot, self.model = robot, copy.copy(model)
        self.data = mujoco.MjData(self.model)
        joints, bodies = role_joints(model, robot), model.jnt_bodyid
        self._actuators = role_actuators(model, robot)
        self._qpos = model.jnt_qposadr[[joints[role] for role in roles]]
        self._dof = model.jnt_dofadr[[joints[role] for role in roles]]
        self._sign = np.array([signs[role] for role in roles])
        thumb = [bodies[joint] for role, joint in joints.items() if DIGIT_OF[role].opposes]
        fingers = [bodies[joint] for role, joint in joints.items() if not DIGIT_OF[role].opposes]
        self._jaws = [np.isin(np.arange(model.nbody), jaw) for jaw in (thumb, fingers)]
        scene = NativeScene(model)
        free = scene.object_joint
        self.item, self._item_qpos = int(bodies[free]), int(model.jnt_qposadr[free])
        clamp(self.model, scene.arm_dofs)
        clamp(self.model, model.jnt_dofadr[free] + np.arange(6))
        self._start = start
        self.place(OUT_OF_REACH)

    def place(self, position: Sequence[float] | np.ndarray) -> None:
        """Everything at its start, the object at ``position`` (3,) [m]."""
        mujoco.mj_resetData(self.model, self.data)
        self.data.qpos[:] = self._start
        self.data.qpos[self._item_qpos : self._item_qpos + 7] = (*position, 1.0, 0.0, 0.0, 0.0)
        mujoco.mj_forward(self.model, self.data)

    def run(self, command: float, seconds: float) -> None:
        """Simulate at a closing command."""
        for role, actuator in self._actuators.items():
            self.data.ctrl[actuator] = target_at(self.robot, role, command)
        mujoco.mj_step(self.model, self.data, int(round(seconds / self.model.opt.timestep)))

    @property
    def jaws_meet(self) -> bool:
        """Whether the thumb touches another finger."""
        return jaws_meet(self.model, self.data, self._jaws)

    @property
    def holds(self) -> bool:
        """Whether anything touches the object."""
        return bool(np.any(self.model.geom_bodyid[self.data.contact.geom] == self.item))

    def close(self, position: Sequence[float] | np.ndarray, command: float) -> tuple[np.ndarray, np.ndarray]:
        """Close from the start to a command at the gripper's own rate, the object at ``position`` (3,): what is recorded at the
        end of the last step, still moving, and what when it has settled."""
        gripper = self.robot.gripper
        if gripper.rate is None:
            raise ToolkitError(f"gripper {gripper.name} is on four-bar linkages, but its card has no rate of closing; give it one")
        self.place(position)
        steps = int(np.ceil((command - gripper.preshape) / gripper.rate - 1e-9))
        for step in range(1, steps):
            self.run(gripper.preshape + step * gripper.rate, CLOSING_STEP)
        self.run(command, CLOSING_STEP - MOVING)
        moving = self.record(command, MOVING)
        self.run(command, SETTLING)
        return moving, self.record(command, AVERAGED)

    def record(self, command: float, seconds: float) -> np.ndarray:
        """(3, n_roles): merged angles [rad], the linkage's torques [N m] and speeds [rad/s], averaged over a time at a command."""
        rows = []
        for _ in range(SAMPLES):
            self.run(command, seconds / SAMPLES)
            # All that acts on a joint but its actuator, its weight and the object.
            torque = self.data.qfrc_constraint + self.data.qfrc_spring - self._by_object()
            angles = self.data.qpos[self._qpos] - self._start[self._qpos]
            rows.append(self._sign * np.array([angles, torque[self._dof], self.data.qvel[self._dof]]))
        return np.mean(rows, axis=0)

    def _by_object(self) -> np.ndarray:
        """(nv,) generalised force of the object on the gripper."""
        model, data = self.model, self.data
        total, force, jacobian = np.zeros(model.nv), np.zeros(6), np.zeros((3, model.nv))
        for index in np.flatnonzero(np.any(model.geom_bodyid[data.contact.geom] == self.item, axis=1)):
            contact = data.contact[index]
            bodies = model.geom_bodyid[contact.geom]
            mujoco.mj_contactForce(model, data, index, force)
            on_second = contact.frame.reshape(3, 3).T @ force[:3]
            hand, push = (bodies[1], on_second) if bodies[0] == self.item else (bodies[0], -on_second)
            mujoco.mj_jac(model, data, jacobian, None, contact.pos, hand)
            total += jacobian.T @ push
        return total


def _in_air(bench: _Bench) -> np.ndarray:
    """(n, 2, 3, n_roles) records, moving and settled, at rising commands until the jaws meet."""
    rows = []
    for command in COMMANDS:
        row = bench.close(OUT_OF_REACH, command)
        if bench.jaws_meet:
            break
        rows.append(row)
    return np.array(rows)


def _on_boxes(bench: _Bench, grasp: np.ndarray) -> np.ndarray:
    """(n, 2, 3, n_roles) records of squeezes of boxes in the grasp frame's origin (3,), as wide as the jaws allow."""
    rows = []
    for width, squeeze in product(WIDTHS, SQUEEZES):
        become_box(bench.model, bench.item, width)
        bench.place(grasp)
        if bench.holds:
            break
        rows.append(bench.close(grasp, squeeze))
    return np.array(rows)


# ---- springs that do the same ----------------------------------------------------------------------------------------


def _torques(parameters: np.ndarray, curve: np.ndarray, q: np.ndarray, p: np.ndarray) -> np.ndarray:
    """(2, n) [N m]: the module's model on knuckle and pad; parameters (K, k, s, g, u, a, b, ...), curve (c1, c2)."""
    hold, stop, slack, gear, *cost = parameters[:7]
    away = p - curve[0] * q - curve[1] * q**2
    pushed = np.maximum(0.0, slack - (p - gear * q))
    return np.array(
        [-np.polyval(cost[::-1], q) + hold * (curve[0] + 2.0 * curve[1] * q) * away - gear * stop * pushed, -hold * away + stop * pushed]
    )


def _fitted(air: np.ndarray, loaded: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Parameters (8,), the last the knuckle's damping D, and curve (2,) from records (n, 2, 3, 2) of one finger.

    The axes of a record: moving or settled; angle, torque or speed; knuckle or pad. The curve is the way in free air; the rest
    is least squares on the torques of all records, the pads' on boxes only moving: an object is won or lost while they close.
    """
    free = np.concatenate(air)
    q, p = free[:, 0].T
    curve = np.linalg.lstsq(np.stack([q, q**2], axis=1), p, rcond=None)[0]

    def off(x: np.ndarray, records: np.ndarray) -> np.ndarray:
        """(2, n): knuckle and pad."""
        damped = np.stack([x[7] * records[:, 2, 0], np.zeros(len(records))])
        return _torques(x, curve, *records[:, 0].T) - damped - records[:, 1].T

    def error(x: np.ndarray) -> np.ndarray:
        in_air, moving, settled = off(x, free), off(x, loaded[:, 0]), off(x, loaded[:, 1])
        off_curve = in_air[1] / x[0]
        return np.concatenate(
            [AIR_WEIGHT * in_air[0], CURVE_WEIGHT * off_curve, moving[0], settled[0], moving[1], STOP_WEIGHT * x[1:2]]
        )

    low = np.array([0.1, 0.0, -1.0, -2.0, -np.inf, 0.0, -np.inf, 0.0])
    high = np.array([100.0, 100.0, 1.0, 2.0, np.inf, np.inf, np.inf, np.inf])
    guesses = product((1.0, 3.0), (-0.3, 0.0, 0.5))  # the stop makes the valley bend: several ways in
    fits = [least_squares(error, [hold, 3.0, 0.0, gear, 1.0, 9.0, 0.0, 1.0], bounds=(low, high)) for hold, gear in guesses]
    return min(fits, key=lambda fit: fit.cost).x, curve


def _spring(u: float, a: float, b: float) -> tuple[float, float, float]:
    """Stiffness, quadratic part and rest of MuJoCo's spring that gives R(q) = u + a q + b q^2 beyond its rest."""
    rest = -2.0 * u / (a + np.sqrt(max(a * a - 4.0 * b * u, 0.0)))  # the root next to zero, also where b vanishes
    return float(a + 2.0 * b * rest), float(b), float(rest)


def equivalent_linkages(
    model: mujoco.MjModel, data: mujoco.MjData, robot: Robot, signs: Mapping[str, float], grasp: np.ndarray
) -> list[Linkage]:
    """Each driven finger's linkage of a gripper, measured at the start posture of its robot.

    Args:
        model, data: the robot's native scene at its start posture.
        robot: the card; its gripper is a four-bar one.
        signs: role -> +1 or -1, the sense of the merged angle.
        grasp: origin (3,) [m] of the grasp frame, in which boxes are squeezed.

    Raises:
        ToolkitError: the jaws meet at once, or no box fits between them, so that there is nothing to fit to.
    """
    driven = tuple(robot.gripper.targets)
    digits = [DIGIT_OF[role] for role in driven]
    pads, knuckles = tuple(digit.pad for digit in digits), [digit.knuckle for digit in digits if digit.knuckle is not None]
    bench = _Bench(model, np.array(data.qpos), robot, signs, driven + pads)
    air, loaded = _in_air(bench), _on_boxes(bench, grasp)
    if len(air) < 3 or not len(loaded):
        raise ToolkitError(
            f"gripper {robot.gripper.name}: its linkage cannot be measured, because its jaws start closed on a box of "
            f"{1e3 * WIDTHS[0]:.0f} mm or on each other; check its card's targets and preshape"
        )
    joints, out = role_joints(model, robot), []
    for i, role in enumerate(driven):
        axes = [signs[name] * data.xaxis[joints[name]] for name in (role, pads[i])]
        turn = float(np.sign(axes[0] @ axes[1]))
        finger, senses = [i, len(driven) + i], np.array([1.0, turn])
        (hold, stop, slack, gear, *cost, damping), curve = _fitted(air[..., finger] * senses, loaded[..., finger] * senses)
        out.append(
            Linkage(
                role, pads[i], knuckles[i], turn, *_spring(*cost), float(damping),
                (float(curve[0]), float(curve[1])), float(hold), float(stop), float(gear), float(slack),
            )
        )
    return out

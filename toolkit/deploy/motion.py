"""From robosuite's action to a command, in three forms, never outside the manifest's limits.

An action is a delta of the goal under robosuite's controller, which the arm follows only in part: by the measured
response. `osc` passes the delta on to a controller of that kind. `pose` and `joint` command what the arm would have done:
the grasp frame's expected motion is the sum of the last actions' impulse responses, so that a commanded metre is a metre.
"""

from typing import Protocol

import numpy as np

from toolkit.bundle.manifest import Manifest
from toolkit.deploy.arm import Command, Form
from toolkit.deploy.kinematics import JointSolver, Kinematics, matrix_of, quaternion_of, quaternions_of, rotation_of, sandwich, vector_of

CATCH_UP = 0.5
"""Share of the distance between wanted and commanded place that one tick makes up; 1 would ring."""
FLOOR = 0.001
"""[m] above the table's clearance at which a commanded motion ends: fingers come down as they close, after a motion was planned."""


def _within(values: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """np.clip in half its time, for the dozen clips of a tick."""
    return np.minimum(np.maximum(values, low), high)


class Track:
    """Coordinates that move with bounded speed and acceleration and can always stop before their limits.

    The acceleration is constant over a tick, so the limits hold between ticks too.

    Args:
        low, high: (n,) limits; infinite where there is none.
        speed, acceleration: (n,) limits per second and per second squared.
        period: of a tick [s].

    Attributes:
        place, rate: (n,) where the coordinates are and how fast they move, at the end of the last tick.
    """

    def __init__(self, low: np.ndarray, high: np.ndarray, speed: np.ndarray, acceleration: np.ndarray, period: float) -> None:
        self.low, self.high, self.speed, self.acceleration = (np.array(v, float) for v in (low, high, speed, acceleration))
        self.period = period
        self.place, self.rate = np.zeros(len(self.low)), np.zeros(len(self.low))
        self._push, self._unit = self.acceleration * period, self.acceleration * period**2

    def begin(self, place: np.ndarray) -> None:
        """Stand still at a place (n,), or at the nearest one within the limits."""
        self.place, self.rate = _within(place, self.low, self.high), np.zeros(len(self.low))

    def hold(self) -> None:
        """Stand still where it is."""
        self.rate = np.zeros(len(self.low))

    def advance(self, wanted: np.ndarray) -> None:
        """Move for one tick towards a wanted rate (n,); what is not finite counts as standing still."""
        wanted = np.where(np.isfinite(wanted), wanted, 0.0)
        # Upwards and downwards in one array: a tick is made of many small calls, whose number is what it costs.
        brake = self._brake(np.array([self.high - self.place, self.place - self.low]), np.array([self.rate, -self.rate]))
        up, down = np.minimum(self.speed, brake)
        highest, lowest = np.minimum(self.rate + self._push, up), np.maximum(self.rate - self._push, -down)
        new = _within(np.maximum(np.minimum(wanted, highest), lowest), -self.speed, self.speed)
        self.place = _within(self.place + 0.5 * self.period * (self.rate + new), self.low, self.high)
        self.rate = new

    def _brake(self, room: np.ndarray, rate: np.ndarray) -> np.ndarray:
        """Highest rates after the next tick from which full braking still ends within ``room``, both (..., n).

        With m = rate / (a T), a tick from m0 to m covers (m0 + m) / 2 and braking on from m takes n = ceil(m) ticks and
        (n - 1/2) m - n (n - 1) / 2 more, in units of a T^2; their sum is solved for m.
        """
        left = np.minimum(room / self._unit - 0.5 * rate / self._push, 1e12)  # without a limit there is room for ever
        ticks = np.maximum(1.0, np.ceil(0.5 * np.sqrt(1.0 + 8.0 * np.maximum(left, 0.0)) - 0.5))
        rising = (left + 0.5 * ticks * (ticks - 1.0)) / ticks
        return np.minimum(rising, 2.0 * left) * self._push  # the second is less where braking already comes too late

    def waypoints(self, place: np.ndarray, rate: np.ndarray, count: int) -> np.ndarray:
        """(count, n) places, evenly spaced in time, from (place, rate) at the last tick's start to its end."""
        share = np.arange(1, count + 1)[:, None] / count
        ramp = rate + 0.5 * share * (self.rate - rate)
        return _within(place + share * self.period * ramp, self.low, self.high)


class Expected:
    """The grasp frame's expected motion under robosuite's controller: the response to the last actions."""

    def __init__(self, manifest: Manifest) -> None:
        controller = manifest.controller
        self.scale = np.repeat([controller.translation_m, controller.rotation_rad], 3)
        self._impulse = np.array(controller.response.impulse)
        self._past = np.zeros_like(self._impulse)  # newest action first

    def begin(self) -> None:
        """Forget the past."""
        self._past[:] = 0.0

    def step(self, delta: np.ndarray) -> np.ndarray:
        """(6,) motion [m, rad] during this tick, if ``delta`` (6,) in [-1, 1] is the action now."""
        self._past[:, 1:] = self._past[:, :-1]
        self._past[:, 0] = delta
        return self.scale * (self._impulse * self._past).sum(axis=1)


class Grip:
    """The gripper's integrated closing command, and the opening that it means."""

    def __init__(self, manifest: Manifest) -> None:
        self._gripper = manifest.gripper
        self._command, self._opening = np.array(manifest.gripper.command), np.array(manifest.gripper.opening_m)
        self.command = manifest.gripper.preshape

    def begin(self) -> None:
        """Back to the preshape."""
        self.command = self._gripper.preshape

    def advance(self, action: float) -> None:
        """Integrate the sign of the action's last number, as robosuite does."""
        self.command = min(1.0, max(-1.0, self.command + self._gripper.rate * float(np.sign(action))))

    @property
    def opening_m(self) -> float:
        """Gap [m] between the fingers at the command."""
        return float(np.interp(self.command, self._command, self._opening))

    @property
    def opening(self) -> float:
        """The gap as a share of the widest."""
        return self.opening_m / float(self._opening[0])


def _turned(frame: np.ndarray, pair: np.ndarray) -> np.ndarray:
    """(6,) of a linear and an angular vector (6,), each turned by a rotation (3, 3)."""
    return (pair.reshape(2, 3) @ frame.T).ravel()


class Motion(Protocol):
    """One form of command. ``begin`` at the measured posture, then one ``advance`` or ``hold`` per tick."""

    form: Form
    grip: Grip

    def begin(self, joints: np.ndarray) -> None:
        """Start at measured arm angles (n,)."""

    def advance(self, action: np.ndarray, joints: np.ndarray) -> Command:
        """The command for an action (7,) with the arm at ``joints`` (n,); finite inputs only."""

    def hold(self) -> Command:
        """The command to stand still."""

    def undo(self) -> None:
        """Take the last ``advance`` back, whose command was not sent."""

    def coordinates(self, command: Command) -> np.ndarray:
        """(6,) grasp coordinates in the task frame at the end of a command just given."""

    def tracking(self, joints: np.ndarray) -> float:
        """Largest difference [rad] of measured from commanded arm angles; 0 where none are commanded."""

    def travel(self, command: Command) -> np.ndarray:
        """(6,) motion [m, rad] of the grasp frame that a command makes until the next tick; once for every command sent, in order."""


class _Base:
    """What the three forms share: limits, gripper, kinematics.

    Args:
        manifest: of the bundle.
        kinematics: of its robot, placed by the observer at the measured state before every call.
        rate_hz: the arm's.
    """

    def __init__(self, manifest: Manifest, kinematics: Kinematics, rate_hz: float) -> None:
        self.manifest, self.kinematics = manifest, kinematics
        self.period = 1.0 / manifest.policy_hz
        self.count = max(1, int(round(rate_hz / manifest.policy_hz)))
        self.grip, self.expected = Grip(manifest), Expected(manifest)
        self.low, self.high = (np.array([getattr(entry, key) for entry in manifest.action]) for key in ("low", "high"))
        self.step = np.array([entry.step for entry in manifest.action])
        box = manifest.cartesian
        self.box = Track(np.array(box.low), np.array(box.high), np.array(box.speed), np.array(box.acceleration), self.period)
        self.lead = np.array(box.lead)
        self._steady = np.array(manifest.controller.response.steady)
        gain = np.abs(self._steady) * self.expected.scale * manifest.policy_hz
        self.fastest = np.minimum(1.0, self.box.speed / gain)  # (6,) action from which the arm would exceed its Cartesian speed
        self.last = np.zeros(len(manifest.action))
        self._sent = np.zeros(6)
        controller = manifest.controller
        self._axis = np.array(controller.base_axis) if controller.turns_with_first_joint else np.zeros(3)
        self._start_angle, self._frame = manifest.start.arm_rad[0], np.eye(3)

    def begin(self, joints: np.ndarray) -> None:
        """Start at measured arm angles (n,)."""
        self.grip.begin()
        self.expected.begin()
        self.last = np.zeros(len(self.low))
        self._sent = self.kinematics.coordinates()
        self.box.begin(self._sent)

    def _remember(self) -> None:
        self._before = (self.box.place, self.box.rate, self.grip.command, self.last)

    def undo(self) -> None:
        """See Motion."""
        self.box.place, self.box.rate, self.grip.command, self.last = self._before

    def limited(self, action: np.ndarray) -> np.ndarray:
        """The action (7,) within its limits, its step from the last one, and the Cartesian speed."""
        action = _within(action, np.maximum(self.low, self.last - self.step), np.minimum(self.high, self.last + self.step))
        action[:6] = _within(action[:6], -self.fastest, self.fastest)
        return action

    def taken(self, action: np.ndarray) -> None:
        """Remember an action (7,) that becomes a command."""
        self.last = action
        self.grip.advance(action[6])

    def controller_frame(self, joints: np.ndarray) -> np.ndarray:
        """Rotation (3, 3) of the controller's base frame in the task frame, at arm angles (n,)."""
        if self._axis.any():
            self._frame = rotation_of((joints[0] - self._start_angle) * self._axis)
        return self._frame

    def command(self, form: Form, hold: bool, target: np.ndarray, rate: np.ndarray, waypoints: np.ndarray) -> Command:
        grip = 0.0 if hold else float(np.sign(self.last[6]))
        return Command(form, hold, target, rate, grip, self.grip.opening, self.grip.opening_m, waypoints)

    def coordinates(self, command: Command) -> np.ndarray:
        """See Motion."""
        raise NotImplementedError

    def tracking(self, joints: np.ndarray) -> float:
        """No joint angles are commanded."""
        return 0.0

    def travel(self, command: Command) -> np.ndarray:
        """See Motion: from where the last command led to where this one does, as a stiff arm goes."""
        before, self._sent = self._sent, self.coordinates(command)
        return self._sent - before


class OscMotion(_Base):
    """Deltas for a controller like robosuite's OSC_POSE, which re-bases its goal on the achieved pose."""

    form: Form = "osc"

    def advance(self, action: np.ndarray, joints: np.ndarray) -> Command:
        """See Motion. The goal, measured pose plus delta, stays in the workspace box."""
        self._remember()
        action = self.limited(action)
        frame, place = self.controller_frame(joints), self.kinematics.coordinates()
        turned = _turned(frame, self.expected.scale * action[:6])
        room = _within(place + turned, self.box.low, self.box.high) - place
        # Outside the box only the way back is open: a clip there would be a jump.
        turned = np.where(np.sign(turned) == np.sign(room), np.sign(turned) * np.minimum(np.abs(turned), np.abs(room)), 0.0)
        action[:6] = _turned(frame.T, turned) / self.expected.scale
        action[:6] = _within(action[:6], -self.fastest, self.fastest)
        self.taken(action)
        return self.command("osc", False, action[:6].copy(), np.zeros(0), np.zeros((0, 0)))

    def coordinates(self, command: Command) -> np.ndarray:
        """See Motion: the measured ones, and what the arm is expected to add while it follows."""
        return self.kinematics.coordinates() + _turned(self._frame, command.target * self.expected.scale * self._steady)

    def hold(self) -> Command:
        """See Motion: no delta."""
        self.last = np.zeros(len(self.low))
        return self.command("osc", True, np.zeros(6), np.zeros(0), np.zeros((0, 0)))

    def travel(self, command: Command) -> np.ndarray:
        """See Motion: the measured response to this delta and those before it."""
        return _turned(self._frame, self.expected.step(command.target))


class PoseMotion(_Base):
    """Poses of the grasp frame in the arm's base frame."""

    form: Form = "pose"

    def __init__(self, manifest: Manifest, kinematics: Kinematics, rate_hz: float) -> None:
        super().__init__(manifest, kinematics, rate_hz)
        base = np.array(manifest.robot.base_quaternion)
        self._base, self._origin = matrix_of(base), np.array(manifest.robot.base_position_m)
        self._clearance = manifest.cartesian.table_top_m + manifest.cartesian.table_clearance_m
        self._from_task = sandwich(base * (1, -1, -1, -1), quaternion_of(kinematics.start_rotation))

    def begin(self, joints: np.ndarray) -> None:
        """See Motion."""
        super().begin(joints)
        self._free = self.box.place.copy()  # where the arm would be without limits

    def advance(self, action: np.ndarray, joints: np.ndarray) -> Command:
        """See Motion."""
        self._remember()
        before = self.box.place, self.box.rate
        self.move(action, joints, self.kinematics.coordinates())
        poses = self._poses(self.box.waypoints(*before, self.count))
        return self.command("pose", False, poses[-1], _turned(self._base.T, self.box.rate), poses)

    def move(self, action: np.ndarray, joints: np.ndarray, measured: np.ndarray) -> None:
        """Advance the commanded coordinates, at most the lead ahead of the measured (6,)."""
        action = self.limited(action)
        frame = self.controller_frame(joints)
        motion = self.expected.step(action[:6])
        self.taken(action)
        motion = _turned(frame, motion)
        free = _within(self._free + motion, measured - self.lead, measured + self.lead)
        self._free = _within(free, self.box.low, self.box.high)
        fall = max(0.0, -self.box.rate[2])
        braking = 0.5 * fall * (self.period + fall / self.box.acceleration[2])  # what a fall covers until it has ended
        floor = min(measured[2] + self._clearance + FLOOR - self.kinematics.lowest() + braking, self.box.place[2])
        if self._free[2] < floor:  # no closer to the table than is allowed: an end to the motion, where the guard knows but a fault
            self._free[2], motion[2] = floor, max(0.0, motion[2])
        self.box.advance((motion + CATCH_UP * (self._free - motion - self.box.place)) / self.period)

    def coordinates(self, command: Command) -> np.ndarray:
        """See Motion: the commanded ones."""
        return self.box.place.copy()

    def hold(self) -> Command:
        """See Motion: the last commanded pose."""
        self.still()
        pose = self._poses(self.box.place[None])
        return self.command("pose", True, pose[0], np.zeros(6), np.repeat(pose, self.count, axis=0))

    def still(self) -> None:
        """Stop the commanded coordinates where they are."""
        self.box.hold()
        self.expected.begin()
        self.last = np.zeros(len(self.low))
        self._free = self.box.place.copy()

    def _poses(self, places: np.ndarray) -> np.ndarray:
        """(k, 7) poses in the arm's base frame of grasp coordinates (k, 6) in the task frame.

        q and -q turn alike, but a change between them is a jump on the wire: these follow the coordinates without one.
        """
        return np.concatenate([(places[:, :3] - self._origin) @ self._base, quaternions_of(places[:, 3:]) @ self._from_task.T], axis=1)


class JointMotion(PoseMotion):
    """Joint angles that follow the poses, through mink, clear of table and self.

    Args:
        manifest, kinematics, rate_hz: as for the others.
        solver: of the bundle's robot.
    """

    form: Form = "joint"

    def __init__(self, manifest: Manifest, kinematics: Kinematics, rate_hz: float, solver: JointSolver) -> None:
        super().__init__(manifest, kinematics, rate_hz)
        self.solver = solver
        low = np.array([-np.inf if joint.low is None else joint.low for joint in manifest.joints])
        high = np.array([np.inf if joint.high is None else joint.high for joint in manifest.joints])
        speed, push = (np.array([getattr(joint, key) for joint in manifest.joints]) for key in ("speed", "acceleration"))
        self.joints = Track(low, high, speed, push, self.period)

    def begin(self, joints: np.ndarray) -> None:
        """See Motion."""
        super().begin(joints)
        self.joints.begin(joints)

    def advance(self, action: np.ndarray, joints: np.ndarray) -> Command:
        """See Motion. Commanded angles start from commanded angles, so that measuring noise moves nothing."""
        self._remember()
        self._joints_before = before = self.joints.place, self.joints.rate
        position, rotation = self.solver.pose(self.joints.place)
        reached = np.concatenate([position, vector_of(rotation @ self.kinematics.start_rotation.T)])
        near = _within(self.box.place, reached - self.lead, reached + self.lead)
        self.box.place = _within(near, self.box.low, self.box.high)
        gap = self.box.place - reached
        self.move(action, joints, self.kinematics.coordinates())
        ahead = reached + self.box.rate * self.period + CATCH_UP * gap
        goal = rotation_of(ahead[3:]) @ self.kinematics.start_rotation
        self.joints.advance(self.solver.solve(self.joints.place, ahead[:3], goal))
        return self.command("joint", False, self.joints.place.copy(), self.joints.rate.copy(),
                            self.joints.waypoints(*before, self.count))

    def undo(self) -> None:
        """See Motion."""
        super().undo()
        self.joints.place, self.joints.rate = self._joints_before

    def coordinates(self, command: Command) -> np.ndarray:
        """See Motion: those of the commanded angles."""
        position, rotation = self.solver.pose(command.target)
        return np.concatenate([position, vector_of(rotation @ self.kinematics.start_rotation.T)])

    def hold(self) -> Command:
        """See Motion: the last commanded angles."""
        self.still()
        self.joints.hold()
        place = self.joints.place.copy()
        return self.command("joint", True, place, np.zeros(len(place)), np.repeat(place[None], self.count, axis=0))

    def tracking(self, joints: np.ndarray) -> float:
        """See Motion."""
        return float(np.abs(joints - self.joints.place).max())


def motion_of(form: Form, manifest: Manifest, kinematics: Kinematics, rate_hz: float, mjcf: str, played: np.ndarray) -> Motion:
    """The motion of one form.

    Args:
        form: of the commands.
        manifest, kinematics: of a bundle.
        rate_hz: the arm's.
        mjcf, played: robot.xml, and the golden episode's arm angles (T, n) [rad]: for a JointSolver.
    """
    if form == "joint":
        return JointMotion(manifest, kinematics, rate_hz, JointSolver(manifest, mjcf, played))
    return (OscMotion if form == "osc" else PoseMotion)(manifest, kinematics, rate_hz)

"""What makes the runtime hold an arm, and then stop it. Everything here is on; there is no switch.

A fault is noticed in the tick in which it appears, and the command of that very tick is to hold. A fault that passes
(a late state, a late tick, a state that comes twice) lets the arm go on; any other, and one that stays, stops it after the
manifest's hold_ticks.
"""

from dataclasses import dataclass

import numpy as np

from toolkit.bundle.manifest import Manifest, Vector
from toolkit.deploy.arm import Command, State
from toolkit.deploy.kinematics import vector_of
from toolkit.deploy.liveness import TURNED, ArmLiveness, ObjectLiveness
from toolkit.deploy.motion import Motion
from toolkit.deploy.observer import Observer

COORDINATES = ("x", "y", "z", "rx", "ry", "rz")
PASSING = ("stale_state", "late_ticks", "frozen_state", "object_frozen")
"""Faults after which an arm may go on once they have passed."""
OVERDUE, ASLEEP = 0.15, 1.0
"""[s] by which a single tick, or its command, may come late before the arm is held, and before it is stopped: the world has moved on."""
SPEED_MARGIN = 1.5
"""Measured joint speed, in units of the limit, from which the arm is held: measured speeds overshoot commanded ones."""
SLOW = 0.4
"""[rad/s] of a measured joint speed that never holds the arm, wherever its limit lies: what is 0.6 m from such a joint moves at less than
ISO 10218-1's reduced speed, 250 mm/s. As poses a redundant arm divides a motion among its joints otherwise than when limits were taken."""
LIMIT_MARGIN = 0.02
"""[rad] by which a measured angle may pass its limit."""
FARTHEST = 1000 * 2 * np.pi
"""[rad] of a reading of an endless joint; beyond, whole turns could no longer be told from nonsense."""
UNIT = 0.01
"""By which the length of the object's quaternion may differ from 1."""
WIDER = 0.05
"""By which a reported opening may leave 0 to 1: gripper encoders are no better."""
START_OPENING, START_FINGER, START_JAW = 0.15, 0.2, 0.01
"""Opening, hinge [rad] and slide [m] by which the gripper may differ from the start."""
START_PLACE, START_HEIGHT, START_GOAL = 0.03, 0.03, 0.05
"""[m] beyond the task's noise by which the object may lie away from its place, above or below it, and the goal from its own."""
START_TURN = 0.2
"""[rad] beyond the task's noise by which the object may be turned or tilted."""
START_SPEED = 0.1
"""[rad/s] from which on an arm does not stand still."""
LIFTED = 0.02
"""Rise [m] of the object from where it rests that counts as lifted."""
SURE, GONE = 3, 2
"""Ticks in a row in which the object must be seen lifted, and away from the gripper that lifted it: cameras err by a centimetre."""
CAMERA = {"object_from_grasp": 0.08, "goal_from_object": 0.08, "object_rotation": float(np.sin(TURNED))}
"""[m] that the object may seem to move in a tick, whatever the manifest calls a jump: five standard deviations of what noise of 10 mm,
which the policies bear, does to a difference; and the sine of the angle by which it may turn: one that topples is no camera that lies."""
ALONE = 0.2
"""[s] after which an arm without commands stands still, by its watchdog: what is seen moves no farther, however long one does not look."""
CREEPING = 0.01
"""[m/s] of the grasp frame below which it is as good as at rest: a tick of it is half a millimetre."""
SINKING = 1e-4
"""[m] that a commanded pose may sink in a tick and yet count as staying."""
OVERSHOOT = 0.02
"""[m, rad] by which a measured grasp frame may leave the workspace box."""


@dataclass(frozen=True)
class Fault:
    """Why the arm is held.

    Attributes:
        kind: one word, stable, for machines.
        detail: a sentence with the culprit and its value.
    """

    kind: str
    detail: str

    def __str__(self) -> str:
        return f"{self.kind}: {self.detail}"

    @property
    def passing(self) -> bool:
        """Whether the arm may go on once this is over."""
        return self.kind in PASSING


def _turn(quaternion: np.ndarray) -> float:
    """Angle [rad] of the rotation of a unit quaternion (4,), w first."""
    return 2.0 * float(np.arctan2(np.linalg.norm(quaternion[1:]), abs(quaternion[0])))


class Guard:
    """Checks of the state, the observation, the action and the command.

    Args:
        manifest: of the bundle.
        observer: of the same; its kinematics stand at the state that is checked.
    """

    def __init__(self, manifest: Manifest, observer: Observer) -> None:
        self.manifest, self.observer = manifest, observer
        joints, watch = manifest.joints, manifest.watch
        self._low = np.array([-np.inf if joint.low is None else joint.low for joint in joints])
        self._high = np.array([np.inf if joint.high is None else joint.high for joint in joints])
        self._speed, self._effort = (np.array([getattr(joint, key) for joint in joints]) for key in ("speed", "effort"))
        self._names = [f"{e.name}[{i}]" if e.size > 1 else e.name for e in manifest.observation for i in range(e.size)]
        self._jump = np.concatenate([np.maximum(entry.jump, CAMERA.get(entry.name, 0.0)) for entry in manifest.observation])
        seen_low = np.concatenate([np.array(entry.low) for entry in manifest.observation])
        seen_high = np.concatenate([np.array(entry.high) for entry in manifest.observation])
        margin = 0.5 * (seen_high - seen_low) + self._jump
        self._known_low, self._known_high = seen_low - margin, seen_high + margin
        box = manifest.cartesian
        self._box_low, self._box_high = np.array(box.low), np.array(box.high)
        self._clearance = box.table_top_m + box.table_clearance_m
        self._held, self._hz = watch.held_m, manifest.policy_hz
        self._brakes = manifest.braking.curves if manifest.braking else {}
        names = [entry.name for entry in manifest.observation for _ in range(entry.size)]
        self._object = np.array([i for i, name in enumerate(names) if name == "object_from_grasp"])
        half = [value for value in np.ravel(manifest.task.object.get("half_size_m", [])) if isinstance(value, float)]
        self._narrow = 2.0 * min(half, default=0.0)
        self._rest = manifest.task.table_top_m + (half[-1] if half else 0.0)
        self._arm_alive, self._object_alive = ArmLiveness(), ObjectLiveness()
        self.begin()

    def begin(self) -> None:
        """Forget the last episode."""
        self._last: np.ndarray | None = None
        self._late, self._up, self._away, self._lifted = 0, 0, 0, False
        self._led, self._sank = np.inf, 0.0
        self._place: np.ndarray | None = None
        self._stamp = self._placed = self._seen = 0.0
        self._velocity = np.zeros(3)
        self._arm_alive.begin()
        self._object_alive.begin()

    # -- before the first command

    def start(self, state: State, now: float) -> Fault | None:
        """Whether the arm stands where an episode starts: state fresh and finite, every joint and the grasp frame in place."""
        fault = self.state(state, now)
        if fault:
            return fault
        start, arm = self.manifest.start, self.observer.arm(state)
        away = np.abs(arm - np.array(start.arm_rad))
        if away.max() > start.tolerance_rad:
            worst = int(away.argmax())
            return Fault("start_pose", f"joint {self.manifest.joints[worst].name} stands {away[worst]:.3f} rad from the start posture, "
                                       f"more than {start.tolerance_rad}; move the arm to the manifest's start.arm_rad")
        if state.speeds is not None and np.abs(state.speeds).max() > START_SPEED:
            speed = float(np.abs(state.speeds).max())
            return Fault("start_pose", f"the arm moves at {speed:.3f} rad/s, more than {START_SPEED}; let it come to rest")
        fault = self._start_gripper(state) or self._start_object(state)
        if fault:
            return fault
        # The first tick follows from here: what has jumped until then has jumped.
        self._last, self._seen = self.observer(state, self.manifest.gripper.preshape), self._stamp
        kinematics = self.observer.kinematics
        shift = float(np.linalg.norm(kinematics.position - np.array(start.grasp_position_m)))
        turn = float(np.linalg.norm(vector_of(kinematics.rotation @ kinematics.start_rotation.T)))
        if shift > start.tolerance_m or turn > start.tolerance_rotation_rad:
            return Fault("start_pose", f"the grasp frame stands {shift:.3f} m and {turn:.3f} rad from its start")
        return None

    def _start_gripper(self, state: State) -> Fault | None:
        """Whether the gripper stands at its preshape, by fingers or by opening: what is measured in other units does not."""
        gripper, start = self.manifest.gripper, self.manifest.start
        if state.fingers is not None:
            found = self.observer.fingers(state)
            for name, unit, angle in zip(gripper.joints, gripper.joint_units, found, strict=True):
                limit = START_FINGER if unit == "rad" else START_JAW
                if not abs(angle - start.fingers[name]) <= limit:
                    return Fault("start_pose", f"finger joint {name} stands at {angle:.3f} {unit}, not within {limit} of "
                                               f"{start.fingers[name]:.3f}; open the gripper to the manifest's start.fingers")
        elif state.opening is not None:
            wanted = float(np.interp(gripper.preshape, gripper.command, gripper.opening_m)) / gripper.opening_m[0]
            if not abs(state.opening - wanted) <= START_OPENING:
                return Fault("start_pose", f"the gripper's opening is {state.opening:.3f}, not within {START_OPENING} of {wanted:.3f} "
                                           "(0 closed, 1 open; not metres, nor the other way round); open it to the preshape")
        return None

    def _start_object(self, state: State) -> Fault | None:
        """Whether object and goal are where an episode starts: in another frame, unit or order of numbers they are not."""
        task = self.manifest.task
        place, goal = np.asarray(state.object_position, float), np.asarray(state.goal, float)
        away = np.abs(place[:2] - np.array(task.object_xy_m))
        if away.max() > task.noise_xy_m + START_PLACE:
            return Fault("start_pose", f"the object lies at ({place[0]:.3f}, {place[1]:.3f}) m, {away.max():.3f} from its place "
                                       f"{task.object_xy_m} in the task frame, more than {task.noise_xy_m + START_PLACE:.3f}")
        if abs(place[2] - self._rest) > START_HEIGHT:
            return Fault("start_pose", f"the object's centre is at a height of {place[2]:.3f} m, not within {START_HEIGHT} of "
                                       f"{self._rest:.3f}")
        limit = task.noise_yaw_rad + START_TURN
        turned = _turn(np.asarray(state.object_quaternion, float))
        if turned > limit:
            last = _turn(np.roll(state.object_quaternion, 1)) <= limit
            why = "its numbers seem to be x, y, z, w; give w first" if last else "stand it upright, or take the turn that looks the same"
            return Fault("start_pose", f"the object is turned by {turned:.3f} rad from upright at zero yaw, more than {limit:.3f}; {why}")
        off = float(np.abs(goal - place - np.array(task.goal_offset_m)).max())
        if off > START_GOAL:
            return Fault("start_pose", f"the goal lies {off:.3f} m from the object's place plus goal_offset_m {task.goal_offset_m}, more "
                                       f"than {START_GOAL}")
        return None

    # -- every tick

    def state(self, state: State, now: float) -> Fault | None:
        """Whether a state may be trusted: fresh, finite, within the arm's own limits."""
        age = now - state.stamp
        if not np.isfinite(age) or age > self.manifest.watch.stale_s or age < -self.manifest.watch.stale_s:
            return Fault("stale_state", f"the state is {1e3 * age:.0f} ms old, more than {1e3 * self.manifest.watch.stale_s:.0f} ms")
        self._stamp = state.stamp
        if state.fault:
            return Fault("arm", f"the arm reports: {state.fault}")
        n = len(self.manifest.joints)
        arm = np.asarray(state.joints, float)
        if arm.shape != (n,):
            return Fault("state_shape", f"the state has joints of shape {arm.shape}, not ({n},)")
        for name, value, size in (("object_position", state.object_position, 3), ("object_quaternion", state.object_quaternion, 4),
                                  ("goal", state.goal, 3)):
            if np.shape(value) != (size,) or not np.isfinite(value).all():
                return Fault("not_finite", f"the state's {name} is {np.asarray(value).tolist()}")
        fault = self._plausible(state)
        if fault:
            return fault
        arm = self._arm = self.observer.arm(state)
        if not np.isfinite(arm).all():
            return Fault("not_finite", f"joint {self.manifest.joints[int((~np.isfinite(arm)).argmax())].name} is not finite")
        lost = np.abs(self.observer.in_order(state.joints)) > FARTHEST
        if lost.any():
            worst = int(lost.argmax())
            return Fault("joint_limit", f"joint {self.manifest.joints[worst].name} reports "
                                        f"{self.observer.in_order(state.joints)[worst]:.3g} rad, which no encoder counts")
        out = (arm < self._low - LIMIT_MARGIN) | (arm > self._high + LIMIT_MARGIN)
        if out.any():
            return Fault("joint_limit", f"joint {self.manifest.joints[int(out.argmax())].name} stands at {arm[out.argmax()]:.3f} rad")
        for kind, values, limit in (("joint_speed", state.speeds, np.maximum(SPEED_MARGIN * self._speed, SLOW)),
                                    ("effort", state.efforts, (1 + 1e-6) * self._effort)):
            if values is None:
                continue
            if np.shape(values) != (n,):
                return Fault("state_shape", f"the state has {kind} of shape {np.shape(values)}, not ({n},)")
            values = self.observer.in_order(values)
            bad = ~(np.abs(values) <= limit)
            if bad.any():
                worst = int(bad.argmax())
                return Fault(kind, f"joint {self.manifest.joints[worst].name}: {values[worst]:.3g}, limit {limit[worst]:.3g}")
        self._up = self._up + 1 if state.object_position[2] > self._rest + LIFTED else 0
        self._lifted = self._lifted or self._up >= SURE
        if state.outcome == "lost" or state.object_position[2] < self.manifest.task.lost_below_m:
            return Fault("object_lost", f"the object lies at a height of {state.object_position[2]:.3f} m")
        return None

    def _plausible(self, state: State) -> Fault | None:
        """Whether what a state says of object and gripper can be, in the units that it is to be in."""
        length = float(np.linalg.norm(state.object_quaternion))
        if abs(length - 1.0) > UNIT:
            return Fault("implausible", f"the object's quaternion has length {length:.3g}, not 1")
        if state.fingers is not None:
            wanted = (len(self.manifest.gripper.joints),)
            if np.shape(state.fingers) != wanted:
                return Fault("state_shape", f"the state has fingers of shape {np.shape(state.fingers)}, not {wanted}")
            if not np.isfinite(state.fingers).all():
                return Fault("not_finite", f"the state's fingers are {np.asarray(state.fingers).tolist()}")
        elif state.opening is None or not np.isfinite(state.opening):
            return Fault("not_finite", f"the gripper's opening is {state.opening}, and its fingers are not reported")
        elif not -WIDER <= state.opening <= 1.0 + WIDER:
            return Fault("implausible", f"the gripper's opening is {state.opening:.3g}; it goes from 0 closed to 1 open, and is neither a "
                                        "percentage nor a width in millimetres")
        return None

    def observation(self, observation: np.ndarray) -> Fault | None:
        """Whether an observation (n_obs,) is finite, follows from the last one, and keeps a lifted object in the gripper.

        The observer's kinematics stand at it.
        """
        if not np.isfinite(observation).all():
            return Fault("not_finite", f"observation {self._names[int((~np.isfinite(observation)).argmax())]} is not finite")
        if self._last is not None:
            step = np.abs(observation - self._last)
            # A state that was waited for may be farther, whether the ticks between had states that were refused or none at all.
            bad = step > self._jump * max(1.0, self._hz * min(ALONE, self._stamp - self._seen))
            if bad.any():
                worst = int(np.argmax(step / self._jump))
                return Fault("observation_jump", f"observation {self._names[worst]} moved by {step[worst]:.3g} in a tick")
        self._last, self._seen = observation, self._stamp
        place = self.observer.kinematics.coordinates()
        spent = max(1.0 / self._hz, self._stamp - self._placed)  # a late tick is longer, and no faster
        self._velocity = np.zeros(3) if self._place is None else (place - self._place)[:3] / spent
        self._place, self._placed = place, self._stamp
        out = (place < self._box_low - OVERSHOOT) | (place > self._box_high + OVERSHOOT)
        if out.any():
            worst = int(out.argmax())
            return Fault("workspace", f"grasp coordinate {COORDINATES[worst]} is {place[worst]:.3f}, outside the workspace box")
        apart = float(np.linalg.norm(observation[self._object])) if self._lifted else 0.0
        self._away = self._away + 1 if apart > self._held else 0
        if self._away >= GONE or apart > self._held + CAMERA["object_from_grasp"]:
            return Fault("object_lost", f"the lifted object is {apart:.3f} m from the grasp frame, more than {self._held:.3f}")
        return None

    def unknown(self, observation: np.ndarray) -> str:
        """The entry that lies farthest outside what training saw, or nothing; a warning, not a fault."""
        beyond = np.maximum(self._known_low - observation, observation - self._known_high)
        return self._names[int(beyond.argmax())] if beyond.max() > 0 else ""

    def action(self, action: np.ndarray) -> Fault | None:
        """Whether the policy's action is finite."""
        bad = ~np.isfinite(action)
        return Fault("not_finite", f"action {self.manifest.action[int(bad.argmax())].name} is not finite") if bad.any() else None

    def command(self, command: Command, motion: Motion) -> Fault | None:
        """Whether a command, already limited, keeps the gripper off the table and the commanded arm near the real one."""
        kinematics = self.observer.kinematics
        place = motion.coordinates(command)
        out = (place < self._box_low - OVERSHOOT) | (place > self._box_high + OVERSHOOT)
        if out.any():
            worst = int(out.argmax())
            return Fault("workspace", f"the command leads to {COORDINATES[worst]} = {place[worst]:.3f}, outside the workspace box")
        fall = float(place[2] - kinematics.position[2])
        lowest = kinematics.lowest() + fall
        # A pose that leads no lower than the last one is not what brings closing fingers closer to the table; and one whose fall is
        # ending does what a hold would do, but for the jerk, as long as half of the clearance is left.
        sinks, self._led = self._led - float(place[2]), float(place[2])
        ends, self._sank = sinks < self._sank - SINKING and lowest > 0.5 * (self.manifest.cartesian.table_top_m + self._clearance), sinks
        lower = motion.form == "osc" or (sinks > SINKING and not ends)
        if fall < 0.0 and lower and lowest < self._clearance:
            return Fault("table_clearance", f"the gripper would come to {lowest - self.manifest.cartesian.table_top_m:.4f} m above "
                                            f"the table, less than {self.manifest.cartesian.table_clearance_m:.4f} m")
        if motion.tracking(self._arm) > self.manifest.watch.tracking_rad:
            return Fault("tracking", f"the arm stands {motion.tracking(self._arm):.3f} rad from where it was commanded")
        braking = self.manifest.braking
        if braking is None or motion.form not in self._brakes:
            return None
        return self._at_rest(place, self._brakes[motion.form], braking.table_clearance_m)

    def _at_rest(self, place: np.ndarray, curve: tuple[Vector, Vector], clearance: float) -> Fault | None:
        """Whether the arm would come to rest off the table and in its box, were it held after a command to grasp coordinates (6,).

        Held, it first goes where the command leads, and then brakes, as from the speed that is measured.

        Args:
            place: [m, rad] in the task frame.
            curve: speeds [m/s] and the distance [m] gone from each.
            clearance: smallest height [m] above the table.
        """
        kinematics, speed = self.observer.kinematics, float(np.linalg.norm(self._velocity))
        if speed < CREEPING:
            return None
        here = kinematics.position
        rest = place[:3] + float(np.interp(speed, *curve)) * self._velocity / speed
        out = (rest < self._box_low[:3] - OVERSHOOT) | (rest > self._box_high[:3] + OVERSHOOT)
        if out.any():
            worst = int(out.argmax())
            return Fault("workspace", f"held now, at {speed:.2f} m/s, the arm would come to rest at {COORDINATES[worst]} = "
                                      f"{rest[worst]:.3f}, outside the workspace box")
        height = kinematics.lowest() + min(0.0, float(rest[2] - here[2])) - self.manifest.cartesian.table_top_m
        if self._velocity[2] < 0.0 and height < clearance:
            return Fault("table_clearance", f"held now, at {speed:.2f} m/s, the gripper would come to rest {height:.4f} m above the table, "
                                            f"less than {clearance:.4f} m")
        return None

    def alive(self, state: State, opening_m: float) -> Fault | None:
        """Whether arm and object do what they must after the commands sent; see toolkit/deploy/liveness.py.

        The observer's kinematics stand at the state, which has passed the other checks.

        Args:
            state: measured.
            opening_m: between the fingers [m], as commanded.
        """
        kinematics = self.observer.kinematics
        arm = self._arm_alive.check(self._arm, kinematics.coordinates())
        pose = np.concatenate([state.object_position, state.object_quaternion])
        item = self._object_alive.check(pose, kinematics.position, opening_m < self._narrow)
        found = next((wrong for wrong in (arm, item) if wrong[0]), None)
        return Fault(*found) if found else None

    def blind(self) -> None:
        """A tick without a state that may be trusted."""
        self._place = None
        self._arm_alive.blink()

    def sent(self, command: Command, motion: Motion) -> None:
        """Remember what a command does, for ``alive``."""
        self._arm_alive.sent(motion.travel(command))

    def timing(self, late: bool, overdue: float = 0.0) -> Fault | None:
        """Count ticks that end after their period, and look at how late [s] this one comes."""
        self._late = self._late + 1 if late else 0
        if overdue > OVERDUE:
            return self.overdue(overdue)
        limit = self.manifest.watch.late_ticks
        return Fault("late_ticks", f"{self._late} ticks in a row ended after their period") if self._late >= limit else None

    def overdue(self, seconds: float) -> Fault:
        """What a tick, or its command, that comes so late [s] is."""
        if seconds > ASLEEP:
            return Fault("asleep", f"the policy's side did nothing for {seconds:.1f} s, over {ASLEEP:.0f} s; begin anew from the start")
        return Fault("late_ticks", f"a tick came {seconds:.2f} s late, more than {OVERDUE} s")

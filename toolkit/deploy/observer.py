"""From an arm's state to the policy's observation, entry by entry, by name."""

from dataclasses import replace

import numpy as np

from toolkit.bundle.manifest import Manifest
from toolkit.deploy.arm import ArmInfo, Command, State
from toolkit.deploy.kinematics import Kinematics, matrix_of
from toolkit.errors import ToolkitError

TURN = 2 * np.pi


class Observer:
    """Assembles the observation that the policy was trained on.

    It is also where angles that repeat themselves are made one: a joint without limits is read as the angle nearest to where it
    was last seen, at first to its start, whatever whole turns the arm counts, and when a reading wraps. Everything behind it sees
    angles without jumps; ``reported`` gives commands back in the turns of the episode's first reading, without jumps too.

    Args:
        manifest: of the bundle.
        kinematics: of its robot.
        info: the order in which the arm reports its joints; None: the manifest's own.

    Attributes:
        size: n_obs.  goal: where an observation says how far the goal is from the object, if it does.

    Raises:
        ToolkitError: an entry of the observation that this release cannot assemble.
    """

    def __init__(self, manifest: Manifest, kinematics: Kinematics, info: ArmInfo | None = None) -> None:
        self.manifest, self.kinematics = manifest, kinematics
        names = [joint.name for joint in manifest.joints]
        self._order = np.array([info.joints.index(name) for name in names] if info else range(len(names)), int)
        fingers = manifest.gripper.joints
        has_fingers = info is None or bool(info.fingers)
        self._fingers = np.array([info.fingers.index(name) for name in fingers] if info and has_fingers else range(len(fingers)), int)
        self._entries: list[tuple[slice, str]] = []
        position, finger_at, finger_joint, finger_sign, finger_start = 0, [], [], [], []
        known = {"closing_progress": 1, "grasp_position": 3, "grasp_rotation": 3, "object_from_grasp": 3, "object_rotation": 3,
                 "goal_from_object": 3}
        for entry in manifest.observation:
            kind = "finger" if entry.name.startswith("finger/") else entry.name
            if entry.size != {"finger": 1, **known}.get(kind):
                raise ToolkitError(f"the bundle observes {entry.name!r} of size {entry.size}, which this release cannot assemble")
            if kind != "finger":
                self._entries.append((slice(position, position + entry.size), kind))
            elif entry.name in manifest.fingers:
                finger = manifest.fingers[entry.name]
                finger_at.append(position)
                finger_joint.append(fingers.index(finger.joint))
                finger_sign.append(finger.sign)
                finger_start.append(finger.start_rad)
            position += entry.size
        self.size = position
        self.goal = next((place for place, kind in self._entries if kind == "goal_from_object"), None)
        self._finger_at, self._finger_joint = np.array(finger_at, int), np.array(finger_joint, int)
        self._finger_sign, self._finger_start = np.array(finger_sign), np.array(finger_start)
        self._endless = np.array([joint.low is None for joint in manifest.joints])
        self._first = np.array(manifest.start.arm_rad)
        self.begin()
        self._start = np.array(manifest.start.grasp_position_m)
        gripper = manifest.gripper
        self._table = np.array(gripper.opening_m) / gripper.opening_m[0]
        self._angles = np.array(gripper.joint_positions)

    def begin(self) -> None:
        """Forget where endless joints were seen: an episode starts at the manifest's start."""
        self._near = self._first.copy()
        self._turns: np.ndarray | None = None  # by which the first reading differs

    def arm(self, state: State) -> np.ndarray:
        """Arm angles (n,) [rad] in the manifest's order, those of endless joints nearest to where they were last observed."""
        return self.in_order(state.joints) - TURN * self._turns_of(state)

    def _turns_of(self, state: State) -> np.ndarray:
        """(n,) whole turns by which a reading differs from the angles; none for joints with limits, or where nothing is read."""
        gap = np.where(self._endless, self.in_order(state.joints) - self._near, 0.0)
        return np.round(np.where(np.isfinite(gap), gap, 0.0) / TURN)

    def reported(self, command: Command) -> Command:
        """A joint command in the turns that the arm counted when the episode began, and in its own order of joints; another form as
        it is."""
        if command.form != "joint":
            return command
        place, turns = np.argsort(self._order), 0.0 if self._turns is None else TURN * self._turns
        own = lambda rows: (rows + turns)[..., place]  # noqa: E731
        return replace(command, target=own(command.target), waypoints=own(command.waypoints), rate=command.rate[place])

    def in_order(self, values: np.ndarray) -> np.ndarray:
        """Any per-joint values (n,) of a state, in the manifest's order."""
        return np.asarray(values, float)[self._order]

    def fingers(self, state: State) -> np.ndarray:
        """Finger angles (m,) [rad] in the manifest's order; from the opening where the gripper reports no more."""
        if state.fingers is not None:
            return np.asarray(state.fingers, float)[self._fingers]
        if state.opening is None:
            return np.full(len(self._fingers), np.nan)
        # Fully open first in the table; np.interp wants rising openings.
        return np.array([np.interp(state.opening, self._table[::-1], column[::-1]) for column in self._angles.T])

    def progress(self, command: float) -> float:
        """How far the closing command, -1 to +1, has come since the preshape: -1 there, +1 fully closed."""
        preshape = self.manifest.gripper.preshape
        return 2.0 * (command - preshape) / (1.0 - preshape) - 1.0

    def __call__(self, state: State, command: float) -> np.ndarray:
        """The observation (n_obs,), in the manifest's order; NaN wherever the state is not finite.

        Args:
            state: of the arm; leaves ``kinematics`` placed there, and its endless joints remembered.
            command: the closing command integrated so far.
        """
        arm, fingers = self.arm(state), self.fingers(state)
        if np.isfinite(arm).all():
            self._turns, self._near = self._turns_of(state) if self._turns is None else self._turns, arm
        self.kinematics.place(arm, fingers)
        grasp, rotation = self.kinematics.position, self.kinematics.rotation
        item, goal = np.asarray(state.object_position, float), np.asarray(state.goal, float)
        out = np.zeros(self.size)
        out[self._finger_at] = self._finger_sign * (fingers[self._finger_joint] - self._finger_start)
        values = {
            "closing_progress": self.progress(command),
            "grasp_position": grasp - self._start,
            "grasp_rotation": _sine(rotation @ self.kinematics.start_rotation.T),
            "object_from_grasp": item - grasp,
            "object_rotation": _sine(matrix_of(state.object_quaternion)),
            "goal_from_object": goal - item,
        }
        for where, name in self._entries:
            out[where] = values[name]
        return out


def _sine(rotation: np.ndarray) -> np.ndarray:
    """Axis times sine of the angle of a rotation matrix."""
    return 0.5 * np.array([rotation[2, 1] - rotation[1, 2], rotation[0, 2] - rotation[2, 0], rotation[1, 0] - rotation[0, 1]])

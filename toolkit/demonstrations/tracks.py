"""A recorded motion as a demonstration: a track, and the script that follows it as a function of the observation."""

from dataclasses import dataclass

import numpy as np

from tasks.pick import ACTION_SIZE
from toolkit.demonstrations.scripts import entry


@dataclass(frozen=True, eq=False)
class Track:
    """A retargeted recording as the policy would see it: T points of a pick, in the task's axes.

    Attributes:
        name: of the recording.
        object_from_grasp: (T, 3) [m] object centre from the grasp frame.
        rotation: (T, 3) rotation vector [rad] of the grasp frame from its start pose.
        commands: (T, n_roles) finger targets in [-1, 1].
        goal_from_object: (T, 3) [m].
        lift: index of the point from which the object is moved.
        round: whether the object looks the same from every side, so that its yaw says nothing.
    """

    name: str
    object_from_grasp: np.ndarray
    rotation: np.ndarray
    commands: np.ndarray
    goal_from_object: np.ndarray
    lift: int
    round: bool = False


class TrackScript:
    """Follows a track as a function of the observation alone: to the point ahead of the one that is nearest.

    Before the lift the track turns and moves with the object; after it, it is stretched so that it ends at the task's goal.

    Args:
        track: what to follow.
        goal_offset: (3,) [m] the task's goal from the object's start.
        closing: indices of the closing roles among the commands, whose mean the observation reports as progress.
    """

    GAIN = 30.0
    """OSC action per metre of error, as in PickScript."""
    TURN_GAIN = 4.0
    """OSC action per radian of error; robosuite's OSC turns by 0.5 rad per unit, and by a quarter of that in one step."""
    AHEAD = 4
    """Points between the nearest one and the one that is steered to."""
    NEAR, PROGRESS = 0.02, 0.2
    """Distance [m] and progress that count alike when the nearest point is sought."""
    ALIGNED = 0.012
    """Distance [m] from the grasp within which closing begins."""
    HOVER = 0.04
    """Height [m] kept above the track until the grasp is aligned sideways."""
    HELD = 0.04
    """Distance [m] of the object from the grasp beyond which closing fingers have missed it: a moving hand overshoots, so that
    what was aligned when closing began need not be where the fingers meet."""

    def __init__(self, track: Track, goal_offset: np.ndarray, closing: np.ndarray) -> None:
        self.track = track
        progress = track.commands[:, closing].mean(axis=1)
        before, after = slice(0, track.lift + 1), slice(track.lift, None)
        self._offset, self._turn, self._fingers = track.object_from_grasp[before], track.rotation[before], track.commands[before]
        # Closing only ever advances on the way to the grasp, so that nearest points are unique.
        self._progress = np.minimum.accumulate(progress[before][::-1])[::-1]
        tight = track.commands[track.lift]
        self._carried, self._carry_turn = track.goal_from_object[after], track.rotation[after]
        self._carry_fingers = np.maximum(track.commands[after], tight)
        self._stretch = _stretch(self._carried[0], np.asarray(goal_offset))
        start = self._progress[0]
        self._lift_from = self._progress[-1] - 0.15 * (self._progress[-1] - start)
        self._started = start + 0.3 * (self._progress[-1] - start)
        closing_points = np.flatnonzero(self._progress > start + 0.1 * (self._progress[-1] - start))
        self._preshape = int(closing_points[0]) - 1 if len(closing_points) else 0

    def __call__(self, observation: np.ndarray, rng: np.random.Generator | None = None) -> np.ndarray:
        """Action (n_act,) for an observation (n_obs,); deterministic."""
        progress = float(entry(observation, "closing_progress")[0])
        offset, turned, yaw = self._object(observation)
        missed = bool(progress > self._started and np.linalg.norm(offset - self._offset[-1]) > self.HELD)
        if progress >= self._lift_from and not missed:
            move, turn, fingers = self._carry(observation)
        else:
            move, turn, fingers = self._reach(offset, progress, missed)
            move, turn = turned @ move, turn + np.array([0.0, 0.0, yaw])
        action = np.empty(ACTION_SIZE)
        action[:3] = np.clip(self.GAIN * move, -1.0, 1.0)
        sine = entry(observation, "grasp_rotation")
        size = np.linalg.norm(sine)
        now = sine * (np.arcsin(np.minimum(size, 1.0)) / size) if size > 1e-9 else sine
        action[3:6] = np.clip(self.TURN_GAIN * (turn - now), -1.0, 1.0)
        action[6:] = fingers
        return action

    def _object(self, observation: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
        """The object from the grasp frame (3,) [m] in the axes of an object that stands as recorded, those axes (3, 3), its yaw [rad]."""
        yaw = 0.0 if self.track.round else float(np.arcsin(np.clip(entry(observation, "object_rotation")[2], -1.0, 1.0)))
        c, s = np.cos(yaw), np.sin(yaw)
        turned = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        return turned.T @ entry(observation, "object_from_grasp"), turned, yaw

    def _reach(self, offset: np.ndarray, progress: float, missed: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Way to go (3,) [m], turn (3,) [rad] and finger targets, in the axes of ``_object``."""
        if missed:
            progress = self._progress[0]  # back over the object with open fingers
        far = ((self._offset - offset) ** 2).sum(axis=1) / self.NEAR**2 + ((self._progress - progress) / self.PROGRESS) ** 2
        nearest = int(np.argmin(far))
        ahead = min(nearest + self.AHEAD, len(self._offset) - 1)
        move = offset - self._offset[ahead]
        aside = float(np.hypot(*(offset - self._offset[nearest])[:2]))
        move[2] += self.HOVER * (1.0 if missed else np.clip((aside - 0.01) / 0.03, 0.0, 1.0))
        left = np.abs(offset - self._offset[-1])
        aligned = np.hypot(left[0], left[1]) < self.ALIGNED and left[2] < 1.25 * self.ALIGNED
        if aligned or progress > self._started:
            closing = max(nearest, self._preshape) + self.AHEAD
        else:
            closing = min(ahead, self._preshape)
        return move, self._turn[ahead], self._fingers[min(closing, len(self._fingers) - 1)]

    def _carry(self, observation: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        goal = entry(observation, "goal_from_object")
        path = self._carried @ self._stretch.T
        nearest = int(np.argmin(((path - goal) ** 2).sum(axis=1)))
        ahead = min(nearest + self.AHEAD, len(path) - 1)
        return goal - path[ahead], self._carry_turn[ahead], self._carry_fingers[ahead]


def _stretch(recorded: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """(3, 3) that takes the recorded way from start to goal (3,) to the wanted one: heights scaled, sides turned and scaled."""
    out = np.eye(3)
    out[2, 2] = wanted[2] / recorded[2] if abs(recorded[2]) > 0.02 else 1.0
    a, b = complex(*recorded[:2]), complex(*wanted[:2])
    if abs(a) > 0.02:
        ratio = b / a
        out[:2, :2] = [[ratio.real, -ratio.imag], [ratio.imag, ratio.real]]
    return out

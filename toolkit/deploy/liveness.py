"""Whether what an arm and a camera report is alive: a fresh stamp on an old truth is the most dangerous of lies.

A sensor thread that has died, or a driver that stamps when it is asked, repeats its last state for ever. Nothing in such a state is
wrong; only that it does not follow the commands. The motion that the commands sent should have made is therefore compared with the
motion measured, in every form of command.
"""

from collections import deque

import numpy as np

LEVER = 0.2
"""[m] at which a rotation counts as a motion."""
REPEATED, REPEATED_SLOWLY, REPEATS = 0.003, 0.001, 3
"""[m] of expected motion without a bit of change in any joint from which the arm is held; the second after so many ticks: an encoder
resolves less, and a state that comes twice by a hiccup of the line is not yet a dead one."""
WINDOW, DELAY = 2, 2
"""Ticks over which motions are compared, and ticks by which the measured one may lag behind the commands."""
MOVING, FOLLOWED = 0.01, 0.25
"""[m] of expected motion over the window from which it is compared, and the share of it that must be seen; the three shipped bundles'
arms showed 0.70 or more, in every form of command, brushing the table or not."""
NOISE = 1e-5
"""[m] of change from one tick to the next that is a camera's noise; what a simulated object at rest does is a thousandth of it."""
LEARNING, SIGNS, LONGER = 5, 4, 2
"""Ticks in which a camera shows how often it repeats itself, changes among them from which on it is known to be noisy, and ticks beyond
its longest repetition from which on it is frozen."""
TOUCHING, LEFT = 0.05, 0.005
"""[m] of the object's centre from the grasp frame as the gripper closes, and [m] of the grasp frame's motion, closed, at which an object
that was grasped, or only touched, has moved: in 36 episodes of the shipped bundles it never lay still to the bit for as much as a tick."""
TURNED = 1.0
"""[rad] by which an object may turn in a tick; half a turn of a box looks alike to a policy, but not to who grasps with w last."""


def _length(motion: np.ndarray) -> float:
    """[m] of a motion (6,) [m, rad]."""
    return float(np.sqrt(motion[:3] @ motion[:3] + LEVER**2 * (motion[3:] @ motion[3:])))


class ArmLiveness:
    """Whether the measured arm follows its commands. ``begin``, then per tick ``check`` with what is measured and ``sent``."""

    def __init__(self) -> None:
        self.begin()

    def begin(self) -> None:
        """Forget the last episode."""
        self._joints: np.ndarray | None = None
        self._unseen, self._repeats = np.zeros(6), 0
        self._places: deque[np.ndarray] = deque(maxlen=WINDOW + 1)
        self._expected: deque[np.ndarray] = deque(maxlen=WINDOW + DELAY)

    def check(self, joints: np.ndarray, place: np.ndarray) -> tuple[str, str]:
        """What is wrong with a measured posture, as a fault's kind and detail; two empty words if nothing.

        Args:
            joints: (n,) [rad].
            place: (6,) coordinates of the grasp frame there [m, rad].
        """
        if self._joints is not None and np.array_equal(joints, self._joints):
            self._repeats += 1
            unseen = _length(self._unseen)
            if unseen > (REPEATED_SLOWLY if self._repeats >= REPEATS else REPEATED):
                return "frozen_state", (f"no joint has moved by a bit in {self._repeats} ticks, in which the commands sent should have "
                                        f"moved the arm by {1e3 * unseen:.1f} mm; is the sensor alive, is the arm?")
            return "", ""
        self._joints, self._unseen, self._repeats = joints.copy(), np.zeros(6), 0
        self._places.append(place.copy())
        if len(self._places) <= WINDOW or len(self._expected) < WINDOW + DELAY:
            return "", ""
        moved = self._places[-1] - self._places[0]
        commanded, weight = list(self._expected), np.repeat([1.0, LEVER**2], 3)
        for lag in range(DELAY + 1):
            wanted = sum(commanded[DELAY - lag : DELAY - lag + WINDOW], np.zeros(6))
            length = _length(wanted)
            if length < MOVING or float((weight * wanted) @ moved) > FOLLOWED * length**2:
                return "", ""
        return "implausible_motion", (f"in {WINDOW} ticks the commands sent should have moved the arm by {1e3 * length:.1f} mm, and less "
                                      f"than {FOLLOWED:.0%} of it was seen; is it blocked, or are its angles another arm's?")

    def blink(self) -> None:
        """A tick came without a state that could be believed: what the arm did meanwhile is not known."""
        self._places.clear()
        self._expected.clear()

    def sent(self, travel: np.ndarray) -> None:
        """Remember the motion (6,) [m, rad] that a command just sent should make until the next tick."""
        self._unseen = self._unseen + travel
        self._expected.append(travel)


class ObjectLiveness:
    """Whether the object's pose is still looked at. ``begin``, then ``check`` once per tick."""

    def __init__(self) -> None:
        self.begin()

    def begin(self) -> None:
        """Forget the last episode."""
        self._pose: np.ndarray | None = None
        self._ticks = self._repeats = self._longest = 0
        self._noisy, self._changes = True, 0
        self._closed: np.ndarray | None = None

    def check(self, pose: np.ndarray, grasp: np.ndarray, closed: bool) -> tuple[str, str]:
        """What is wrong with the object's pose, as a fault's kind and detail; two empty words if it is alive.

        Two signs of life are known. A camera's noise: who has changed its mind in every tick, and does no more, is frozen. And a grasp:
        an object between fingers that close and move away does not stay where it is to the last bit.

        Args:
            pose: (7,) position [m] and quaternion of the object.
            grasp: (3,) origin of the grasp frame [m].
            closed: whether the gripper is told to be narrower than the object.
        """
        before, self._pose = self._pose, pose.copy()
        self._ticks += 1
        if before is None:
            return "", ""
        half = abs(float(pose[3:] @ before[3:])) / float(np.linalg.norm(pose[3:]) * np.linalg.norm(before[3:]))
        turned = 2.0 * float(np.arccos(min(1.0, half)))
        if turned > TURNED:
            return "implausible", f"the object has turned by {turned:.2f} rad in a tick; is its quaternion still w first?"
        repeated = np.array_equal(pose, before)
        self._repeats = self._repeats + 1 if repeated else 0
        if self._ticks <= LEARNING:
            self._longest = max(self._longest, self._repeats)
            self._changes += not repeated
            self._noisy = self._noisy and (repeated or float(np.abs(pose[:3] - before[:3]).max()) > NOISE)
        elif self._noisy and self._changes >= SIGNS and self._repeats >= self._longest + LONGER:
            return "object_frozen", (f"the object's pose has not changed by a bit in {self._repeats} ticks, though its noise changed it at "
                                     f"least every {self._longest + 1} before; is the camera alive?")
        if not (repeated and closed):
            self._closed = None
        elif self._closed is None:
            self._closed = grasp.copy() if float(np.linalg.norm(pose[:3] - grasp)) < TOUCHING else None
        elif (left := float(np.linalg.norm(grasp - self._closed))) > LEFT:
            return "object_frozen", (f"the gripper has closed on the object and moved on by {1e3 * left:.0f} mm, and the object's pose has "
                                     "not changed by a bit; is the camera alive?")
        return "", ""

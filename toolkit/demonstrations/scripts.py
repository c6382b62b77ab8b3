"""Scripted demonstrations of the pick on the source robot: a closed-loop motion that any behaviour cloning can follow."""

from dataclasses import dataclass

import numpy as np

from tasks.objects import PickObject
from tasks.pick import ACTION_SIZE, OBSERVATION

FINGER_DEPTH = 0.0255
"""How far [m] below its top an object is grasped at most: deeper, ADROIT's palm touches a tall object before the fingers close."""

def entry(observation: np.ndarray, name: str) -> np.ndarray:
    """An entry of the observation record, by name."""
    return observation[..., OBSERVATION.slice(name)]


@dataclass(frozen=True)
class PickScript:
    """Approach from above, close, lift and carry, as a function of the observation alone.

    Attributes:
        object_from_grasp: where the object's centre should be in the grasp [m], world axes at the start rotation.
        hover: height [m] above the grasp from which to descend.
        gain: OSC action per metre of error; robosuite's OSC moves about a quarter of each commanded delta.
        lift_from: closing progress from which to lift.
        aligned: error [m] within which the grasp begins to close.
        started: closing progress from which closing goes on whatever the alignment.
    """

    object_from_grasp: tuple[float, float, float] = (0.0, 0.0, 0.0)
    hover: float = 0.04
    gain: float = 30.0
    lift_from: float = 0.2
    aligned: float = 0.012
    started: float = -0.4

    def __call__(self, observation: np.ndarray, rng: np.random.Generator | None = None) -> np.ndarray:
        """Action (n_act,) for an observation (n_obs,); deterministic."""
        progress = float(entry(observation, "closing_progress")[0])
        offset = entry(observation, "object_from_grasp") - np.array(self.object_from_grasp)
        goal = entry(observation, "goal_from_object")
        aside = float(np.hypot(offset[0], offset[1]))
        near = aside < self.aligned and abs(offset[2]) < self.aligned
        if progress < self.lift_from:
            # Stay above until aligned, so that the fingers come down beside the object.
            move = offset + np.array([0.0, 0.0, self.hover * np.clip((aside - 0.01) / 0.03, 0.0, 1.0)])
        else:
            # Lift first, then carry, so that the object clears the table.
            move = goal if goal[2] < 0.12 else np.array([0.0, 0.0, goal[2]])
        action = np.empty(ACTION_SIZE)
        action[:3] = np.clip(self.gain * move, -1.0, 1.0)
        action[3:6] = np.clip(-2.0 * entry(observation, "grasp_rotation"), -1.0, 1.0)
        action[6:] = 1.0 if near or progress > self.started else -1.0
        return action


def pick_script(item: PickObject) -> PickScript:
    """The script for an object: grasped at its centre, a tall one FINGER_DEPTH below its top."""
    return PickScript(object_from_grasp=(0.0, 0.0, min(0.0, FINGER_DEPTH - item.half_height)))

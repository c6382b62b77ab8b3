"""Scripted demonstrations of the pick on the source robot: a closed-loop motion that any behaviour cloning can follow."""

from dataclasses import dataclass

import numpy as np

from grippers.gripper import COMMANDED_ROLES
from tasks.pick import ACTION_SIZE, OBSERVATION

_ENTRY = {}
_offset = 0
for _name, _size in OBSERVATION.items():
    _ENTRY[_name] = slice(_offset, _offset + _size)
    _offset += _size


def entry(observation: np.ndarray, name: str) -> np.ndarray:
    """An entry of the observation record, by name."""
    return observation[..., _ENTRY[name]]


@dataclass(frozen=True)
class PickScript:
    """Approach from above, close, lift and carry, as a function of the observation alone.

    Attributes:
        object_from_grasp: where the object's centre should be in the grasp [m], world axes at the start rotation.
        hover: height [m] above the grasp from which to descend.
        gain: OSC action per metre of error; robosuite's OSC moves about a quarter of each commanded delta.
        closing_step: closing command added per step.
        fully_closed: closing command from which to lift.
    """

    object_from_grasp: tuple[float, float, float]
    hover: float = 0.04
    gain: float = 30.0
    closing_step: float = 0.15
    fully_closed: float = 0.95

    def __call__(self, observation: np.ndarray, rng: np.random.Generator | None = None) -> np.ndarray:
        """Action (n_act,) for an observation (n_obs,); deterministic."""
        command = float(entry(observation, "gripper_command")[0])
        offset = entry(observation, "object_from_grasp") - np.array(self.object_from_grasp)
        goal = entry(observation, "goal_from_object")
        aside = float(np.hypot(offset[0], offset[1]))
        if command < self.fully_closed:
            # Stay above until aligned, so that the fingers come down beside the object.
            above = self.hover * np.clip((aside - 0.01) / 0.03, 0.0, 1.0)
            move = offset + np.array([0.0, 0.0, above])
            near = aside < 0.012 and abs(offset[2]) < 0.010
            started = command > -0.999
            wanted = min(1.0, command + self.closing_step) if near or started else -1.0
        else:
            # Lift first, then carry.
            move = np.array([goal[0], goal[1], goal[2]]) * np.array([1.0, 1.0, 1.0])
            if goal[2] > 0.12:
                move[:2] = 0.0
            wanted = 1.0
        action = np.empty(ACTION_SIZE)
        action[:3] = np.clip(self.gain * move, -1.0, 1.0)
        action[3:6] = np.clip(-2.0 * entry(observation, "grasp_rotation"), -1.0, 1.0)
        action[6:] = wanted
        return action


N_FINGERS = len(COMMANDED_ROLES)

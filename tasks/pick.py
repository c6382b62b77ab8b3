"""DexYCB-style pick: lift the object from the table and bring it to a goal position.

Constants and pure functions only. The same functions serve robosuite's environment (tasks/env.py) and the fast
rollouts; they use nothing but NumPy so that they can be compiled.
"""

import re
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from grippers.gripper import COMMANDED_ROLES
from tasks.objects import OBJECTS, PickObject
from tasks.record import Entry, Record
from tasks.table import TABLE_TOP, add_object, add_table
from tasks.task import Task

if TYPE_CHECKING:
    import mujoco

START_POSITION = np.array([-0.10, 0.0, 0.95])
"""Grasp frame origin [m] at the start of every episode, for every robot, in the task's frame (floor, table centre)."""
START_ROTATION = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
"""Grasp frame axes at the start, as columns: x (closing axis, thumb side) along world y, z (approach) downwards."""
OBJECT_XY = np.array([-0.10, 0.0])
"""Nominal object position [m] on the table."""
GOAL_OFFSET = np.array([0.0, 0.10, 0.20])
"""Goal [m] relative to the object's nominal start: lifted 0.2 m and carried 0.1 m aside."""


_FINGER = "this finger joint's displacement from its start angle, see fingers; 0 where the gripper has no such joint"
_PROGRESS = "of the integrated closing command since the start: -1 at the preshape, +1 fully closed"
_TURNED, _UPRIGHT = "grasp frame's rotation from its start", "object's rotation from upright at zero yaw"
OBSERVATION = Record({
    **{f"finger/{role}": Entry(1, "rad", "joint", _FINGER, scale=0.3, noise=0.3, jump=0.15) for role in COMMANDED_ROLES},
    "closing_progress": Entry(1, "1", "gripper", _PROGRESS, scale=1.0, noise=0.1, jump=0.1),
    "grasp_position": Entry(3, "m", "task", "grasp frame origin from its start position", scale=0.05, gain=0.3, noise=0.03, jump=0.03),
    "grasp_rotation": Entry(3, "1", "task", f"{_TURNED}: axis times sine of the angle", scale=0.1, gain=0.3, noise=0.1, jump=0.15),
    # Where the object is believed to be decides where it is grasped, and where the goal is believed to be decides where it is carried. An
    # object that turned in the grasp, or hangs lower in it, is carried past the goal: by how much depends on how it lies there, which no
    # offset tells; how much of its turn and of the grasp's way the policy sees, and how far it turns the grasp for it, does.
    "object_from_grasp": Entry(
        3, "m", "task", "object centre from the grasp frame origin", scale=0.05, explored=0.012, gain=0.4, noise=0.01, jump=0.03
    ),
    "object_rotation": Entry(3, "1", "task", f"{_UPRIGHT}: axis times sine of the angle", scale=0.1, gain=0.3, noise=0.2, jump=0.3),
    "goal_from_object": Entry(
        3, "m", "task", "goal from the object centre", scale=0.05, explored=0.05, gain=0.4, noise=0.03, jump=0.03
    ),
})
"""The observation record. The same for every robot; joints that a robot lacks read zero."""
ACTION = Record({
    # On a gripper that closes slowly the hand has to wait for it; what is seen late, or by a noisy camera, asks for slower motions.
    "grasp_translation": Entry(3, "0.05 m", "controller", "OSC delta of the grasp frame's origin", explored=0.05, gain=0.4),
    "grasp_rotation": Entry(3, "0.5 rad", "controller", "OSC delta of the grasp frame's rotation", gain=0.3),
    **{f"close/{role}": Entry(1, "1", "gripper", "-1 open, +1 closed posture of that joint") for role in COMMANDED_ROLES},
})
"""The action record."""
OBSERVATION_SIZE, ACTION_SIZE = OBSERVATION.size, ACTION.size


@dataclass(frozen=True)
class PickTask(Task):
    """A pick task.

    Attributes:
        object: what is picked.
        noise_xy: half width [m] of the uniform shift of object and goal together.
        noise_yaw: half width [rad] of the uniform yaw of the object.
        goal_offset: goal (3,) [m] relative to the object's start.
        goal_tolerance: distance [m] from object to goal that counts as reached.
        hold_steps: consecutive policy steps within the tolerance that make a success.
        horizon: policy steps of an episode (paper, appendix, hyperparameters: 200).
        control_frequency: policy rate [Hz].
        title: name on the command line; None: the object's, with "-wide" for the wide start noise.
    """

    object: PickObject
    noise_xy: float = 0.01
    noise_yaw: float = 0.0
    goal_offset: tuple[float, float, float] = tuple(GOAL_OFFSET.tolist())
    goal_tolerance: float = 0.05
    hold_steps: int = 10
    horizon: int = 200
    control_frequency: float = 20.0
    title: str | None = None

    control_law = "osc"
    observation = OBSERVATION
    action = ACTION

    def __post_init__(self) -> None:
        if self.title is not None and not re.fullmatch(r"\w[\w-]*", self.title):
            raise ValueError(f"task title {self.title!r} is no name for a folder; use letters, digits, '_' and '-'")

    @property
    def name(self) -> str:
        """Name on the command line."""
        return self.title or self.object.name + ("-wide" if self.noise_yaw > 0 else "")

    def miss(self, observation: np.ndarray) -> float:
        """Distance [m] from the object to the goal."""
        return float(np.linalg.norm(observation[OBSERVATION.slice("goal_from_object")]))

    def add_furniture(self, spec: "mujoco.MjSpec") -> None:
        """Add what stands around the robot to a scene that is being built, before the robot."""
        add_table(spec)

    def add_object(self, spec: "mujoco.MjSpec") -> None:
        """Add what the robot moves, after it: a body "object" on a free joint of that name."""
        add_object(spec, self.object, (*OBJECT_XY, TABLE_TOP + self.object.half_height))

    def sample_start(self, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        """Start of an episode.

        Returns:
            object pose (7,): position [m] and quaternion (w first); goal position (3,) [m].
        """
        shift = rng.uniform(-self.noise_xy, self.noise_xy, 2)
        yaw = rng.uniform(-self.noise_yaw, self.noise_yaw)
        position = np.array([*(OBJECT_XY + shift), TABLE_TOP + self.object.half_height])
        quaternion = np.array([np.cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2)])
        return np.concatenate([position, quaternion]), position + np.array(self.goal_offset)


CARDS: dict[str, PickTask] = {
    task.name: task
    for item in OBJECTS.values()
    for task in (PickTask(item), PickTask(item, noise_xy=0.05, noise_yaw=np.deg2rad(30)))
}

def observe(
    fingers: np.ndarray,
    progress: float,
    grasp_position: np.ndarray,
    grasp_rotation: np.ndarray,
    object_position: np.ndarray,
    object_rotation: np.ndarray,
    goal: np.ndarray,
    start_position: np.ndarray,
    start_rotation: np.ndarray,
) -> np.ndarray:
    """The observation vector (n_obs,), entries in the order of OBSERVATION.

    A rotation R enters as axis times sine of its angle, half the antisymmetric part of R: smooth at zero, odd, bounded by 1.

    Args:
        fingers: displacements (22,) [rad], in the order of COMMANDED_ROLES.
        progress: of the closing command since the start, -1 to +1.
        grasp_position: (3,) [m], world.
        grasp_rotation: (3, 3) axes of the grasp frame as columns, world.
        object_position: (3,) [m], world.
        object_rotation: (3, 3) of the object, world.
        goal: (3,) [m], world.
        start_position: (3,) [m], START_POSITION.
        start_rotation: (3, 3), START_ROTATION.
    """
    n = fingers.shape[0]
    out = np.empty(n + 16)
    out[:n] = fingers
    out[n] = progress
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        sine = 0.0
        for m in range(3):  # of grasp_rotation @ start_rotation.T
            sine += grasp_rotation[k, m] * start_rotation[j, m] - grasp_rotation[j, m] * start_rotation[k, m]
        out[n + 1 + i] = grasp_position[i] - start_position[i]
        out[n + 4 + i] = 0.5 * sine
        out[n + 7 + i] = object_position[i] - grasp_position[i]
        out[n + 10 + i] = 0.5 * (object_rotation[k, j] - object_rotation[j, k])
        out[n + 13 + i] = goal[i] - object_position[i]
    return out


def at_goal(object_position: np.ndarray, goal: np.ndarray, tolerance: float) -> bool:
    """Whether the object is within the tolerance [m] of the goal."""
    return bool(np.sqrt(np.sum((object_position - goal) ** 2)) < tolerance)


def is_lost(object_position: np.ndarray) -> bool:
    """Whether the object has fallen off the table; the episode then ends as a failure."""
    return bool(object_position[2] < TABLE_TOP - 0.02)

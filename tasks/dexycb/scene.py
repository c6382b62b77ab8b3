"""From a recording to a pick: where object, goal and table are, and how the recorded scene lies in the robot's workspace."""

from dataclasses import dataclass

import numpy as np

from tasks.dexycb.recording import JOINT_NAMES, Recording
from tasks.objects import OBJECTS, PickObject
from tasks.pick import OBJECT_XY, START_ROTATION, PickTask
from tasks.table import TABLE_TOP

MASSES = {
    "002_master_chef_can": 0.414, "003_cracker_box": 0.411, "004_sugar_box": 0.514, "005_tomato_soup_can": 0.349,
    "006_mustard_bottle": 0.603, "007_tuna_fish_can": 0.171, "008_pudding_box": 0.187, "009_gelatin_box": 0.097,
    "010_potted_meat_can": 0.370, "011_banana": 0.066, "019_pitcher_base": 0.178, "021_bleach_cleanser": 1.131,
    "024_bowl": 0.147, "025_mug": 0.118, "035_power_drill": 0.895, "036_wood_block": 0.729, "037_scissors": 0.082,
    "040_large_marker": 0.0158, "051_large_clamp": 0.125, "052_extra_large_clamp": 0.202, "061_foam_brick": 0.028,
}
"""[kg], YCB object list (Calli et al. 2015)."""
MOVED = 0.015
"""[m] from its start at which an object counts as moved by the hand."""
LEAST_TRAVEL = 0.05
"""[m] from first to last pose below which a recording shows no pick."""
FINGER_DIRECTION = -START_ROTATION[:2, 0]
"""Horizontal direction (2,), task axes, from thumb to fingers at the start of an episode: the thumb closes on the +x side of the
grasp frame."""
SAME_SIZE = 0.004
"""[m] by which each half size may differ from the task's object for both to be the same."""
_TIPS = [JOINT_NAMES.index(f"{finger}_tip") for finger in ("index", "middle", "ring", "little")]
_MIDDLE_KNUCKLE = JOINT_NAMES.index("middle_mcp")
_THUMB_TIP = JOINT_NAMES.index("thumb_tip")


class SceneError(ValueError):
    """A recording that is whole but shows no pick that the tasks can play."""


@dataclass(frozen=True, eq=False)
class Scene:
    """The pick that a recording shows.

    Attributes:
        task: object and goal; no noise.
        standard: whether the object is the YCB task's own, standing as it does there.
        task_from_table: (4, 4) recorded table frame (tag) to the task's frame: the object starts at the task's place, its narrow
            side along the closing axis, and the hand comes from the robot's side.
        object_from_primitive: (4, 4) the primitive's frame (centre, upright) in the recorded object's frame.
        first, last: frames of the object's first and last pose.
        grasped: frame at which the hand has moved the object.
    """

    task: PickTask
    standard: bool
    task_from_table: np.ndarray
    object_from_primitive: np.ndarray
    first: int
    last: int
    grasped: int

    def joints(self, recording: Recording) -> np.ndarray:
        """(F, 21, 3) [m] the hand in the task's frame."""
        return recording.joints @ self.task_from_table[:3, :3].T + self.task_from_table[:3, 3]

    def object_poses(self, recording: Recording) -> np.ndarray:
        """(F, 4, 4) the primitive in the task's frame; NaN where the object is not annotated."""
        poses = np.tile(np.eye(4), (recording.frames, 1, 1))
        poses[:, :3, :3] = recording.rotations[:, recording.grasped]
        poses[:, :3, 3] = recording.positions[:, recording.grasped]
        return self.task_from_table @ poses @ self.object_from_primitive


def scene_of(recording: Recording, vertices: np.ndarray | None = None) -> Scene:
    """The pick that a recording shows.

    Args:
        recording: the recording.
        vertices: (N, 3) [m] of the grasped object's mesh, in the object's frame; None: the primitive of that YCB object, whose
            frame is its centre.

    Raises:
        SceneError: no geometry, a can that lies on its side, an object that is not moved, no hand when it is grasped.
    """
    name, k = recording.object, recording.grasped
    if vertices is None:
        if name not in OBJECTS:
            known = ", ".join(OBJECTS)
            raise SceneError(f"{recording.name}: there is no primitive of {name}; put its mesh in models/{name}, or use {known}")
        vertices = _primitive_vertices(OBJECTS[name])
    frames = np.flatnonzero(recording.object_seen)
    first, last = int(frames[0]), int(frames[-1])
    table_from_object = _pose(recording, first)
    standing = vertices @ table_from_object[:3, :3].T + table_from_object[:3, 3]
    yaw, low, high = _upright_box(standing)
    item, standard = _item(recording.name, name, (high - low) / 2)
    travel = np.linalg.norm(recording.positions[:, k] - recording.positions[first, k], axis=1)
    moved = np.flatnonzero(np.nan_to_num(travel) > MOVED)
    if not len(moved) or travel[last] < LEAST_TRAVEL:
        raise SceneError(
            f"{recording.name}: {name} ends {travel[last]:.3f} m from where it starts; a pick moves it {LEAST_TRAVEL} m or more"
        )
    grasped = int(moved[0])
    direction = _finger_direction(recording, grasped)
    R = _rotation_z(yaw)
    centre = np.append(R[:2, :2] @ (0.5 * (low + high))[:2], 0.5 * (low + high)[2])
    if item.shape == "cylinder":
        turn = np.arctan2(FINGER_DIRECTION[1], FINGER_DIRECTION[0]) - np.arctan2(direction[1], direction[0])
    else:
        # A box looks the same after half a turn: take the one in which the hand comes from the robot's side.
        turn = -yaw if (_rotation_z(-yaw)[:2, :2] @ direction) @ FINGER_DIRECTION >= 0 else np.pi - yaw
    task_from_table = np.eye(4)
    task_from_table[:3, :3] = _rotation_z(turn)
    # The table's height is that of the lowest vertex in the first frame.
    task_from_table[:3, 3] = [*OBJECT_XY, TABLE_TOP] - task_from_table[:3, :3] @ [*centre[:2], standing[:, 2].min()]
    start = np.eye(4)
    start[:3, 3] = [*OBJECT_XY, TABLE_TOP + item.half_height]
    object_from_primitive = np.linalg.inv(task_from_table @ table_from_object) @ start
    end = task_from_table @ _pose(recording, last) @ object_from_primitive
    task = PickTask(item, noise_xy=0.0, noise_yaw=0.0, goal_offset=tuple((end[:3, 3] - start[:3, 3]).tolist()))
    return Scene(task, standard, task_from_table, object_from_primitive, first, last, grasped)


def _pose(recording: Recording, frame: int) -> np.ndarray:
    out = np.eye(4)
    out[:3, :3] = recording.rotations[frame, recording.grasped]
    out[:3, 3] = recording.positions[frame, recording.grasped]
    return out


def _rotation_z(yaw: float) -> np.ndarray:
    c, s = np.cos(yaw), np.sin(yaw)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def _primitive_vertices(item: PickObject) -> np.ndarray:
    """(N, 3) [m] corners of a box, or points on both rims of a cylinder."""
    if item.shape == "box":
        return np.array(np.meshgrid(*([-h, h] for h in item.half_size))).reshape(3, -1).T
    radius, half_height = item.half_size
    angle = np.linspace(0, 2 * np.pi, 72, endpoint=False)
    rim = radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return np.vstack([np.column_stack([rim, np.full(72, z)]) for z in (-half_height, half_height)])


def _upright_box(points: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
    """The smallest upright box around points (N, 3).

    Returns:
        yaw [rad] of its axes, narrow side along its y; lower and upper corner (3,) [m] in those axes.
    """
    best: tuple[float, float] = (np.inf, 0.0)
    for yaw in np.deg2rad(np.arange(0.0, 90.0, 0.5)):
        extent = np.ptp(points[:, :2] @ _rotation_z(yaw)[:2, :2], axis=0)
        best = min(best, (float(extent.prod()), float(yaw)))
    yaw = best[1]
    extent = np.ptp(points[:, :2] @ _rotation_z(yaw)[:2, :2], axis=0)
    if extent[1] > extent[0]:
        yaw += np.pi / 2
    turned = points @ _rotation_z(yaw)
    return yaw, turned.min(axis=0), turned.max(axis=0)


def _item(recording: str, name: str, half: np.ndarray) -> tuple[PickObject, bool]:
    """The object as it stands in the recording, from half sizes (3,) of its upright box; and whether it is the task's own."""
    known = OBJECTS.get(name)
    if known is not None:
        own = np.array(known.half_size if known.shape == "box" else [known.half_size[0], *known.half_size])
        if np.abs(own - half).max() < SAME_SIZE:
            return known, True
        if known.shape == "cylinder":
            raise SceneError(f"{recording}: {name} does not stand upright at first; a can that lies or leans is not played")
    return PickObject(name, "box", tuple(float(h) for h in half), MASSES[name]), False


def _finger_direction(recording: Recording, frame: int) -> np.ndarray:
    """Horizontal unit direction (2,) in the table frame in which the hand reaches around the moment of the grasp.

    From wrist to middle knuckle; where the hand stands steeply, from the thumb's tip to the fingers'.
    """
    seen = np.flatnonzero(recording.hand_seen)
    near = seen[np.abs(seen - frame) <= 3]
    if not len(near):
        raise SceneError(f"{recording.name}: no hand is seen around frame {frame}, where the object is first moved")
    joints = recording.joints[near].mean(axis=0)
    along = joints[_MIDDLE_KNUCKLE] - joints[0]
    if np.linalg.norm(along[:2]) < 0.5 * np.linalg.norm(along):
        along = joints[_TIPS].mean(axis=0) - joints[_THUMB_TIP]
    length = np.linalg.norm(along[:2])
    return along[:2] / length if length > 1e-6 else np.array([1.0, 0.0])

"""Recordings of hands in DexYCB's format, read into one table frame.

The format (Chao et al., "DexYCB: A Benchmark for Capturing Hand Grasping of Objects", CVPR 2021), under one root:

    <subject>/<time>/meta.yml               serials, num_frames, extrinsics, ycb_ids, ycb_grasp_ind, mano_sides, mano_calib
    <subject>/<time>/pose.npz               pose_y (F, K, 7), pose_m (F, 1, 51), in the master camera's frame
    <subject>/<time>/<serial>/labels_*.npz  seg, pose_y (K, 3, 4), pose_m (1, 51), joint_3d (1, 21, 3), joint_2d (1, 21, 2), in its camera's
    calibration/extrinsics_<id>/extrinsics.yml    camera to master and tag to master, row-major 3 x 4
    models/<object>/textured_simple.obj     optional

Hands come from joint_3d, so that no MANO model is needed; objects from pose.npz. Everything that is read is data: YAML
becomes text, lists and maps whatever its tags, arrays are read without pickle and only at the size that is expected.
"""

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from tasks.npz import ArrayError, Arrays

YCB_NAMES: tuple[str, ...] = (
    "002_master_chef_can", "003_cracker_box", "004_sugar_box", "005_tomato_soup_can", "006_mustard_bottle",
    "007_tuna_fish_can", "008_pudding_box", "009_gelatin_box", "010_potted_meat_can", "011_banana", "019_pitcher_base",
    "021_bleach_cleanser", "024_bowl", "025_mug", "035_power_drill", "036_wood_block", "037_scissors", "040_large_marker",
    "051_large_clamp", "052_extra_large_clamp", "061_foam_brick",
)
"""Objects by DexYCB's class id, which counts from 1."""
FINGERS = ("thumb", "index", "middle", "ring", "little")
JOINT_NAMES: tuple[str, ...] = ("wrist", *(f"{finger}_{part}" for finger in FINGERS for part in ("mcp", "pip", "dip", "tip")))
"""The 21 joints of joint_3d, in order."""
FRAME_RATE = 25.0
"""[Hz]: cameras stream at 30; what is left after eight are synchronised was never published, and 25 is the ballpark that the
data set's maintainer uses."""
DEPTH = (0.1, 5.0)
"""[m] in which whatever a camera sees lies in front of it; values outside are in other units or another frame."""
HAND_REACH = (0.08, 0.30)
"""[m] from the wrist to the joint farthest from it, from a small child's fist to a very long hand."""
TABLE_BAND = (-0.1, 0.3)
"""[m] above the tag's table in which an object's frame lies when it is first seen."""
CARRIED = 0.1
"""[m] of travel from which on an object was picked up, as every recording shows; it then rises by RISE of that at least."""
CLEARLY = 0.2
"""How far fingers bend, in shares of their length, for it to tell a right hand from a left one."""
RISE = 0.25
"""Share of an object's travel."""
AGREEMENT = 0.05
"""[m] by which an object in labels and in pose.npz may differ, or a hand in two cameras."""
TURNED = np.deg2rad(5.0)
"""[rad] likewise of an object's rotation."""
LARGEST_YAML = 1 << 20
"""[bytes]"""
LARGEST_MESH = 1 << 28
"""[bytes]"""
_TAGS = {f"tag:yaml.org,2002:{tag}" for tag in ("str", "seq", "map", "int", "float", "python/tuple")}


class RecordingError(ValueError):
    """A recording that is not what the format says; the message names file, key, what was expected and what was found."""

    def __init__(self, file: Path, key: str, expected: str, found: str, mend: str = "") -> None:
        super().__init__(f"{file}: {key + ': ' if key else ''}expected {expected}, found {found}{'; ' + mend if mend else ''}")


@dataclass(frozen=True, eq=False)
class Recording:
    """A hand moves an object. F frames, K objects; the table frame is the tag's, z up, [m].

    Attributes:
        name: "<subject>/<time>".
        side: "right" or "left", as recorded; the arrays are a right hand's in either case, see `mirrored`.
        mirrored: whether a left hand was reflected at the table's plane x = 0 into a right one, its objects with it.
        frame_rate: [Hz].
        objects: (K,) YCB names.
        grasped: index of the grasped one.
        joints: (F, 21, 3), JOINT_NAMES' order; NaN in frames without a hand.
        positions: (F, K, 3) of the objects' frames; NaN where an object is not annotated.
        rotations: (F, K, 3, 3) object to table, NaN likewise.
        hand_camera: (F,) serial whose labels the hand came from, "" in frames without a hand.
    """

    name: str
    side: str
    mirrored: bool
    frame_rate: float
    objects: tuple[str, ...]
    grasped: int
    joints: np.ndarray
    positions: np.ndarray
    rotations: np.ndarray
    hand_camera: tuple[str, ...]

    @property
    def frames(self) -> int:
        """F."""
        return len(self.joints)

    @property
    def object(self) -> str:
        """YCB name of the grasped object."""
        return self.objects[self.grasped]

    @property
    def hand_seen(self) -> np.ndarray:
        """(F,) bool."""
        return np.isfinite(self.joints[:, 0, 0])

    @property
    def object_seen(self) -> np.ndarray:
        """(F,) bool, of the grasped object."""
        return np.isfinite(self.positions[:, self.grasped, 0])


def sequences(root: Path) -> list[str]:
    """Names "<subject>/<time>" of the recordings under a root, sorted.

    Raises:
        RecordingError: there is none.
    """
    found = sorted(f"{file.parent.parent.name}/{file.parent.name}" for file in Path(root).glob("*/*/meta.yml"))
    if not found:
        raise RecordingError(Path(root), "", "folders <subject>/<time>/meta.yml", "none", "give the folder that holds the subjects")
    return found


def read_recording(root: Path, name: str, frame_rate: float = FRAME_RATE) -> Recording:
    """Read one recording into the table frame; a left hand is mirrored.

    Args:
        root: the folder that holds the subjects and ``calibration``.
        name: "<subject>/<time>".
        frame_rate: [Hz].

    Raises:
        RecordingError: a file is missing, broken, or says what cannot be.
    """
    root, folder = Path(root), Path(root) / name
    if not 0.1 <= frame_rate <= 1000:
        raise RecordingError(folder, "frame rate", "0.1 to 1000 Hz", str(frame_rate))
    meta = _Meta(folder / "meta.yml")
    world_from = _extrinsics(root / "calibration" / f"extrinsics_{meta.extrinsics}" / "extrinsics.yml", meta)
    tag_from_world = np.linalg.inv(world_from["apriltag"])
    poses = _poses(folder / "pose.npz", meta)
    joints, cameras = _hands(folder, meta, world_from, poses)
    # A point p of the table is R^T (p_world - t) of the tag's pose R, t in the world.
    joints = joints @ tag_from_world[:3, :3].T + tag_from_world[:3, 3]
    table = tag_from_world @ poses
    positions, rotations = table[..., :3, 3], table[..., :3, :3]
    odd = _against_the_table(positions, meta.grasped)
    if odd is not None:
        inverse = _against_the_table((world_from["apriltag"] @ poses)[..., :3, 3], meta.grasped) is None
        why = "they would be with the inverse of that pose: it is to be tag to master" if inverse else "and its unit"
        raise RecordingError(folder / "pose.npz", "pose_y", *odd, f"check apriltag in extrinsics_{meta.extrinsics}: {why}")
    bent = _bent_like_a_right_hand(joints)
    if abs(bent) > CLEARLY and (bent > 0) != (meta.side == "right"):
        shown = "right" if bent > 0 else "left"
        raise RecordingError(folder / "meta.yml", "mano_sides", f"the {shown} hand that joint_3d shows", meta.side)
    mirrored = meta.side == "left"
    if mirrored:
        flip = np.diag([-1.0, 1.0, 1.0])
        joints, positions, rotations = joints @ flip, positions @ flip, flip @ rotations @ flip
    names = tuple(YCB_NAMES[i - 1] for i in meta.ycb_ids)
    return Recording(name, meta.side, mirrored, float(frame_rate), names, meta.grasped, joints, positions, rotations, cameras)


def grasped_object(root: Path, name: str) -> str:
    """YCB name of the object that a recording is about, from its meta.yml alone.

    Raises:
        RecordingError: that file is missing or broken.
    """
    meta = _Meta(Path(root) / name / "meta.yml")
    return YCB_NAMES[meta.ycb_ids[meta.grasped] - 1]


def _bent_like_a_right_hand(joints: np.ndarray) -> float:
    """How far the fingers of a hand (F, 21, 3) bend to the palm of a right hand, in shares of their length; of a left one negative.

    The mean over frames and fingers. The palm of a right hand faces along the cross product of the ways from its wrist to the index
    finger's knuckle and to the little finger's.
    """
    seen = joints[np.isfinite(joints[:, 0, 0])]
    place = lambda finger, part: seen[:, JOINT_NAMES.index(f"{finger}_{part}")]  # noqa: E731
    palm = np.cross(place("index", "mcp") - seen[:, 0], place("little", "mcp") - seen[:, 0])
    palm /= np.maximum(np.linalg.norm(palm, axis=1, keepdims=True), 1e-9)
    shares = []
    for finger in FINGERS[1:]:
        chain = [place(finger, part) for part in ("mcp", "pip", "dip", "tip")]
        length = sum(np.linalg.norm(b - a, axis=1) for a, b in zip(chain, chain[1:], strict=False))
        shares.append(((chain[-1] - chain[0]) * palm).sum(axis=1) / np.maximum(length, 1e-9))
    return float(np.mean(shares))


def _against_the_table(positions: np.ndarray, grasped: int) -> tuple[str, str] | None:
    """What is expected of objects (F, K, 3) [m] on a table with z up, and what is found; None if they may stand there.

    Every object lies on the table when it is first seen, and the grasped one, once it has been carried, has risen.
    """
    for k in range(positions.shape[1]):
        seen = positions[np.isfinite(positions[:, k, 2]), k]
        if len(seen) and (not TABLE_BAND[0] < seen[0, 2] < TABLE_BAND[1] or np.abs(seen[0, :2]).max() > 3.0):
            x, y, z = seen[0]
            return (f"objects that are first {TABLE_BAND[0]} to {TABLE_BAND[1]} m above the tag's table",
                    f"object {k} at ({x:.3g}, {y:.3g}, {z:.3g}) m from the tag")
    way = positions[np.isfinite(positions[:, grasped, 2]), grasped]
    way = way - way[0]
    travel, rise = float(np.linalg.norm(way, axis=1).max()), float(way[:, 2].max())
    if travel > CARRIED and rise < RISE * travel:
        return "the grasped object picked up from the tag's table", f"one that travels {travel:.2f} m and rises {max(rise, 0.0):.2f} m"
    return None


# ---- YAML ------------------------------------------------------------------------------------------------------------


def _read_yaml(file: Path) -> dict[str, Any]:
    """Text, lists and maps of a YAML file; scalars stay text, so that a serial or a date never turns into a number."""
    try:
        size = file.stat().st_size
        if size > LARGEST_YAML:
            raise RecordingError(file, "", f"at most {LARGEST_YAML} bytes", f"{size}")
        text = file.read_text(encoding="utf-8")
    except FileNotFoundError:
        raise RecordingError(file, "", "a file", "none") from None
    except UnicodeDecodeError:
        raise RecordingError(file, "", "text in UTF-8", "other bytes") from None
    except OSError as error:
        raise RecordingError(file, "", "a readable file", str(error.strerror)) from None
    try:
        loader = yaml.BaseLoader(text)
        try:
            node = loader.get_single_node()
            tag = _foreign_tag(node)
            if tag is not None:
                raise RecordingError(file, "", "plain lists, maps, text and numbers", f"the tag {tag[:80]!r}")
            content = None if node is None else loader.construct_document(node)
        finally:
            loader.dispose()
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        where = f" in line {mark.line + 1}" if mark else ""
        raise RecordingError(file, "", "YAML", f"{getattr(error, 'problem', None) or 'something else'}{where}") from None
    except (RecursionError, ValueError, TypeError) as error:
        if isinstance(error, RecordingError):
            raise
        raise RecordingError(file, "", "YAML of a few levels", type(error).__name__) from None
    if not isinstance(content, dict):
        raise RecordingError(file, "", "a map of keys", _kind(content))
    return content


def _foreign_tag(node: yaml.Node | None) -> str | None:
    """A tag below a node that is not plain data's, if there is one."""
    seen, waiting = set(), [node] if node is not None else []
    while waiting:
        node = waiting.pop()
        if id(node) in seen:
            continue
        seen.add(id(node))
        if node.tag not in _TAGS:
            return node.tag
        if isinstance(node, yaml.SequenceNode):
            waiting += node.value
        elif isinstance(node, yaml.MappingNode):
            waiting += [entry for pair in node.value for entry in pair]
    return None


def _kind(value: Any) -> str:
    """What a value is, in a few words, however large it is."""
    if value is None:
        return "nothing"
    if isinstance(value, str):
        return repr(value if len(value) <= 40 else value[:37] + "...")
    return f"a {'map' if isinstance(value, dict) else 'list'} of {len(value)}"


def _entry(file: Path, content: dict[str, Any], key: str, kind: type, expected: str) -> Any:
    value = content.get(key)
    if not isinstance(value, kind) or not value:
        raise RecordingError(file, key, expected, _kind(value))
    return value


def _name(file: Path, key: str, value: Any) -> str:
    """Text that is safe as a part of a path."""
    if not isinstance(value, str) or not re.fullmatch(r"\w[\w.-]{0,99}", value, re.ASCII):
        raise RecordingError(file, key, "a plain name", _kind(value))
    return value


def _whole(file: Path, key: str, value: Any, low: int, high: int) -> int:
    if not isinstance(value, str) or not re.fullmatch(r"\d{1,6}", value, re.ASCII) or not low <= int(value) <= high:
        raise RecordingError(file, key, f"a whole number from {low} to {high}", _kind(value))
    return int(value)


class _Meta:
    """meta.yml, checked."""

    def __init__(self, file: Path) -> None:
        content = _read_yaml(file)
        serials = _entry(file, content, "serials", list, "a list of camera serials")
        self.serials = tuple(_name(file, "serials", serial) for serial in serials)
        if len(set(self.serials)) < len(self.serials):
            raise RecordingError(file, "serials", "each camera once", "one twice")
        self.frames = _whole(file, "num_frames", content.get("num_frames"), 2, 100_000)
        self.extrinsics = _name(file, "extrinsics", content.get("extrinsics"))
        ids = _entry(file, content, "ycb_ids", list, "a list of object ids from 1 to 21")
        self.ycb_ids = tuple(_whole(file, "ycb_ids", i, 1, len(YCB_NAMES)) for i in ids)
        self.grasped = _whole(file, "ycb_grasp_ind", content.get("ycb_grasp_ind"), 0, len(self.ycb_ids) - 1)
        sides = _entry(file, content, "mano_sides", list, "a list with one hand")
        if len(sides) != 1 or sides[0] not in ("right", "left"):
            raise RecordingError(file, "mano_sides", '["right"] or ["left"]', f"{len(sides)} entries, first {_kind(sides[0])}")
        self.side = sides[0]
        calibrations = _entry(file, content, "mano_calib", list, "a list with one calibration's name")
        if len(calibrations) != 1:
            raise RecordingError(file, "mano_calib", "a list with one calibration's name", f"{len(calibrations)}")
        _name(file, "mano_calib", calibrations[0])


def _extrinsics(file: Path, meta: _Meta) -> dict[str, np.ndarray]:
    """(4, 4) pose in the world, the master camera's frame, of every camera of a recording and of the tag."""
    content = _read_yaml(file)
    table = _entry(file, content, "extrinsics", dict, "a map from serials and apriltag to 12 numbers")
    master = _name(file, "master", content.get("master"))
    if master not in meta.serials:
        raise RecordingError(file, "master", "one of the recording's serials", _kind(master))
    out = {}
    for key in (*meta.serials, "apriltag"):
        numbers = table.get(key)
        where = f"extrinsics.{key}"
        if not isinstance(numbers, list) or len(numbers) != 12 or not all(isinstance(n, str) for n in numbers):
            raise RecordingError(file, where, "12 numbers, row-major 3 x 4", _kind(numbers))
        try:
            matrix = np.array([float(n) for n in numbers]).reshape(3, 4)
        except ValueError:
            raise RecordingError(file, where, "12 numbers, row-major 3 x 4", "text") from None
        out[key] = np.vstack([_rigid(file, where, matrix), [0.0, 0.0, 0.0, 1.0]])
        if np.linalg.norm(matrix[:, 3]) > DEPTH[1]:
            raise RecordingError(file, where, f"a translation below {DEPTH[1]} m", f"{np.linalg.norm(matrix[:, 3]):.3g}", "metres?")
    if not np.allclose(out[master], np.eye(4), atol=1e-3):
        raise RecordingError(file, f"extrinsics.{master}", "the identity, as the world is the master camera's frame", "another pose")
    # Poses are what pose.npz is in, so the master comes first.
    return {master: out.pop(master)} | out


def _rigid(file: Path, key: str, matrix: np.ndarray) -> np.ndarray:
    """The (3, 4) matrix itself, if its left part is a rotation."""
    R = matrix[:, :3]
    if not np.abs(matrix).max() < 1e6:  # NaN included; squares of the rest do not overflow
        raise RecordingError(file, key, "a rotation and a translation", f"{np.abs(matrix).max():.3g}")
    if np.abs(R @ R.T - np.eye(3)).max() > 0.02 or np.linalg.det(R) < 0.9:
        raise RecordingError(file, key, "a rotation and a translation", "a matrix that is not orthonormal")
    return matrix


# ---- arrays ----------------------------------------------------------------------------------------------------------


_TYPES = {"f": ("float32", "float64"), "u": ("uint8",)}


class _Arrays:
    """An .npz file of a recording, whose errors name it."""

    def __init__(self, file: Path) -> None:
        self.file = file
        try:
            self._arrays = Arrays(file)
        except ArrayError as error:
            raise self._named(error) from None

    def __enter__(self) -> "_Arrays":
        return self

    def __exit__(self, *_: object) -> None:
        self._arrays.__exit__()

    def _named(self, error: ArrayError) -> RecordingError:
        return RecordingError(self.file, error.key, error.expected, error.found)

    def read(self, key: str, shape: tuple[int, ...], kind: str = "f") -> np.ndarray:
        """An array of exactly this shape, finite; kind "f" float32 or float64, "u" uint8."""
        try:
            return self._arrays.read(key, shape, _TYPES[kind])
        except ArrayError as error:
            raise self._named(error) from None

    def check(self, key: str, shape: tuple[int, ...], kind: str = "f") -> None:
        """As ``read``, of the array's header alone."""
        try:
            self._arrays.read(key, shape, _TYPES[kind], content=False)
        except ArrayError as error:
            raise self._named(error) from None


def _poses(file: Path, meta: _Meta) -> np.ndarray:
    """(F, K, 4, 4) object to world; NaN where an object is not annotated."""
    K = len(meta.ycb_ids)
    with _Arrays(file) as arrays:
        raw = arrays.read("pose_y", (meta.frames, K, 7))
        arrays.read("pose_m", (meta.frames, 1, 51))
    quaternion, position = raw[..., :4], raw[..., 4:]
    missing = (position == 0.0).all(axis=-1)  # with the identity or with a zero quaternion: both are in use
    if missing[:, meta.grasped].all():
        raise RecordingError(file, "pose_y", "the grasped object in a frame", "it in none")
    norm = np.linalg.norm(quaternion, axis=-1)
    wrong = ~missing & (np.abs(norm - 1.0) > 0.01)
    if wrong.any():
        frame, k = np.argwhere(wrong)[0]
        raise RecordingError(file, "pose_y", "unit quaternions x, y, z, w", f"length {norm[frame, k]:.3g} in frame {frame}, object {k}")
    _in_view(file, "pose_y", position[..., 2], ~missing)
    if np.abs(position).max() > DEPTH[1]:
        raise RecordingError(file, "pose_y", f"positions within {DEPTH[1]} m", f"{np.abs(position).max():.3g}", "are they in metres?")
    out = np.full((meta.frames, K, 4, 4), np.nan)
    out[~missing] = np.eye(4)
    out[~missing, :3, :3] = _matrices(quaternion[~missing] / norm[~missing, None])
    out[~missing, :3, 3] = position[~missing]
    return out


def _in_view(file: Path, key: str, depth: np.ndarray, seen: np.ndarray) -> None:
    """Refuse depths [m] along a camera's axis that no camera over a table sees."""
    wrong = seen & ~((depth > DEPTH[0]) & (depth < DEPTH[1]))
    if wrong.any():
        where = tuple(np.argwhere(wrong)[0].tolist())
        raise RecordingError(file, key, f"{DEPTH[0]} to {DEPTH[1]} m in front of the camera", f"{depth[where]:.3g} at {list(where)}",
                             "are they in metres?")


def _matrices(quaternion: np.ndarray) -> np.ndarray:
    """Rotation matrices (N, 3, 3) of unit quaternions (N, 4), w last as in pose.npz."""
    x, y, z, w = quaternion.T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), -1, 0)


def _angle(A: np.ndarray, B: np.ndarray) -> float:
    """[rad] between two rotations (3, 3)."""
    return float(np.arccos(np.clip((np.trace(A.T @ B) - 1) / 2, -1.0, 1.0)))


def _read_w_first(R: np.ndarray) -> np.ndarray:
    """The rotation that four numbers mean w first, of which R (3, 3) is what they mean w last; up to a sign of all."""
    w, x, y, z = (float(n) for n in _w_first_quaternion(R))
    return _matrices(np.array([[y, z, w, x]]))[0]  # the file's numbers are x, y, z, w of R; w first, they are w, x, y, z


def _w_first_quaternion(R: np.ndarray) -> np.ndarray:
    """(4,) w, x, y, z of a rotation (3, 3): the eigenvector of Bar-Itzhack (2000), sound for every angle."""
    K = np.array([
        [R[0, 0] - R[1, 1] - R[2, 2], R[1, 0] + R[0, 1], R[2, 0] + R[0, 2], R[2, 1] - R[1, 2]],
        [R[1, 0] + R[0, 1], R[1, 1] - R[0, 0] - R[2, 2], R[2, 1] + R[1, 2], R[0, 2] - R[2, 0]],
        [R[2, 0] + R[0, 2], R[2, 1] + R[1, 2], R[2, 2] - R[0, 0] - R[1, 1], R[1, 0] - R[0, 1]],
        [R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1], np.trace(R)],
    ])
    x, y, z, w = np.linalg.eigh(K)[1][:, -1]
    return np.array([w, x, y, z])


def _hands(folder: Path, meta: _Meta, world_from: dict[str, np.ndarray], poses: np.ndarray) -> tuple[np.ndarray, tuple[str, ...]]:
    """Joints (F, 21, 3) in the world from the first camera that sees the hand, master first; NaN where none does."""
    cameras = [serial for serial in world_from if serial != "apriltag" and (folder / serial).is_dir()]
    if not cameras:
        raise RecordingError(folder, "", f"a folder of labels per camera, as {meta.serials[0]}", "none",
                             "hands are read from joint_3d there; MANO's parameters alone do not give them")
    joints = np.full((meta.frames, len(JOINT_NAMES), 3), np.nan)
    seen_by = [""] * meta.frames
    for frame in range(meta.frames):
        for serial in cameras:
            in_camera = _label(folder / serial / f"labels_{frame:06d}.npz", meta, world_from[serial], poses[frame])
            if in_camera is not None:
                joints[frame] = in_camera @ world_from[serial][:3, :3].T + world_from[serial][:3, 3]
                seen_by[frame] = serial
                break
    if not any(seen_by):
        raise RecordingError(folder, "joint_3d", "a hand in a frame", "none in any frame")
    _other_cameras(folder, meta, world_from, poses, cameras, joints, seen_by)
    return joints, tuple(seen_by)


def _other_cameras(
    folder: Path, meta: _Meta, world_from: dict[str, np.ndarray], poses: np.ndarray, cameras: list[str], joints: np.ndarray,
    seen_by: list[str],
) -> None:
    """Compare what every camera says, in a few frames, with what was taken of joints (F, 21, 3) and poses: they see one scene."""
    seen = [frame for frame, serial in enumerate(seen_by) if serial]
    for serial in cameras:
        for frame in sorted({seen[0], seen[len(seen) // 2], seen[-1]}):
            file = folder / serial / f"labels_{frame:06d}.npz"
            if serial == seen_by[frame] or not file.is_file():
                continue
            in_camera = _label(file, meta, world_from[serial], poses[frame])
            if in_camera is None:
                continue
            apart = np.linalg.norm(in_camera @ world_from[serial][:3, :3].T + world_from[serial][:3, 3] - joints[frame], axis=1).max()
            if apart > AGREEMENT:
                raise RecordingError(file, "joint_3d", f"the hand within {AGREEMENT} m of where camera {seen_by[frame]} sees it",
                                     f"{apart:.3g} m away", "check this camera's extrinsics: camera to master")


def _label(file: Path, meta: _Meta, world_from_camera: np.ndarray, poses: np.ndarray) -> np.ndarray | None:
    """Joints (21, 3) in the camera's frame, None without a hand; the grasped object must be where pose.npz has it."""
    with _Arrays(file) as arrays:
        joints = arrays.read("joint_3d", (1, len(JOINT_NAMES), 3))[0]
        objects = arrays.read("pose_y", (len(meta.ycb_ids), 3, 4))
        arrays.check("seg", (480, 640), "u")
        arrays.check("pose_m", (1, 51))
        arrays.check("joint_2d", (1, len(JOINT_NAMES), 2))
    here, there = objects[meta.grasped], poses[meta.grasped]
    if here.any() and np.isfinite(there[0, 0]):
        _rigid(file, f"pose_y[{meta.grasped}]", here)
        apart = np.linalg.norm(world_from_camera[:3, :3] @ here[:, 3] + world_from_camera[:3, 3] - there[:3, 3])
        if apart > AGREEMENT:
            raise RecordingError(file, f"pose_y[{meta.grasped}]", f"the object within {AGREEMENT} m of where pose.npz has it",
                                 f"{apart:.3g} m away", "check the unit and this camera's extrinsics: camera to master")
        turned = _angle(world_from_camera[:3, :3] @ here[:, :3], there[:3, :3])
        if turned > TURNED:
            w_first = _angle(world_from_camera[:3, :3] @ here[:, :3], _read_w_first(there[:3, :3])) < TURNED
            mend = "pose.npz has its quaternions w first; the format is x, y, z, w" if w_first else "are the quaternions x, y, z, w?"
            raise RecordingError(file, f"pose_y[{meta.grasped}]", f"the object turned as in pose.npz to {np.rad2deg(TURNED):.0f} degrees",
                                 f"{np.rad2deg(turned):.0f} degrees between them", mend)
    if (joints == -1.0).all():
        return None
    _in_view(file, "joint_3d", joints[:, 2], np.ones(len(joints), bool))
    reach = np.linalg.norm(joints - joints[0], axis=1).max()
    if not HAND_REACH[0] < reach < HAND_REACH[1]:
        raise RecordingError(file, "joint_3d", f"a hand of {HAND_REACH[0]} to {HAND_REACH[1]} m from wrist to farthest joint",
                             f"{reach:.3g} m", "are joints in metres, in this order?")
    return joints


# ---- meshes ----------------------------------------------------------------------------------------------------------


def read_vertices(root: Path, object_name: str) -> np.ndarray | None:
    """Vertices (N, 3) [m] of an object's mesh in its own frame; None if the root has no ``models/<object>``.

    Raises:
        RecordingError: the file is broken or not in metres.
    """
    file = Path(root) / "models" / object_name / "textured_simple.obj"
    if not file.parent.is_dir():
        return None
    try:
        size = file.stat().st_size
        if size > LARGEST_MESH:
            raise RecordingError(file, "", f"at most {LARGEST_MESH} bytes", f"{size}")
        with open(file, encoding="utf-8", errors="replace") as lines:
            vertices = np.array([[float(n) for n in line.split()[1:4]] for line in lines if line.startswith("v ")])
    except FileNotFoundError:
        raise RecordingError(file, "", "a file", "none") from None
    except (ValueError, OSError) as error:
        if isinstance(error, RecordingError):
            raise
        raise RecordingError(file, "", 'lines "v x y z"', f"others ({str(error)[:60]})") from None
    if vertices.ndim != 2 or vertices.shape[1] != 3 or len(vertices) < 4 or not np.isfinite(vertices).all():
        raise RecordingError(file, "", "at least 4 finite vertices", f"an array of shape {vertices.shape}")
    extent = np.ptp(vertices, axis=0).max()
    if not 0.01 < extent < 0.5:
        raise RecordingError(file, "", "an object of 0.01 to 0.5 m", f"{extent:.3g}", "are vertices in metres?")
    return vertices

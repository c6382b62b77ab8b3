"""A stand-in for DexYCB: synthetic hands that pick YCB primitives, written in DexYCB's own format (tasks/dexycb/recording.py).

For everyone without the data set, and for tests. Nothing in it was recorded: a hand of 21 joints with the proportions of
Buchholz, Armstrong and Goldstein, "Anthropometric data for describing the kinematics of the human hand", Ergonomics 1992,
approaches from above, preshapes, closes until each finger touches, lifts and carries; poses, hand size, speed and sensor
noise vary. The frame of an object is the centre of its primitive, its axes the primitive's (tasks/objects.py).
"""

import os
import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import mkdtemp

import numpy as np
import yaml
from numpy.typing import ArrayLike

from tasks.dexycb.recording import YCB_NAMES
from tasks.objects import OBJECTS, PickObject

HAND_LENGTH = 0.19
"""[m] of the middle hand; subjects differ from it by a few per cent."""
_METACARPAL = np.array([0.463, 0.446, 0.421, 0.414])
_PHALANGES = np.array([[0.245, 0.143, 0.097], [0.266, 0.170, 0.108], [0.244, 0.165, 0.107], [0.204, 0.117, 0.093]])
_THUMB = np.array([0.251, 0.196, 0.158])
"""Lengths of bones in shares of the hand's length (Buchholz et al. 1992)."""
_KNUCKLE_X = np.array([0.15, 0.035, -0.08, -0.19])
_THUMB_BASE = np.array([0.14, -0.05, 0.13])
"""Knuckles across the palm and the thumb's base, in shares of the hand's length: a guess at a flat hand."""
_FLEXION = np.deg2rad([[4.0, 2.0, 2.0], [55.0, 95.0, 60.0]])
"""[rad] of mcp, pip and dip, preshaped and fully closed: a guess at a grasp from above."""
_THUMB_ABDUCTED = np.array([0.80, -0.50, -0.20])
"""Direction of the open thumb in hand axes, and the side to which it bends: a guess at a grasp from above."""
_THUMB_POLE = np.array([0.9, 0.0, -0.4])
PAD = 0.009
"""[m] from a finger's bone to its skin, a guess."""
SERIALS = ("840412060917", "932122061900")
"""Two of the data set's serials, the master first: two cameras instead of eight keep the stand-in small."""
_FOCAL, _CENTRE = 613.0, (320.0, 240.0)
FRAMES = 42
MISSING = (0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)
"""Row of pose_y of an object that is not annotated."""

README = """# Synthetic recordings in DexYCB's format

Made by `meta-evolve recordings make`; nothing here was recorded, and nothing here comes from DexYCB. Synthetic hands of 21 joints
pick boxes and cans of the sizes of YCB objects. Layout, keys, frames and units are DexYCB's, so that the same reader serves
both. What differs: two cameras instead of eight, no images (the reader needs none), objects' frames at the centres of their
primitives, no `models/`, and pose_m holds the wrist's pose only, as MANO is not needed.
"""


def rotation(axis: ArrayLike, angle: float) -> np.ndarray:
    """(3, 3) about an axis by an angle [rad] (Rodrigues)."""
    x, y, z = np.asarray(axis) / np.linalg.norm(axis)
    K = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * K + (1 - np.cos(angle)) * K @ K


def minimum_jerk(s: np.ndarray) -> np.ndarray:
    """The share of a reach that is done at share s of its time (Flash and Hogan 1985)."""
    s = np.clip(s, 0.0, 1.0)
    return s**3 * (10 - 15 * s + 6 * s**2)


# ---- the hand --------------------------------------------------------------------------------------------------------
# Hand axes: origin at the wrist, z along the fingers, palm facing -y, thumb on the side of +x: a right hand.


def finger_joints(finger: int, closing: float, length: float) -> np.ndarray:
    """(4, 3) [m] mcp, pip, dip and tip of index (0) to little (3), in hand axes, at a closing share in [0, 1]."""
    flexion = np.cumsum(_FLEXION[0] + closing * (_FLEXION[1] - _FLEXION[0]))
    bones = length * _PHALANGES[finger]
    steps = np.stack([np.zeros(3), -np.sin(flexion) * bones, np.cos(flexion) * bones], axis=1)
    knuckle = length * np.array([_KNUCKLE_X[finger], 0.0, _METACARPAL[finger]])
    return knuckle + np.vstack([np.zeros(3), np.cumsum(steps, axis=0)])


def thumb_joints(closing: float, length: float, touch: np.ndarray) -> np.ndarray:
    """(4, 3) [m] base, mcp, ip and tip of the thumb (named mcp, pip, dip, tip in joint_3d), in hand axes.

    The tip goes straight from the abducted thumb's to ``touch`` (3,) [m]; both joints bend alike.
    """
    bones, base = length * _THUMB, length * _THUMB_BASE
    opened = base + 0.95 * bones.sum() * _THUMB_ABDUCTED / np.linalg.norm(_THUMB_ABDUCTED)
    way = opened + closing * (touch - opened) - base
    reach = min(np.linalg.norm(way), 0.999 * bones.sum())
    low, high = 0.0, np.deg2rad(150)
    for _ in range(40):  # the bend at which the chain is as long as the way
        bend = 0.5 * (low + high)
        flat = np.cumsum(bones[:, None] * np.stack([np.cos(bend * np.arange(3)), np.sin(bend * np.arange(3))], axis=1), axis=0)
        low, high = (bend, high) if np.linalg.norm(flat[-1]) > reach else (low, bend)
    along = way / np.linalg.norm(way)
    side = _THUMB_POLE - (_THUMB_POLE @ along) * along
    side /= np.linalg.norm(side)
    chord = np.arctan2(flat[-1, 1], flat[-1, 0])
    c, s = np.cos(-chord), np.sin(-chord)
    turned = flat @ np.array([[c, s], [-s, c]])  # the chord now lies along the first axis, the bend on its negative side
    return np.vstack([base, base + turned[:, :1] * along - turned[:, 1:] * side])


def hand_joints(closing: Sequence[float], length: float, touch: np.ndarray) -> np.ndarray:
    """(21, 3) [m] in hand axes, in joint_3d's order, at a closing share per finger, thumb first, whose tip closes to ``touch``."""
    fingers = [thumb_joints(closing[0], length, touch), *(finger_joints(i, closing[i + 1], length) for i in range(4))]
    return np.vstack([np.zeros(3), *fingers])


def closing_at_contact(item: PickObject, chain: Callable[[float], np.ndarray], centre: np.ndarray, axes: np.ndarray) -> float:
    """The closing share at which a finger's last two bones first touch an object.

    Args:
        item: the object.
        chain: closing share -> joints (4, 3) in hand axes.
        centre: of the object, in hand axes [m].
        axes: (3, 3) object to hand.
    """
    for closing in np.linspace(0.0, 1.0, 101):
        joints = chain(closing)
        bones = [joints[i] + s * (joints[i + 1] - joints[i]) for i in (1, 2) for s in np.linspace(0, 1, 6)]
        if item.distance((np.array(bones) - centre) @ axes).min() < PAD:
            return float(closing)
    return 1.0


# ---- one motion ------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Motion:
    """A pick in the table frame: joints (F, 21, 3) [m], object position (F, 3) [m] and rotation (F, 3, 3)."""

    joints: np.ndarray
    position: np.ndarray
    rotation: np.ndarray


def _palm_down(yaw: float) -> np.ndarray:
    """(3, 3) hand to table of a flat palm whose fingers point along -y of the table, turned by a yaw [rad] about z."""
    return rotation((0, 0, 1), yaw) @ np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])


def _motion(item: PickObject, rng: np.random.Generator, frames: int) -> _Motion:
    length = HAND_LENGTH * rng.uniform(0.94, 1.06)
    object_yaw = rng.uniform(-np.pi, np.pi)
    hand_yaw = object_yaw + rng.normal(0.0, np.deg2rad(5))
    start = np.array([rng.uniform(0.35, 0.75), rng.uniform(0.15, 0.45), item.half_height])
    axes = rotation((0, 0, 1), object_yaw)
    # Where the object lies in the hand: under the palm, its middle a third of the palm before the knuckles.
    in_hand = np.array([0.012, -max(0.038, item.half_height + 0.013), 0.053 + 0.6 * (item.width / 2 - 0.026)])
    in_hand = in_hand * length / HAND_LENGTH + rng.normal(0.0, 0.002, 3)
    hand = _palm_down(hand_yaw)
    grasp = start - hand @ in_hand
    # The thumb's tip closes to the near face, under the index finger and a little below the middle.
    touch = in_hand + np.array([0.015, -0.2 * item.half_height, -item.width / 2 - PAD + 0.002])
    fingers = [lambda c, i=i: finger_joints(i, c, length) for i in range(4)]
    contact = [1.0, *(closing_at_contact(item, finger, in_hand, hand.T @ axes) for finger in fingers)]
    # Shares of the time: approach, close, hold, lift and carry, hold.
    time = np.linspace(0.0, 1.0, frames)
    reach = minimum_jerk(time / 0.38)
    close = minimum_jerk((time - 0.36) / 0.18)
    lift, carry = minimum_jerk((time - 0.58) / 0.30), minimum_jerk((time - 0.66) / 0.30)
    away = np.array([*rng.uniform(-0.06, 0.06, 2), rng.uniform(0.10, 0.16)])
    up, back = rng.uniform(0.17, 0.23), rng.uniform(0.07, 0.13)
    aside = hand @ np.array([rng.uniform(-0.03, 0.03), 0.0, -back])
    turn = rng.normal(0.0, np.deg2rad(6), 3)
    shares = np.stack([reach, close, lift, carry], axis=1)
    return _assemble(item, length, hand, grasp, in_hand, axes, (contact, touch), shares, (away, up, aside, turn), rng)


def _assemble(
    item: PickObject, length: float, hand: np.ndarray, grasp: np.ndarray, in_hand: np.ndarray, axes: np.ndarray,
    contact: tuple[Sequence[float], np.ndarray], shares: np.ndarray, ways: tuple[np.ndarray, float, np.ndarray, np.ndarray],
    rng: np.random.Generator,
) -> _Motion:
    """Play the phases: shares (F, 4) done of reach, closing, lift and carry.

    ``contact`` holds each finger's closing share where it touches, and where the thumb's tip does (3,) [m] in hand axes; ``ways``
    the hand's start above the grasp (3,) [m], the lift [m], the carry (3,) [m] and the turn on the way (3,) [rad].
    """
    away, up, aside, turn = ways
    tremor = _smooth_noise(rng, (len(shares), 3), 0.0015)
    joints, positions, rotations = [], [], []
    for i, (reach, close, lift, carry) in enumerate(shares):
        # The sideways part of the approach ends before the descent does, so that fingers come down beside the object.
        aloft = np.array([*(away[:2] * (1 - reach) ** 2), away[2] * (1 - reach)])
        tilt = rotation((0, 0, 1), 1e-9) if carry == 0 else rotation(turn, carry * np.linalg.norm(turn))
        R = tilt @ hand
        wrist = grasp + aloft + np.array([0.0, 0.0, up * lift]) + aside * carry + tremor[i] * (1 - close + carry)
        spread = [close * (c + 0.03) + 0.01 * rng.normal() * (1 - close) for c in contact[0]]
        joints.append(wrist + hand_joints(np.clip(spread, 0.0, 1.0), length, contact[1]) @ R.T)
        held = close >= 1.0
        start = grasp + hand @ in_hand
        positions.append(wrist + R @ in_hand if held else start)
        rotations.append(tilt @ axes if held else axes)
    return _Motion(np.array(joints), np.array(positions), np.array(rotations))


def _smooth_noise(rng: np.random.Generator, shape: tuple[int, ...], deviation: float) -> np.ndarray:
    """Noise along the first axis without jumps from frame to frame."""
    raw = rng.standard_normal((shape[0] + 8, *shape[1:]))
    kernel = np.hanning(9) / np.linalg.norm(np.hanning(9))
    smooth = np.apply_along_axis(lambda column: np.convolve(column, kernel, "valid"), 0, raw)
    return deviation * smooth


# ---- files -----------------------------------------------------------------------------------------------------------


def _look_at(position: ArrayLike, target: ArrayLike) -> np.ndarray:
    """(4, 4) camera to table of a camera with OpenCV's axes: z forwards, y down."""
    forwards = np.subtract(target, position)
    forwards /= np.linalg.norm(forwards)
    right = np.cross(forwards, (0.0, 0.0, 1.0))
    right /= np.linalg.norm(right)
    out = np.eye(4)
    out[:3, :3] = np.stack([right, np.cross(forwards, right), forwards], axis=1)
    out[:3, 3] = position
    return out


def _cameras(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """(4, 4) camera to table of the two cameras."""
    aim = np.array([0.55, 0.3, 0.05])
    return _look_at(rng.normal((0.55, -0.55, 0.65), 0.02), aim), _look_at(rng.normal((-0.25, 0.4, 0.7), 0.02), aim)


def _quaternion(R: np.ndarray) -> np.ndarray:
    """x, y, z, w of a rotation matrix, by its largest component (Shepperd 1978)."""
    m = np.array([1 + R[0, 0] - R[1, 1] - R[2, 2], 1 - R[0, 0] + R[1, 1] - R[2, 2], 1 - R[0, 0] - R[1, 1] + R[2, 2], 1 + np.trace(R)])
    i = int(np.argmax(m))
    q = np.array([
        [m[0], R[1, 0] + R[0, 1], R[2, 0] + R[0, 2], R[2, 1] - R[1, 2]],
        [R[1, 0] + R[0, 1], m[1], R[2, 1] + R[1, 2], R[0, 2] - R[2, 0]],
        [R[2, 0] + R[0, 2], R[2, 1] + R[1, 2], m[2], R[1, 0] - R[0, 1]],
        [R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1], m[3]],
    ][i])
    return q / np.linalg.norm(q)


def _axis_angle(R: np.ndarray) -> np.ndarray:
    q = _quaternion(R)
    angle = 2 * np.arctan2(np.linalg.norm(q[:3]), q[3])
    return q[:3] / max(np.linalg.norm(q[:3]), 1e-12) * angle


def _write_calibration(root: Path, stamp: str, cameras: tuple[np.ndarray, np.ndarray]) -> None:
    folder = root / "calibration"
    (folder / "intrinsics").mkdir(parents=True, exist_ok=True)
    (folder / f"extrinsics_{stamp}").mkdir(exist_ok=True)
    (folder / f"mano_{stamp}_subject-01_right").mkdir(exist_ok=True)
    (folder / f"mano_{stamp}_subject-01_left").mkdir(exist_ok=True)
    for serial in SERIALS:
        numbers = {"fx": _FOCAL, "fy": _FOCAL, "ppx": _CENTRE[0], "ppy": _CENTRE[1]}
        (folder / "intrinsics" / f"{serial}_640x480.yml").write_text(yaml.dump({"color": numbers}))
    world = np.linalg.inv(cameras[0])
    poses = {serial: world @ camera for serial, camera in zip(SERIALS, cameras, strict=True)} | {"apriltag": world}
    table = {key: tuple(float(n) for n in pose[:3].ravel()) for key, pose in poses.items()}
    (folder / f"extrinsics_{stamp}" / "extrinsics.yml").write_text(yaml.dump({"extrinsics": table, "master": SERIALS[0]}))
    for side in ("right", "left"):
        (folder / f"mano_{stamp}_subject-01_{side}" / "mano.yml").write_text(yaml.dump({"betas": [0.0] * 10}))


@dataclass(frozen=True)
class _Take:
    """What is common to the files of one recording; objects in the table frame, the grasped one first."""

    folder: Path
    side: str
    ids: tuple[int, ...]
    positions: np.ndarray
    rotations: np.ndarray
    joints: np.ndarray
    hidden: np.ndarray
    """(F,) bool: frames without a hand."""
    shaded: np.ndarray
    """(F,) bool: frames in which only the second camera sees the hand."""
    unseen: tuple[bool, ...]
    """(K,) objects that are not annotated."""


def _write_take(take: _Take, stamp: str, cameras: tuple[np.ndarray, np.ndarray]) -> None:
    frames, K = take.positions.shape[:2]
    take.folder.mkdir(parents=True, exist_ok=True)
    meta = {
        "serials": list(SERIALS), "num_frames": frames, "extrinsics": stamp, "ycb_ids": list(take.ids), "ycb_grasp_ind": 0,
        "mano_sides": [take.side], "mano_calib": [f"{stamp}_subject-01_{take.side}"],
    }
    (take.folder / "meta.yml").write_text(yaml.dump(meta))
    pose_y, pose_m = np.zeros((frames, K, 7)), np.zeros((frames, 1, 51))
    for frame in range(frames):
        for k in range(K):
            here = np.linalg.inv(cameras[0]) @ _pose(take.rotations[frame, k], take.positions[frame, k])
            pose_y[frame, k] = MISSING if take.unseen[k] else (*_quaternion(here[:3, :3]), *here[:3, 3])
        for serial, camera in zip(SERIALS, cameras, strict=True):
            hidden = take.hidden[frame] or (take.shaded[frame] and serial == SERIALS[0])
            m = _write_label(take, frame, serial, np.linalg.inv(camera), hidden)
            if serial == SERIALS[0] and not take.hidden[frame]:
                pose_m[frame] = m
    np.savez_compressed(take.folder / "pose.npz", pose_y=pose_y.astype(np.float32), pose_m=pose_m.astype(np.float32))


def _pose(R: np.ndarray, p: np.ndarray) -> np.ndarray:
    out = np.eye(4)
    out[:3, :3], out[:3, 3] = R, p
    return out


def _write_label(take: _Take, frame: int, serial: str, camera_from_table: np.ndarray, hidden: bool) -> np.ndarray:
    """Write labels_NNNNNN.npz; returns pose_m (1, 51), the wrist's pose alone."""
    joints = take.joints[frame] @ camera_from_table[:3, :3].T + camera_from_table[:3, 3]
    K = take.positions.shape[1]
    pose_y = np.stack([(camera_from_table @ _pose(take.rotations[frame, k], take.positions[frame, k]))[:3] for k in range(K)])
    pose_y[list(take.unseen)] = 0.0
    pixels = joints[:, :2] / joints[:, 2:] * _FOCAL + _CENTRE
    wrist = np.zeros((1, 51))
    forwards = joints[9] - joints[0]
    across = np.cross(joints[5] - joints[17], forwards)
    z, y = forwards / np.linalg.norm(forwards), across / np.linalg.norm(across)
    wrist[0, :3], wrist[0, 48:] = _axis_angle(np.stack([np.cross(y, z), y, z], axis=1)), joints[0]
    seg = np.zeros((480, 640), np.uint8)
    low, high = (np.clip(f(pixels, axis=0), 0, (639, 479)).astype(int) for f in (np.min, np.max))
    if not hidden:
        seg[low[1] : high[1], low[0] : high[0]] = 255
    folder = take.folder / serial
    folder.mkdir(exist_ok=True)
    np.savez_compressed(
        folder / f"labels_{frame:06d}.npz", seg=seg, pose_y=pose_y.astype(np.float32),
        pose_m=(np.zeros((1, 51)) if hidden else wrist).astype(np.float32),
        joint_3d=np.full((1, 21, 3), -1, np.float32) if hidden else joints[None].astype(np.float32),
        joint_2d=np.full((1, 21, 2), -1, np.float32) if hidden else pixels[None].astype(np.float32),
    )
    return wrist


def _take(folder: Path, item: PickObject, left: bool, rng: np.random.Generator, frames: int) -> _Take:
    motion = _motion(item, rng, frames)
    # Two more objects of the data set stand aside; sometimes one of them was not annotated.
    others = rng.choice([i for i, name in enumerate(YCB_NAMES, 1) if name != item.name], 2, replace=False)
    ids = (YCB_NAMES.index(item.name) + 1, *(int(i) for i in others))
    beside = motion.position[0] + np.array([[0.25, 0.1, 0.03], [-0.2, 0.2, 0.05]])
    positions = np.stack([motion.position, *(np.tile(p, (frames, 1)) for p in beside)], axis=1)
    still = [rotation((0, 0, 1), yaw) for yaw in rng.uniform(-np.pi, np.pi, 2)]
    rotations = np.stack([motion.rotation, *(np.tile(R, (frames, 1, 1)) for R in still)], axis=1)
    joints = motion.joints + rng.normal(0.0, 0.001, motion.joints.shape) + _smooth_noise(rng, motion.joints.shape, 0.001)
    positions[:, 0] += rng.normal(0.0, 0.0005, (frames, 3))
    if left:  # the mirror image, moved back over the table
        flip = np.diag([-1.0, 1.0, 1.0])
        joints, positions = joints @ flip + (1.1, 0, 0), positions @ flip + (1.1, 0, 0)
        rotations = flip @ rotations @ flip
    hidden = np.zeros(frames, bool)
    hidden[: 1 + rng.integers(3)] = True
    shaded = np.zeros(frames, bool)
    shaded[8 : 8 + rng.integers(4)] = True
    unseen = (False, False, bool(rng.random() < 0.3))
    return _Take(folder, "left" if left else "right", ids, positions, rotations, joints, hidden, shaded, unseen)


def write_standin(
    root: Path,
    objects: Sequence[str] = tuple(OBJECTS),
    each: int = 5,
    seed: int = 0,
    frames: int = FRAMES,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> list[str]:
    """Write a stand-in; the same arguments write the same bytes.

    Args:
        root: a folder that does not exist yet, or is empty.
        objects: names in tasks.objects.OBJECTS.
        each: recordings per object; every fifth is of a left hand.
        seed: of everything random.
        frames: per recording, at 25 Hz.
        progress: called with how many recordings are written, and of how many.

    Returns:
        Names of the recordings.

    Raises:
        ValueError: an unknown object, no recordings, too few frames, or a folder that holds files.
    """
    unknown = [name for name in objects if name not in OBJECTS]
    if unknown:
        raise ValueError(f"object {unknown[0]!r} has no primitive; there are: {', '.join(OBJECTS)}")
    if each < 1 or not objects or not 10 <= frames <= 1000 or seed < 0:
        raise ValueError(f"{each} recordings of {len(objects)} objects with {frames} frames and seed {seed} cannot be made; "
                         "give at least one of each, 10 to 1000 frames and a seed from 0 on")
    root = Path(root)
    if root.exists() and (not root.is_dir() or any(root.iterdir())):
        raise ValueError(f"{root} exists and is not an empty folder; choose another --out")
    root.parent.mkdir(parents=True, exist_ok=True)
    part = Path(mkdtemp(prefix=f".{root.name}.", dir=root.parent))  # half a data set would be taken for a whole one
    try:
        names = _write_all(part, objects, each, seed, frames, progress)
        part.chmod(0o755)
        os.replace(part, root)
    finally:
        shutil.rmtree(part, ignore_errors=True)
    return names


def _write_all(
    root: Path, objects: Sequence[str], each: int, seed: int, frames: int, progress: Callable[[int, int], None]
) -> list[str]:
    stamp = "20260101_000000"
    cameras = _cameras(np.random.default_rng((seed, 1)))
    names = []
    _write_calibration(root, stamp, cameras)
    for number, (name, index) in enumerate((name, i) for name in objects for i in range(each)):
        time = f"20260101_{number // 3600:02d}{number // 60 % 60:02d}{number % 60:02d}"
        names.append(f"20260101-subject-01/{time}")
        rng = np.random.default_rng((seed, 2, number))
        _write_take(_take(root / names[-1], OBJECTS[name], index % 5 == 4, rng, frames), stamp, cameras)
        progress(number + 1, len(objects) * each)
    (root / "README.md").write_text(README)
    return names

"""Recordings of hands for the Rerun viewer: the recorded hand, the robot hand that follows it, and the replay, side by side.

    recorded/hand, recorded/object      as they were read, in the task's frame
    retargeted/<body>                   the robot's hand alone, by inverse kinematics
    retargeted/object                   the recorded object again
    replay/<body>                       what happened in simulation

All on the timeline "film" [s], one recording after the other.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from tasks.dexycb.recording import FINGERS, JOINT_NAMES
from tasks.objects import PickObject
from toolkit.inspection.appearance import body_mesh
from toolkit.inspection.recording.layout import BACKGROUND, quiet_layout
from toolkit.inspection.recording.stream import FILM, Stream, x_first

PAUSE = 0.6
"""[s] between two recordings."""
ROOM = 1.5
"""[m] from which on a geom is the wall of a room, which would hide the robot."""
SKIN, SKELETON, THING = (224, 172, 130), (120, 80, 60), (230, 90, 60)
BONES = [[0, *(JOINT_NAMES.index(f"{finger}_{part}") for part in ("mcp", "pip", "dip", "tip"))] for finger in FINGERS]


@dataclass(frozen=True, eq=False)
class Clip:
    """One recording, three times. F frames, T policy steps; the task's frame.

    Attributes:
        name: shown above the recorded hand.
        item: the object.
        frame_dt: [s] between frames.
        joints: (F, 21, 3) [m], NaN without a hand.
        object_poses: (F, 4, 4), NaN where not annotated.
        hand: the robot hand alone; hand_frames: (N,) frames of hand_qpos (N, nq).
        replay: the robot in its task; replay_qpos: (T, nq); control_dt: [s] between its rows.
        verdict: what came of the replay, in a word or two.
    """

    name: str
    item: PickObject
    frame_dt: float
    joints: np.ndarray
    object_poses: np.ndarray
    hand: mujoco.MjModel
    hand_frames: np.ndarray
    hand_qpos: np.ndarray
    replay: mujoco.MjModel
    replay_qpos: np.ndarray
    control_dt: float
    verdict: str


class HandRecording:
    """Draws clips.

    Args:
        stream: to draw into.
    """

    def __init__(self, stream: Stream) -> None:
        self._stream = stream
        self._models = {entity: AnimatedModel(stream, entity) for entity in ("retargeted", "replay")}
        stream.arrange(_layout())

    def log_clips(self, clips: Sequence[Clip]) -> None:
        """Log clips one after the other on the timeline "film"."""
        start = 0.0
        for number, clip in enumerate(clips):
            ends = [self._log_recorded(clip, start, number)]
            first = start + clip.frame_dt * float(clip.hand_frames[0])
            ends.append(self._models["retargeted"].play(clip.hand, clip.hand_qpos, clip.frame_dt, first, number))
            ends.append(self._models["replay"].play(clip.replay, clip.replay_qpos, clip.control_dt, start, number))
            self._label("retargeted", "robot hand", clip, start, number)
            self._label("replay", f"replay: {clip.verdict}", clip, start, number)
            start = max(ends) + PAUSE

    def _log_recorded(self, clip: Clip, start: float, number: int) -> float:
        half, stream = clip.item.half_size, self._stream
        for entity in ("recorded/object", "retargeted/object"):
            stream.row(f"{entity}/box", start, number, rr.Clear(recursive=False))
            stream.row(f"{entity}/can", start, number, rr.Clear(recursive=False))
            if clip.item.shape == "box":
                stream.row(f"{entity}/box", start, number, rr.Boxes3D(half_sizes=[half], colors=[THING], fill_mode="solid"))
            else:
                can = rr.Cylinders3D(lengths=[2 * half[1]], radii=[half[0]], colors=[THING], fill_mode="solid")
                stream.row(f"{entity}/can", start, number, can)
        self._label("recorded", f"recorded: {clip.name}", clip, start, number)
        for frame, (joints, pose) in enumerate(zip(clip.joints, clip.object_poses, strict=True)):
            moment = start + frame * clip.frame_dt
            if np.isfinite(pose).all():
                placed = rr.Transform3D(translation=pose[:3, 3], mat3x3=pose[:3, :3])
                stream.row("recorded/object", moment, number, placed)
                stream.row("retargeted/object", moment, number, placed)
            if np.isfinite(joints).all():
                bones = rr.LineStrips3D([joints[b] for b in BONES], colors=SKELETON, radii=0.004)
                stream.row("recorded/hand/bones", moment, number, bones)
                stream.row("recorded/hand/joints", moment, number, rr.Points3D(joints, colors=SKIN, radii=0.007))
            else:
                stream.row("recorded/hand", moment, number, rr.Clear(recursive=True))
        return start + len(clip.joints) * clip.frame_dt

    def _label(self, entity: str, text: str, clip: Clip, start: float, number: int) -> None:
        seen = clip.object_poses[np.isfinite(clip.object_poses[:, 0, 0])]
        above = seen[0, :3, 3] + (0.0, 0.0, 0.38)
        mark = rr.Points3D([above], labels=[text], colors=(40, 40, 40), radii=0.002, show_labels=True)
        self._stream.row(f"{entity}/label", start, number, mark)


class AnimatedModel:
    """Any MuJoCo model as meshes, one per body, each logged once.

    Args:
        stream: to draw into.
        entity: that holds it.
    """

    def __init__(self, stream: Stream, entity: str) -> None:
        self._stream, self._entity = stream, entity
        self._known: dict[bytes, str] = {}

    def play(self, model: mujoco.MjModel, qpos: np.ndarray, interval: float, start: float, iteration: int) -> float:
        """Move it.

        Args:
            model: whose bodies are drawn; another one than before takes its place.
            qpos: (T, nq) [m, rad], ``interval`` [s] apart, the first at ``start`` [s] of the film.
            iteration: on the other timeline.

        Returns:
            [s] just after the last row.
        """
        data = mujoco.MjData(model)
        positions, quaternions = np.empty((len(qpos), model.nbody, 3)), np.empty((len(qpos), model.nbody, 4))
        for frame, row in enumerate(qpos):
            data.qpos[:] = row
            mujoco.mj_kinematics(model, data)
            positions[frame], quaternions[frame] = data.xpos, data.xquat
        times = start + interval * np.arange(len(qpos))
        shown = set()
        for body in range(model.nbody):
            entity = self._mesh(model, body)
            if entity is not None:
                shown.add(entity)
                poses = rr.InstancePoses3D.columns(translations=positions[:, body], quaternions=x_first(quaternions[:, body]))
                self._stream.rows(entity, times, iteration, poses)
        for entity in set(self._known.values()) - shown:
            self._stream.row(entity, start, iteration, rr.InstancePoses3D(translations=np.empty((0, 3))))
        return start + interval * len(qpos)

    def _mesh(self, model: mujoco.MjModel, body: int) -> str | None:
        """The entity of a body's mesh, logged when it is new; None for a body that nothing shows of."""
        mesh = body_mesh(model, body, ROOM)
        if mesh is None:
            return None
        key = mesh.digest + mesh.name.encode()
        if key not in self._known:
            self._known[key] = f"{self._entity}/{mesh.name}-{len(self._known)}"
            self._stream.static(self._known[key], rr.Mesh3D(
                vertex_positions=mesh.vertices, vertex_normals=mesh.normals, vertex_colors=mesh.colours, triangle_indices=mesh.faces))
        return self._known[key]


def _layout() -> rrb.Blueprint:
    eye = rrb.EyeControls3D(position=(0.31, -0.43, 1.18), look_target=(-0.1, 0.04, 0.93), eye_up=(0.0, 0.0, 1.0))
    views = [
        rrb.Spatial3DView(origin=f"/{entity}", name=name, eye_controls=eye, background=BACKGROUND, line_grid=False)
        for entity, name in (("recorded", "Recorded hand"), ("retargeted", "Robot hand"), ("replay", "Replay in simulation"))
    ]
    return quiet_layout(rrb.Horizontal(*views), FILM)


def record_clips(path: Path, clips: Sequence[Clip]) -> None:
    """Write clips into one .rrd file.

    Raises:
        ToolkitError: the folder cannot be written.
    """
    stream = Stream(path)
    HandRecording(stream).log_clips(clips)
    stream.close()

"""Recordings of hands for the Rerun viewer: the recorded hand, the robot hand that follows it, and the replay, side by side.

    recorded/hand, recorded/object      as they were read, in the task's frame
    retargeted/<body>/<geom>            the robot's hand alone, by inverse kinematics
    retargeted/object                   the recorded object again
    replay/<body>/<geom>                what happened in simulation

All on the timeline "time" [s], one recording after the other.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from tasks.dexycb import FINGERS, JOINT_NAMES
from tasks.objects import PickObject
from toolkit.recording import Recording

PAUSE = 0.6
"""[s] between two recordings."""
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


class HandRecording(Recording):
    """Writes one .rrd file of clips."""

    def log_clips(self, clips: Sequence[Clip]) -> None:
        """Log clips one after the other on the timeline "time"."""
        start = 0.0
        for number, clip in enumerate(clips):
            ends = [self._log_recorded(clip, start)]
            first = start + clip.frame_dt * float(clip.hand_frames[0])
            ends.append(self.log_episode("retargeted", clip.hand, clip.hand_qpos, clip.frame_dt, first, number))
            ends.append(self.log_episode("replay", clip.replay, clip.replay_qpos, clip.control_dt, start, number))
            self._label("retargeted", "robot hand", clip, start)
            self._label("replay", f"replay: {clip.verdict}", clip, start)
            start = max(ends) + PAUSE
        self._stream.flush()

    def _log_recorded(self, clip: Clip, start: float) -> float:
        half = clip.item.half_size
        self._set_times(time=start)
        for entity in ("recorded/object", "retargeted/object"):
            self._stream.log(f"{entity}/box", rr.Clear(recursive=False))
            self._stream.log(f"{entity}/can", rr.Clear(recursive=False))
            if clip.item.shape == "box":
                self._stream.log(f"{entity}/box", rr.Boxes3D(half_sizes=[half], colors=[THING], fill_mode="solid"))
            else:
                can = rr.Cylinders3D(lengths=[2 * half[1]], radii=[half[0]], colors=[THING], fill_mode="solid")
                self._stream.log(f"{entity}/can", can)
        self._label("recorded", f"recorded: {clip.name}", clip, start)
        for frame, (joints, pose) in enumerate(zip(clip.joints, clip.object_poses, strict=True)):
            self._set_times(time=start + frame * clip.frame_dt)
            if np.isfinite(pose).all():
                placed = rr.Transform3D(translation=pose[:3, 3], mat3x3=pose[:3, :3])
                self._stream.log("recorded/object", placed)
                self._stream.log("retargeted/object", placed)
            if np.isfinite(joints).all():
                self._stream.log("recorded/hand/bones", rr.LineStrips3D([joints[b] for b in BONES], colors=SKELETON, radii=0.004))
                self._stream.log("recorded/hand/joints", rr.Points3D(joints, colors=SKIN, radii=0.007))
            else:
                self._stream.log("recorded/hand", rr.Clear(recursive=True))
        return start + len(clip.joints) * clip.frame_dt

    def _label(self, entity: str, text: str, clip: Clip, start: float) -> None:
        self._set_times(time=start)
        seen = clip.object_poses[np.isfinite(clip.object_poses[:, 0, 0])]
        above = seen[0, :3, 3] + (0.0, 0.0, 0.38)
        self._stream.log(f"{entity}/label", rr.Points3D([above], labels=[text], colors=(40, 40, 40), radii=0.002, show_labels=True))

    def _arrange(self) -> None:
        eye = rrb.EyeControls3D(position=(0.55, -0.55, 1.25), look_target=(-0.1, 0.03, 0.95), eye_up=(0.0, 0.0, 1.0))
        views = [
            rrb.Spatial3DView(origin=f"/{entity}", name=name, eye_controls=eye, background=(236, 239, 244), line_grid=False)
            for entity, name in (("recorded", "Recorded hand"), ("retargeted", "Robot hand"), ("replay", "Replay in simulation"))
        ]
        layout = rrb.Blueprint(
            rrb.Horizontal(*views), rrb.BlueprintPanel(state="collapsed"), rrb.SelectionPanel(state="collapsed"),
            rrb.TimePanel(state="collapsed", timeline="time"), auto_views=False,
        )  # fmt: skip
        self._stream.send_blueprint(layout)
        self._outdated = False
        self._stream.flush()


def record_clips(path: Path, clips: Sequence[Clip]) -> None:
    """Write clips into one .rrd file.

    Raises:
        ToolkitError: the folder cannot be written.
    """
    with HandRecording(path) as recording:
        recording.log_clips(clips)

"""Recordings of hands, retargeted to a robot hand and replayed on it: what an expert can learn from."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from robots.robot import Robot
from tasks.dexycb import FRAME_RATE, Recording, RecordingError, read_recording, read_vertices, sequences
from tasks.dexycb_scene import Scene, SceneError, scene_of
from tasks.pick import PickTask
from toolkit.demonstrations import Track, TrackScript
from toolkit.errors import ToolkitError
from toolkit.retargeting import HandModel, HandMotion, retarget, track_of
from toolkit.simulation.plant import CLOSING, Plant, native_plant
from toolkit.simulation.rollout import Tape, play


@dataclass(frozen=True, eq=False)
class Demonstration:
    """A recording, its pick, the robot hand that follows it, and how that went in simulation.

    Attributes:
        hand: the robot's hand alone, of which `motion.qpos` are configurations.
        succeeded: whether the replay on the unmodified robot brought the object to the recorded goal.
        steps: of the replay.
    """

    recording: Recording
    scene: Scene
    motion: HandMotion
    track: Track
    hand: mujoco.MjModel
    succeeded: bool
    steps: int

    def to_json(self) -> dict[str, Any]:
        """Figures of the retargeting; errors in millimetres."""
        error = 1e3 * self.motion.tip_error.mean(axis=1)
        return {
            "recording": self.recording.name, "object": self.recording.object, "side": self.recording.side,
            "standard": self.scene.standard, "frames": len(self.motion.frames), "tip_error_mm": float(error.mean()),
            "worst_frame_tip_error_mm": float(error.max()),
            "commanded_tip_error_mm": float(1e3 * self.motion.commanded_error.mean()),
            "infeasible_frames": list(self.motion.infeasible), "raised_m": self.motion.raised,
            "replay_succeeded": self.succeeded, "replay_steps": self.steps,
        }  # fmt: skip


@dataclass(frozen=True, eq=False)
class Trace:
    """What a replay looked like, for the viewer: the model as it was, and qpos (T + 1, nq) at every policy step."""

    model: mujoco.MjModel
    qpos: np.ndarray
    goal: np.ndarray
    success: bool


@dataclass(frozen=True)
class Dropped:
    """A recording that is whole but cannot be followed, and why."""

    recording: str
    why: str


class Studio:
    """Retargets recordings of one root to one robot.

    Args:
        root: of the recordings.
        robot: a robot with a five-fingered hand.
        frame_rate: of the recordings [Hz].

    Raises:
        ToolkitError: there is no recording under the root.
    """

    def __init__(self, root: Path, robot: Robot, frame_rate: float = FRAME_RATE) -> None:
        self.root, self.robot, self.frame_rate = Path(root), robot, frame_rate
        try:
            self.names = sequences(self.root)
        except RecordingError as error:
            raise ToolkitError(str(error)) from None
        self._plants: dict[str, Plant] = {}

    def read(self, name: str) -> Recording:
        """A recording by its name.

        Raises:
            ToolkitError: it is broken; the sentence names file and key.
        """
        try:
            return read_recording(self.root, name, self.frame_rate)
        except RecordingError as error:
            raise ToolkitError(str(error)) from None

    def scene(self, recording: Recording) -> Scene | Dropped:
        """The pick that a recording shows.

        Raises:
            ToolkitError: the object's mesh is broken.
        """
        try:
            return scene_of(recording, read_vertices(self.root, recording.object))
        except RecordingError as error:
            raise ToolkitError(str(error)) from None
        except SceneError as error:
            return Dropped(recording.name, str(error))

    def demonstration(self, recording: Recording) -> Demonstration | Dropped:
        """Retarget a recording and replay it in its own scene, where the object starts as recorded and ends at the last pose."""
        scene = self.scene(recording)
        if isinstance(scene, Dropped):
            return scene
        hand = HandModel(self.robot, scene.task.object)
        motion = retarget(hand, recording, scene)
        try:
            track = track_of(motion, recording, scene, scene.task.control_frequency)
        except ToolkitError as error:
            return Dropped(recording.name, str(error))
        plant = self._plant(scene.task)
        episode = play(plant, TrackScript(track, np.array(scene.task.goal_offset), CLOSING), 0, np.zeros(1))
        return Demonstration(recording, scene, motion, track, hand.model, episode.success, episode.steps)

    def trace(self, demonstration: Demonstration) -> Trace:
        """The replay once more, for the viewer."""
        plant = self._plant(demonstration.scene.task)
        tape = Tape(qpos=[])
        script = TrackScript(demonstration.track, np.array(demonstration.scene.task.goal_offset), CLOSING)
        episode = play(plant, script, 0, np.zeros(1), tape)
        return Trace(plant.model, np.array(tape.qpos), np.array(plant.goal), episode.success)

    def _plant(self, task: PickTask) -> Plant:
        """The robot with a task's object, whatever its goal; one per object, as compiling takes seconds."""
        key = repr(task.object)
        if key not in self._plants:
            self._plants[key] = native_plant(self.robot, task)
        self._plants[key].task = task
        return self._plants[key]


def teachers_for(
    root: Path,
    robot: Robot,
    task: PickTask,
    frame_rate: float = FRAME_RATE,
    progress: Callable[[int, int, int], None] = lambda done, total, kept: None,
) -> tuple[dict[str, TrackScript], dict[str, int]]:
    """Scripts that follow the recordings of a task's object, by their names, and counts of what became of the recordings.

    Args:
        root: of the recordings.
        robot: the source.
        task: whose object, standing as it does there, the recordings must show.
        frame_rate: of the recordings [Hz].
        progress: called with recordings done, in all, and kept.

    Raises:
        ToolkitError: a recording is broken, or none of the object can be followed.
    """
    studio = Studio(root, robot, frame_rate)
    recordings = [studio.read(name) for name in studio.names]
    mine = [recording for recording in recordings if recording.object == task.object.name]
    if not mine:
        known = sorted({recording.object for recording in recordings})
        raise ToolkitError(f"{root} has no recording of {task.object.name}; it has: {', '.join(known)}")
    kept: list[Demonstration] = []
    counts = {"recordings": len(mine), "dropped": 0, "failed_in_replay": 0}
    for done, recording in enumerate(mine, 1):
        shown = studio.demonstration(recording)
        if isinstance(shown, Dropped) or not shown.scene.standard:
            counts["dropped"] += 1
        elif not shown.succeeded:
            counts["failed_in_replay"] += 1
        else:
            kept.append(shown)
        progress(done, len(mine), len(kept))
    if not kept:
        raise ToolkitError(
            f"none of {len(mine)} recordings of {task.object.name} in {root} can be followed ({counts['failed_in_replay']} fail in "
            "replay); see why with: meta-evolve recordings retarget"
        )
    scripts = {d.recording.name: TrackScript(d.track, np.array(task.goal_offset), CLOSING) for d in kept}
    return scripts, counts | {"followed": len(kept)}

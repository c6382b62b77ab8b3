"""Recordings of hands, retargeted to a robot hand and replayed on it: what an expert can learn from."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from robots.robot import Robot
from tasks.dexycb.recording import FRAME_RATE, Recording, RecordingError, grasped_object, read_recording, read_vertices, sequences
from tasks.dexycb.scene import Scene, SceneError, scene_of
from tasks.pick import PickTask
from toolkit.demonstrations.retargeting import HandModel, HandMotion, retarget, track_of
from toolkit.demonstrations.tracks import Track, TrackScript
from toolkit.errors import ToolkitError
from toolkit.io.quoting import told
from toolkit.simulation.laws import native_plant
from toolkit.simulation.plant import CLOSING, Plant
from toolkit.simulation.rollout import play
from toolkit.simulation.watching import States


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
        }


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


@dataclass(frozen=True)
class Broken:
    """A recording that is not what the format says, and why."""

    recording: str
    why: str


class Retargeter:
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

    def object_of(self, name: str) -> str:
        """YCB name of the object that a recording is about, without reading the rest of it.

        Raises:
            ToolkitError: its meta.yml is broken.
        """
        try:
            return grasped_object(self.root, name)
        except RecordingError as error:
            raise ToolkitError(str(error)) from None

    def about(self, wanted: str | None, names: Sequence[str] = ()) -> tuple[list[str], list["Broken"], list[str]]:
        """Recordings of an object.

        Args:
            wanted: its name; None: any.
            names: to look among; none: all.

        Returns:
            names of those that are about it; those that do not say what they are about; and the objects that there are.
        """
        mine, broken, objects = [], [], set()
        for name in names or self.names:
            try:
                found = self.object_of(name)
            except ToolkitError as error:
                broken.append(Broken(name, str(error)))
                continue
            objects.add(found)
            if wanted in (None, found):
                mine.append(name)
        return mine, broken, sorted(objects)

    def demonstration_of(self, name: str) -> "Demonstration | Dropped | Broken":
        """Read, retarget and replay one recording; what is wrong with it is its own result, and no other's."""
        try:
            return self.demonstration(self.read(name))
        except ToolkitError as error:
            return Broken(name, str(error))

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
        states = States()
        script = TrackScript(demonstration.track, np.array(demonstration.scene.task.goal_offset), CLOSING)
        episode = play(plant, script, 0, np.zeros(1), states)
        return Trace(plant.model, np.array(states.qpos), np.array(plant.goal), episode.success)

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
        ToolkitError: there is no recording of the object, or none that can be followed.
    """
    retargeter = Retargeter(root, robot, frame_rate)
    mine, broken, known = retargeter.about(task.object.name)
    if not mine:
        more = f"; {len(broken)} say of no object that they are about it, the first: {broken[0].why}" if broken else ""
        raise ToolkitError(f"{root} has no recording of {task.object.name}; it has: {', '.join(known) or 'none'}{more}")
    kept: list[Demonstration] = []
    counts = {"recordings": len(mine), "broken": 0, "dropped": 0, "failed_in_replay": 0}
    for done, name in enumerate(mine, 1):
        shown = retargeter.demonstration_of(name)
        if isinstance(shown, Broken):
            counts["broken"] += 1
            broken.append(shown)
        elif isinstance(shown, Dropped) or not shown.scene.standard:
            counts["dropped"] += 1
        elif not shown.succeeded:
            counts["failed_in_replay"] += 1
        else:
            kept.append(shown)
        progress(done, len(mine), len(kept))
    if not kept:
        raise ToolkitError(
            f"none of {len(mine)} recordings of {task.object.name} in {root} can be followed ({counts['failed_in_replay']} fail in "
            f"replay, {counts['broken']} are broken{': ' + broken[-1].why if counts['broken'] else ''}); see why with: "
            + told("recordings", "retarget", root, "--object", task.object.name)
        )
    scripts = {d.recording.name: TrackScript(d.track, np.array(task.goal_offset), CLOSING) for d in kept}
    return scripts, counts | {"followed": len(kept)}

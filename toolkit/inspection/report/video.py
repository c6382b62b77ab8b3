"""A run as a video that plays anywhere: every path's robots turning into one another, then its episodes worth seeing.

MP4 with VP9, which every browser plays and which OpenCV, robosuite's own dependency, writes without a program beside it; or GIF.
"""

import textwrap
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from PIL import Image

from toolkit.errors import ToolkitError
from toolkit.inspection.report.stills import ArmRenderer, ModelRenderer, renderer_of, write_on
from toolkit.inspection.trajectory import PickTrajectory, Trajectory, replay
from toolkit.inspection.visual import Motion, Visual, visual_of
from toolkit.learning.policy import GaussianPolicy, MeanActor
from toolkit.morphology.lab import Merged
from toolkit.runs.phases import KeptEpisode, Phase, landmarks, load_phases
from toolkit.runs.run import read_report, read_untrained
from toolkit.simulation.laws import Drivable, merged_plant

SIZE = 720, 540
"""Width and height [pixels]."""
RATE = 20.0
"""Frames per second; an episode plays as fast as it was."""
LETTERS = 74
"""Of a caption, in a line."""
TURNING, REST = 3.0, 0.8
"""[s] of a path's robots turning into one another, and of a picture that stands still."""
GIF_EVERY, GIF_WIDTH = 2, 480
"""A GIF has every second picture, smaller: it is ten times larger than an MP4 otherwise."""
GIF_COLOURS, GIF_SAMPLES = 96, 24
"""Colours of a GIF's palette, and pictures that it is made from."""


def write_video(
    folder: Path, merged: Merged, tree: dict[str, Any], policy: GaussianPolicy, native: Callable[[str], Drivable], out: Path,
    progress: Callable[[str], None] = lambda what: None,
) -> float:
    """Write a run folder as a video.

    Args:
        folder: the run's; one that goes on, or was stopped, gives a video as far as it went.
        merged: its merged robot in its task.
        tree: as in tree.json.
        policy: any policy of its networks.
        native: target name -> the unmodified robot as a plant.
        out: .mp4 or .gif.
        progress: told what is being drawn.

    Returns:
        Its length [s].

    Raises:
        ToolkitError: the run keeps no episodes, nothing can be rendered here, or ``out`` cannot be written.
    """
    phases = sorted(load_phases(folder).values(), key=lambda phase: (phase.path, phase.number, phase.stage))
    if not phases:
        raise ToolkitError(f"{folder} keeps no phases to show (an older version's run, or none yet); transfer anew to have a video")
    visual = visual_of(merged)
    renderer = renderer_of(visual, SIZE, near=False)
    scenes = _scenes(_Player(folder, merged, policy, native, visual), phases, progress)
    pictures = (picture for scene in scenes for picture in _drawn(renderer, *scene))
    try:
        count = _write_gif(out, pictures) if out.suffix.lower() == ".gif" else _write_mp4(out, pictures)
    finally:
        renderer.close()
    return count / RATE


class _Player:
    """What it takes to play a run's scenes; arguments as of ``write_video``."""

    def __init__(
        self, folder: Path, merged: Merged, policy: GaussianPolicy, native: Callable[[str], Drivable], visual: Visual
    ) -> None:
        self.folder, self.merged, self.policy, self.native, self.visual = folder, merged, policy, native, visual
        self._plants: dict[str, Drivable] = {}

    def turning(self, phases: list[Phase]) -> Motion:
        """The robots of a path's phases, evenly by distance."""
        corners = np.array([phases[0].start, *(phase.start if phase.end is None else phase.end for phase in phases)])
        reach = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(corners, axis=0), axis=1))])
        spots = np.linspace(0.0, reach[-1], int(RATE * TURNING))
        alphas = np.stack([np.interp(spots, reach, corners[:, k]) for k in range(corners.shape[1])], axis=1)
        return self.visual.standing(np.clip(alphas, 0.0, 1.0))

    def episode(self, phase: Phase, kept: KeptEpisode) -> tuple[Motion, Trajectory]:
        """An episode played again: its robot, and what happened."""
        policy = phase.policy_of(kept, self.policy)
        actor = policy.act if kept.noise else MeanActor(policy)
        if phase.stage == "evolve":
            trajectory = replay(merged_plant(self.merged, kept.alpha, *self.merged.new()), actor, kept.seed, kept.alpha)
            return self.visual.playing(trajectory, kept.alpha), trajectory
        name = phase.targets[0]
        if name not in self._plants:
            self._plants[name] = self.native(name)
        trajectory = replay(self._plants[name], actor, kept.seed, kept.alpha)
        return self.visual.native(trajectory, name), trajectory


def _frames(trajectory: Trajectory) -> list[int]:
    """Which frames make an episode as fast as it was."""
    return np.arange(0.0, len(trajectory.qpos), 1.0 / (RATE * trajectory.interval)).astype(int).tolist()


Scene = tuple[Motion, np.ndarray | None, str, Iterator[int]]
"""Robots, goal or None, caption, and which of the robots' frames are shown."""


def _scenes(player: _Player, phases: list[Phase], progress: Callable[[str], None]) -> Iterator[Scene]:
    rest = [0] * int(RATE * REST)
    names = player.merged.space.names
    report = read_report(player.folder, ("targets",))
    source = player.visual.standing(player.merged.space.betas[:1])
    yield source, None, f"{names[0]}, the source, to {', '.join(names[1:])}\n{_untrained(player.folder)}", iter(rest * 3)
    every = landmarks([(phase, kept) for phase in phases for kept in phase.episodes])
    shown = [scene for scene in every if {"first", "failure", "last"} & set(scene[1].roles)]
    learned = False
    for path in dict.fromkeys(phase.path for phase in phases):
        own = [phase for phase in phases if phase.path == path]
        evolving = [phase for phase in own if phase.stage == "evolve"]
        goals = ", ".join(own[-1].targets)
        progress(f"{path}, to {goals}")
        if evolving:
            motion = player.turning(evolving)
            yield motion, None, f"{path}: the robot turns, on its way to {goals}", iter([*range(len(motion.weights)), *[-1] * len(rest)])
        for phase, kept in [scene for scene in shown if scene[0].path == path]:
            motion, trajectory = player.episode(phase, kept)
            goal = trajectory.goal if isinstance(trajectory, PickTrajectory) else None
            where = f"a robot on the way to {goals}" if phase.stage == "evolve" else f"the unmodified {phase.targets[0]}"
            learned = learned or kept.update > 0
            updates = f"{kept.update} update{'s' if kept.update > 1 else ''}"
            trained = f"after {updates} there" if kept.update else "as it came there" if learned else "untrained"
            yield motion, goal, f"{path}: {where}, {trained}\n{trajectory.verdict()}", iter([*_frames(trajectory), *[-1] * len(rest)])
    for name, both in ((report or {}).get("targets") or {}).items():
        motion = player.visual.standing(player.merged.space.beta(name)[None])
        counts = f"{both['native']['successes']} of {both['native']['episodes']} unseen starts"
        yield motion, None, f"{name}: success on {counts}, on the unmodified robot", iter(rest * 2)


def _untrained(folder: Path) -> str:
    """What the source's expert does on the targets as it is; empty where that was not measured."""
    rates = [f"{name} {one['successes']} of {one['episodes']}" for name, one in read_untrained(folder).items()]
    return f"untrained on the unmodified robots: {', '.join(rates)}" if rates else ""


def _drawn(
    renderer: ArmRenderer | ModelRenderer, motion: Motion, goal: np.ndarray | None, text: str, frames: Iterator[int]
) -> Iterator[Image.Image]:
    """A scene's pictures; one that stands still is drawn once."""
    last: tuple[int, Image.Image] | None = None
    for frame in frames:
        if last is None or last[0] != frame:
            last = frame, _captioned(renderer, motion, frame, goal, text)
        yield last[1]


def _captioned(renderer: ArmRenderer | ModelRenderer, motion: Motion, frame: int, goal: np.ndarray | None, text: str) -> Image.Image:
    picture = Image.fromarray(renderer.shot(motion, frame, goal))
    lines = [line for words in text.split("\n") for line in textwrap.wrap(words, LETTERS)]
    for line, words in enumerate(lines):
        write_on(picture, (16, 12 + 26 * line), words, 19)
    return picture


def _write_mp4(out: Path, pictures: Iterator[Image.Image]) -> int:
    """Returns how many pictures there were."""
    writer = cv2.VideoWriter(str(out), cv2.CAP_FFMPEG, cv2.VideoWriter.fourcc(*"vp09"), RATE, SIZE)
    if not writer.isOpened():
        raise ToolkitError(f"{out} cannot be written: this OpenCV writes no VP9; reinstall opencv-python, or name a .gif")
    count = 0
    try:
        for picture in pictures:
            writer.write(np.asarray(picture)[..., ::-1])
            count += 1
    finally:
        writer.release()
    if not out.is_file() or not out.stat().st_size:
        raise ToolkitError(f"{out} cannot be written; free space there, or choose another place")
    return count


def _palette(pictures: list[Image.Image]) -> Image.Image:
    """One palette for all: what does not move is then the same in every picture, which neither flickers nor costs anything."""
    chosen = pictures[:: max(1, len(pictures) // GIF_SAMPLES)]
    strip = Image.new("RGB", (sum(picture.width for picture in chosen), chosen[0].height))
    for place, picture in enumerate(chosen):
        strip.paste(picture, (place * picture.width, 0))
    return strip.quantize(GIF_COLOURS, dither=Image.Dither.NONE)


def _write_gif(out: Path, pictures: Iterator[Image.Image]) -> int:
    """Returns how many pictures there were."""
    size, count, kept = (GIF_WIDTH, round(GIF_WIDTH * SIZE[1] / SIZE[0])), 0, []
    for count, picture in enumerate(pictures, start=1):
        if count % GIF_EVERY == 1:
            kept.append(picture.resize(size))
    palette = _palette(kept)
    small = [picture.quantize(palette=palette, dither=Image.Dither.NONE) for picture in kept]
    try:
        small[0].save(out, save_all=True, append_images=small[1:], duration=round(1000 * GIF_EVERY / RATE), loop=0, optimize=True)
    except OSError as error:
        raise ToolkitError(f"{out} cannot be written ({error.strerror or error}); free space there, or choose another place") from None
    return count

"""A run as a recording: its records one by one, with what its phases left in the run folder.

The same recorder serves while the run goes on, when a run folder is rebuilt, and for a viewer that follows a running one.
"""

import time
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from toolkit.errors import ToolkitError
from toolkit.inspection.drawn_tree import Plan
from toolkit.inspection.recording.evolution import EvolutionPage, Extent, alpha_extent, evolution_views
from toolkit.inspection.recording.layout import Eye, page_timeline, pages_layout
from toolkit.inspection.recording.learning import LearningPage, learning_views
from toolkit.inspection.recording.rollouts import RolloutsPage, rollouts_views
from toolkit.inspection.recording.scene import Scene, scene_views
from toolkit.inspection.recording.stream import Stream
from toolkit.inspection.trajectory import replay
from toolkit.inspection.visual import visual_of
from toolkit.io.quoting import markdown, told
from toolkit.learning.policy import GaussianPolicy, MeanActor
from toolkit.morphology.lab import Merged
from toolkit.runs.phases import FOLDER, KeptEpisode, Phase, landmarks, load_phase
from toolkit.simulation.laws import Drivable, merged_plant

MORPH_RATE = 20.0
"""Frames per second of the film while a robot turns into another."""
MORPH_SECONDS = 2.0
PAUSE = 0.4
"""[s] between two scenes of the film."""
SHARE = 0.03
"""Of a running transfer's wall time that logging may take. At its end the landmarks are drawn all the same; the rest is left to a
rebuild."""
SIZE_LIMIT = 170e6
"""[bytes] from which on no more episodes are drawn, so that a recording stays under 200 MB."""


@dataclass
class Cost:
    """What a recording has cost: seconds of work, of wall time; bytes of file; films drawn, and films that the phases hold, of a run."""

    seconds: float = 0.0
    wall: float = 0.0
    size: int = 0
    drawn: int = 0
    known: int = 0
    run: Path = Path("RUN")

    def __str__(self) -> str:
        left = "" if self.drawn == self.known else f"; play the rest with: {told('view', self.run, '--rebuild')}"
        return (f"recording: {self.size / 1e6:.1f} MB, {self.seconds:.1f} s of logging ({self.seconds / max(self.wall, 1e-9):.1%} of "
                f"{self.wall:.0f} s), {self.drawn} of {self.known} episodes{left}")


def begin_recording(
    folder: Path, merged: Merged, tree: dict[str, Any], policy: GaussianPolicy, native: Callable[[str], Drivable],
    records: Sequence[dict[str, Any]],
) -> "RunRecorder":
    """The recording of a run that goes on, into its folder; the arguments are those of ``RunRecorder``."""
    return RunRecorder(Stream(folder / "recording.rrd"), folder, merged, tree, policy, native, SHARE, records)


class RunRecorder:
    """Tells a run.

    Args:
        stream: where to.
        folder: the run folder; its phases are read when their records come.
        merged: the run's merged robot in its task.
        tree: as in tree.json.
        policy: any policy of the run's networks.
        native: target name -> the unmodified robot as a plant (made when first needed).
        share: of the wall time that the story may take; None: all it wants.
        records: of metrics.jsonl that are there already; they are told at once.
    """

    def __init__(
        self,
        stream: Stream,
        folder: Path,
        merged: Merged,
        tree: dict[str, Any],
        policy: GaussianPolicy,
        native: Callable[[str], Drivable] | None = None,
        share: float | None = None,
        records: Sequence[dict[str, Any]] = (),
    ) -> None:
        self._began = self._busy_since = time.perf_counter()
        self.cost = Cost(run=folder)
        self.stream, self.folder, self.merged, self.policy, self.share = stream, folder, merged, policy, share
        self._native = native
        self._plants: dict[str, Drivable] = {}
        self.clock, self.iteration = 0.0, 0
        self._paths: dict[str, dict[str, Any]] = {}  # path -> targets, phases ended, last success
        self._waiting: list[tuple[Phase, KeptEpisode]] = []
        self._known: list[tuple[Phase, KeptEpisode]] = []
        self._shown: set[str] = set()  # names of phases
        self._longest = 0.0
        self._visual = visual_of(merged)
        self.plan = Plan(tree)
        self.evolution = EvolutionPage(stream, self.plan, merged.space)
        told = dict.fromkeys(record["path"] for record in records)
        older = not all(path.startswith("path 1") for path in told)  # paths were counted in the order of play: the plan has other names
        self.learning = LearningPage(stream, list(told if older else dict.fromkeys([*self.plan.paths, *told])))
        self.rollouts = RolloutsPage(stream, merged)
        self.scene = Scene(stream, self._visual, self.rollouts.tolerance)
        self.summary("The run goes on; this page fills when it ends.")
        framing = self._visual.framing
        stream.arrange(run_layout(self.plan, alpha_extent(merged.space), (framing.whole, framing.near), self.rollouts.pick))
        source = next(name for name, node in self.plan.nodes.items() if node["kind"] == "source")
        self._targets = [name for name, node in self.plan.nodes.items() if node["kind"] == "target"]
        start = np.array(self.plan.nodes[source]["alpha"])
        self._stand(np.array([0.0]), start[None], self._targets, source)
        self.rollouts.caption(0.0, 0, f"**{markdown(source)}**, the source robot.")
        self.clock = 1.0
        self._rest()
        for record in records:
            self.tell(record)

    def tell(self, record: dict[str, Any]) -> None:
        """One record of metrics.jsonl, in order. Unknown events only move the curves on."""
        self._busy_since = time.perf_counter()
        self.iteration += 1
        path = record["path"]
        state = self._paths.setdefault(path, {"targets": self._targets, "ended": 0, "success": None})
        if record["event"] == "split":
            state["targets"] = record["targets"].split()
            parent = self._paths.get(record.get("parent", ""), {})
            state["success"] = parent.get("success")
        if record["event"] == "check" or (record["event"] == "look" and record["held"]):
            state["success"] = record["success"]
        self.learning.add(self.iteration, record)
        if record["event"] in ("moved", "arrived"):
            before = self.clock
            self._end_phase(path, state, "evolve")
            if record["event"] == "arrived":
                self._end_phase(path, state, "settle")
            state["ended"] += record["event"] == "moved"
            self.learning.repeat(before, self.clock + PAUSE)
            self.clock += PAUSE
            self._play_waiting()
        self.stream.flush()
        self._rest()

    def summary(self, text: str) -> None:
        """The run in words [Markdown]."""
        self.stream.static("summary", rr.TextDocument(text, media_type=rr.MediaType.MARKDOWN))

    def finish(self) -> Cost:
        """Show where the run stands, play what is still allowed, close the recording, and say what it cost."""
        self._busy_since = time.perf_counter()
        self._show_going()
        self._play_waiting()
        self._play_landmarks()
        self.learning.repeat(self.clock, self.clock + 1.0)
        self.stream.close()
        self.cost.size = self.stream.path.stat().st_size if self.stream.path is not None else 0
        self._rest()
        return self.cost

    def _spent(self) -> float:
        """[s] of work so far, the call that is going on included."""
        return self.cost.seconds + time.perf_counter() - self._busy_since

    def _rest(self) -> None:
        self.cost.seconds = self._spent()
        self.cost.wall = time.perf_counter() - self._began

    # ---- scenes -----------------------------------------------------------------------------------------------

    def _end_phase(self, path: str, state: dict[str, Any], stage: str) -> None:
        """The robot has moved on: show the way, then queue the episodes worth seeing."""
        name = f"{path.replace(' ', '-')}-{state['ended']:03d}-{stage}"
        try:
            phase = load_phase(self.folder / FOLDER / f"{name}.safetensors")
        except ToolkitError:
            return  # a run of an older version, or a folder without its phases: the curves still tell the run
        self._show_phase(phase, path, state["success"])

    def _show_going(self) -> None:
        """Phases that have not ended: in a run that goes on, or was stopped, they hold what it is stuck on."""
        for path, state in self._paths.items():
            for file in sorted((self.folder / FOLDER).glob(f"{path.replace(' ', '-')}-*.safetensors")):
                if file.stem not in self._shown:
                    try:
                        self._show_phase(load_phase(file), path, state["success"])
                    except ToolkitError:
                        continue  # cut off with the process that wrote it

    def append(self, phase: Phase) -> None:
        """A phase that no record tells of."""
        self._busy_since = time.perf_counter()
        self._show_phase(phase, phase.path, None)
        self._play_waiting()
        self._rest()

    def _show_phase(self, phase: Phase, path: str, success: float | None) -> None:
        self._shown.add(phase.name)
        end = phase.start if phase.end is None else phase.end
        if not np.array_equal(phase.start, end):
            count = max(2, int(MORPH_RATE * MORPH_SECONDS))
            times = self.clock + np.arange(count) / MORPH_RATE
            alphas = phase.start + np.linspace(0.0, 1.0, count)[:, None] * (end - phase.start)
            self._stand(times, alphas, phase.targets, f"{path}, phase {phase.number}")
            self.rollouts.caption(float(times[0]), self.iteration, f"**{markdown(path)}**, phase {phase.number}: the robot moves on.")
            self.clock = float(times[-1]) + PAUSE
        self.evolution.walked(self.clock, self.iteration, phase.start, end, phase.targets, success)
        self._known += [(phase, kept) for kept in phase.episodes]
        self._waiting += [(phase, kept) for kept in sorted(phase.episodes, key=_priority if self.share is not None else _in_order)]
        self.cost.known += len(phase.episodes)

    def _stand(self, times: np.ndarray, alphas: np.ndarray, targets: list[str], label: str) -> None:
        self.scene.clear_act(float(times[0]), self.iteration)
        self.scene.show(times, self.iteration, [self._visual.standing(alphas)])
        self.scene.label(float(times[0]), self.iteration, [label])
        self.evolution.visit(times, self.iteration, alphas, targets)

    def _play_waiting(self) -> None:
        """Films, as far as the share of the wall time and the size allow."""
        while self._waiting:
            allowed = np.inf if self.share is None else self.share * (time.perf_counter() - self._began)
            if self._spent() + 1.5 * self._longest > allowed:
                return
            if self.stream.path is not None and self.stream.path.stat().st_size > SIZE_LIMIT:
                return
            before = self._spent()
            self._play(*self._waiting.pop(0))
            self._longest = max(self._longest, self._spent() - before)

    def _play_landmarks(self) -> None:
        """Whatever the share: every path has something to watch, also of a run that was too quick to draw while it went on."""
        waiting = {id(kept) for _, kept in self._waiting}
        for phase, kept in landmarks(self._known):
            if id(kept) in waiting and (self.stream.path is None or self.stream.path.stat().st_size <= SIZE_LIMIT):
                self._play(phase, kept)

    def _play(self, phase: Phase, kept: KeptEpisode) -> None:
        plant = self._plant(phase, kept)
        if plant is None:
            return
        policy = phase.policy_of(kept, self.policy)
        actor = policy.act if kept.noise else MeanActor(policy)
        trajectory = replay(plant, actor, kept.seed, kept.alpha)
        times = self.clock + trajectory.interval * np.arange(len(trajectory.qpos))
        evolving = phase.stage == "evolve"
        motion = self._visual.playing(trajectory, kept.alpha) if evolving else self._visual.native(trajectory, phase.targets[0])
        self.scene.show(times, self.iteration, [motion])
        self.scene.act(times, self.iteration, [trajectory])
        self.scene.label(float(times[0]), self.iteration, [f"{phase.path}, phase {phase.number}: {', '.join(kept.roles)}"])
        self.rollouts.act(times, self.iteration, trajectory)
        self.rollouts.caption(float(times[0]), self.iteration, self._caption(phase, kept, trajectory.verdict()))
        self.evolution.visit(times[:1], self.iteration, kept.alpha[None], phase.targets)
        self.clock = float(times[-1]) + PAUSE
        self.cost.drawn += 1

    def _plant(self, phase: Phase, kept: KeptEpisode) -> Drivable | None:
        if phase.stage == "evolve":
            return merged_plant(self.merged, kept.alpha, *self.merged.new())
        if self._native is None:
            return None
        name = phase.targets[0]
        if name not in self._plants:
            self._plants[name] = self._native(name)
        return self._plants[name]

    def _caption(self, phase: Phase, kept: KeptEpisode, verdict: str) -> str:
        edge = self.plan.way_of(phase.targets, kept.alpha)
        where = markdown(", ".join(phase.targets))
        if edge:
            where = f"{self.plan.fraction(edge, kept.alpha):.0%} of {markdown(edge['from'])} to {markdown(edge['to'])}"
        robot = f"F(alpha) at {where}" if phase.stage == "evolve" else f"the unmodified {markdown(phase.targets[0])}"
        played = f"exploring, after {kept.update} updates" if kept.noise else "without noise"
        return (f"**{markdown(phase.path)}, phase {phase.number} ({markdown(phase.stage)})**: {', '.join(kept.roles)} episode on {robot}, "
                f"seed {kept.seed}, {played}.\n\n**{verdict[0].upper()}{verdict[1:]}.**")


def run_layout(
    plan: Plan, extent: Extent | None, eyes: tuple[Eye, Eye], pick: bool, page: str | None = None, excerpt: bool = False,
    flat: Collection[str] = (),
) -> rrb.Blueprint:
    """The layout of a run's recording: all pages, or one alone on the timeline on which it reads best, or of an excerpt.

    Args:
        plan: of its tree.
        extent: of its heat map.
        eyes: from where one looks at the scene, and at the robot.
        pick: whether it is a pick.
        page: one of PAGES; None: all.
        excerpt: of one.
        flat: curves in whose place a sentence stands.
    """

    def views() -> dict[str, rrb.View]:
        own = scene_views(eyes, pick) | {"summary": rrb.TextDocumentView(origin="summary", name="Summary")}
        return evolution_views(plan, extent) | learning_views(flat) | rollouts_views(whole=excerpt, pick=pick) | own

    return pages_layout(views, page, page_timeline(page))


def _priority(kept: KeptEpisode) -> tuple[int, int]:
    """A running transfer shows failures first, and as few episodes as possible of what works."""
    order = ("failure", "last", "worst", "first", "best")
    return min(order.index(role) for role in kept.roles), kept.update


def _in_order(kept: KeptEpisode) -> int:
    return kept.update


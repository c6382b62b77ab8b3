"""Whole recordings: a run rebuilt from its folder, a running one followed, a morph, two robots side by side."""

import os
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import rerun.blueprint as rrb

from tasks.pick import PickTask
from toolkit.errors import ToolkitError
from toolkit.inspection.drawn_tree import Plan
from toolkit.inspection.recording.evolution import EvolutionPage, alpha_extent, evolution_views, recorded_extent
from toolkit.inspection.recording.layout import Layout, pages_layout, quiet_layout, robot_view
from toolkit.inspection.recording.learning import flat_curves
from toolkit.inspection.recording.recorder import Cost, RunRecorder, run_layout
from toolkit.inspection.recording.rollouts import RolloutsPage, recorded_pick, rollouts_views
from toolkit.inspection.recording.scene import Scene, recorded_framing, scene_views
from toolkit.inspection.recording.stream import FILM, Stream
from toolkit.inspection.recording.viewer import chunks_of
from toolkit.inspection.trajectory import Trajectory, replay
from toolkit.inspection.visual import AT_THE_TABLE, Framing, visual_of
from toolkit.io.quoting import markdown
from toolkit.learning.policy import GaussianPolicy, MeanActor
from toolkit.morphology.lab import Merged
from toolkit.runs.phases import KeptEpisode, Phase
from toolkit.runs.run import Run, continuing, read_tree, transfer_records
from toolkit.runs.seeds import CHECKING_SEEDS
from toolkit.simulation.laws import Drivable

POLL = 1.0
"""[s] between two looks at a running transfer's folder."""


@dataclass(frozen=True)
class StoredRun:
    """What it takes to play a run again.

    Attributes:
        folder: the run's.
        merged: its merged robot in its task.
        policy: any policy of its networks.
        native: target name -> the unmodified robot as a plant.
        trained: target name -> final policy, of the targets that are reached.
    """

    folder: Path
    merged: Merged
    policy: GaussianPolicy
    native: Callable[[str], Drivable]
    trained: dict[str, GaussianPolicy]

    def tree(self) -> dict[str, Any]:
        """The evolution tree of the run folder.

        Raises:
            ToolkitError: it is missing, damaged, or was made in another evolution space.
        """
        tree = read_tree(self.folder)
        sizes = {len(node["alpha"]) for node in tree["nodes"]}
        if sizes != {self.merged.space.size}:
            raise ToolkitError(
                f"{self.folder / 'tree.json'} has {', '.join(map(str, sorted(sizes)))} evolution dimensions, today's robots "
                f"{self.merged.space.size}: the run is of another version; look at its recording without --rebuild"
            )
        return tree


def rebuild(stored: StoredRun, out: Path | None = None) -> Cost:
    """Make a run's recording anew, from the run folder alone.

    Args:
        stored: the run.
        out: the file; default: the run's recording.rrd, replaced when the new one is whole.
    """
    path = out or stored.folder / "recording.rrd"
    temporary = path.with_name(f".{path.stem}.new.rrd")
    tree = stored.tree()
    run = Run.open(stored.folder)
    records = transfer_records(run)
    recorder = RunRecorder(Stream(temporary), stored.folder, stored.merged, tree, stored.policy, stored.native, records=records)
    if recorder.cost.known == 0:
        for phase in _last_phases(stored):
            recorder.append(phase)
    recorder.summary(_summary(stored.folder, records))
    cost = recorder.finish()
    os.replace(temporary, path)
    return cost


def page_layout(folder: Path, recording: Path, page: str | None, excerpt: bool = False) -> rrb.Blueprint:
    """The layout of one page alone, or of all, to be opened with a run's recording, or with an excerpt of it."""
    chunks = list(chunks_of(recording))
    eyes = recorded_framing(chunks) or (AT_THE_TABLE.whole, AT_THE_TABLE.near)
    return run_layout(Plan(read_tree(folder)), recorded_extent(chunks), eyes, recorded_pick(chunks), page, excerpt, flat_curves(chunks))


def follow(stored: StoredRun, viewer: str, until: Callable[[], bool] = lambda: False) -> None:
    """Tell a running transfer to a viewer, record by record, until it has its report.

    Args:
        stored: the run.
        viewer: address of a viewer's proxy.
        until: asked between two looks; True ends it.
    """
    recorder = RunRecorder(Stream(viewer), stored.folder, stored.merged, stored.tree(), stored.policy, stored.native)
    told = 0
    while not until():
        records = transfer_records(Run.open(stored.folder))
        for record in records[told:]:
            recorder.tell(record)
        told = max(told, len(records))  # a resumed transfer drops records, and writes the very same again
        if (stored.folder / "report.json").exists():
            recorder.summary(_summary(stored.folder, records))
            break
        time.sleep(POLL)
    recorder.finish()


def morph(merged: Merged, source: str, targets: Sequence[str], path: Path, tree: dict[str, Any], frames: int = 60) -> None:
    """The source turning into each target along the tree, without any policy.

    Args:
        merged: of the source and its targets.
        source, targets: names.
        path: the .rrd file.
        tree: as in tree.json.
        frames: per target.
    """
    stream = Stream(path)
    visual, plan = visual_of(merged), Plan(tree)
    page, scene = EvolutionPage(stream, plan, merged.space), Scene(stream, visual)
    eyes, pick = (visual.framing.whole, visual.framing.near), isinstance(merged.task, PickTask)
    stream.arrange(pages_layout(lambda: scene_views(eyes, pick) | evolution_views(plan, alpha_extent(merged.space)), "morph"))
    clock = 0.0
    for number, target in enumerate(targets):
        alphas = _along(plan, source, target, frames)
        times = clock + np.arange(frames) / 20.0
        iterations = number * frames
        scene.show(times, iterations, [visual.standing(alphas)])
        scene.label(clock, iterations, [f"{source} to {target}"])
        edges = _edges_to(plan, source, target)
        for edge in edges:
            own = [k for k, alpha in enumerate(alphas) if _nearest(plan, edges, alpha) is edge]
            if own:
                page.visit(times[own], iterations, alphas[own], sorted(plan.below[edge["to"]]))
        clock = float(times[-1]) + 1.0
    stream.close()


def compare(sides: Sequence[tuple[str, StoredRun, str]], path: Path, seed: int) -> tuple[list[Trajectory], Layout]:
    """The final policies of two targets, or of two runs, side by side in one scene, from the same seed on the unmodified robots.

    Args:
        sides: (label, run, target) of each; the first run's merged robot knows all targets.
        path: the .rrd file.
        seed: of the start.

    Returns:
        What was played, and the recording's layout.
    """
    merged = sides[0][1].merged
    stream = Stream(path)
    visual = visual_of(merged)
    middle = (len(sides) - 1) / 2
    offsets = [np.array([0.0, visual.framing.apart * (k - middle), 0.0]) for k in range(len(sides))]
    pages = [RolloutsPage(stream, merged, _side(k)) for k in range(len(sides))]
    scene = Scene(stream, visual, pages[0].tolerance, offsets)
    trajectories, motions = [], []
    for _, stored, target in sides:
        if target not in stored.trained:
            raise ToolkitError(f"{stored.folder} has no policy for {target!r} yet; it has: {', '.join(stored.trained) or 'none'}")
        policy, beta = stored.trained[target], merged.space.beta(target)
        trajectory = replay(stored.native(target), MeanActor(policy), seed, beta)
        trajectories.append(trajectory)
        motions.append(visual.native(trajectory, target))
    layout = partial(_compare_layout, [label for label, _, _ in sides], visual.framing, pages[0].pick)
    stream.arrange(layout(False))
    times = trajectories[0].interval * np.arange(max(len(trajectory.qpos) for trajectory in trajectories))
    scene.show(times, 0, motions)
    scene.act(times, 0, trajectories)
    scene.label(0.0, 0, [f"{label}: {trajectory.verdict()}" for (label, _, _), trajectory in zip(sides, trajectories, strict=True)])
    for page, (label, _, _), trajectory in zip(pages, sides, trajectories, strict=True):
        page.act(times[: len(trajectory.qpos)], 0, trajectory)
        page.caption(0.0, 0, f"**{markdown(label)}**, seed {seed}, without noise: **{trajectory.verdict()}.**")
    stream.close()
    return trajectories, layout


def _compare_layout(labels: Sequence[str], framing: Framing, pick: bool, excerpt: bool) -> rrb.Blueprint:
    """The layout of a comparison, or of an excerpt of one."""
    views = [rollouts_views(_side(k), excerpt, pick) for k in range(len(labels))]
    curves = ("distance", "position", "grip") if pick else ("joints", "action", "reward")
    columns = [rrb.Vertical(view["caption"], *(view[key] for key in curves), row_shares=[1, 2, 2, 2], name=label)
               for label, view in zip(labels, views, strict=True)]
    scene = robot_view("Side by side, same seed: " + " | ".join(labels), framing.beside)
    return quiet_layout(rrb.Vertical(scene, rrb.Horizontal(*columns), row_shares=[6, 5]), FILM)


def _side(k: int) -> str:
    return f"side-{k + 1}"


def _last_phases(stored: StoredRun) -> Iterator[Phase]:
    """For a run without phases (an older version's): the straight way to each target, and two episodes at its end."""
    source = stored.merged.space.betas[0]
    for name, policy in stored.trained.items():
        beta = stored.merged.space.beta(name)
        layers = policy.layers()
        network = {"parameters": policy.parameters, "shift": np.array(layers.shift), "scale": np.array(layers.scale)}
        episodes = [KeptEpisode(CHECKING_SEEDS + k, False, False, False, 0, 0.0, 0, 0, beta, [role])
                    for k, role in enumerate(("first", "last"))]
        yield Phase(f"to {name}", 0, "evolve", [name], source, beta, [network], episodes)


def _summary(folder: Path, records: list[dict[str, Any]]) -> str:
    if (folder / "summary.md").exists():
        return (folder / "summary.md").read_text(encoding="utf-8", errors="replace")
    arrived = [record["target"] for record in records if record["event"] == "arrived"]
    return (f"The run goes on, or was stopped: {len(records)} records; targets reached: {markdown(', '.join(arrived)) or 'none yet'}. "
            f"Continue it with `{continuing(folder)}`.")


def _edges_to(plan: Plan, source: str, target: str) -> list[dict[str, Any]]:
    into = {edge["to"]: edge for edge in plan.edges}
    way, node = [], target
    while node in into and node != source:
        way.append(into[node])
        node = into[node]["from"]
    return way[::-1]


def _along(plan: Plan, source: str, target: str, frames: int) -> np.ndarray:
    """(frames, D) robots on the way from the source to a target along the tree, evenly by L2 distance."""
    names = [source, *(edge["to"] for edge in _edges_to(plan, source, target))]
    corners = np.array([plan.nodes[name]["alpha"] for name in names], float)
    reach = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(corners, axis=0), axis=1))])
    spots = np.linspace(0.0, reach[-1], frames)
    return np.clip(np.stack([np.interp(spots, reach, corners[:, k]) for k in range(corners.shape[1])], axis=1), 0.0, 1.0)


def _nearest(plan: Plan, edges: list[dict[str, Any]], alpha: np.ndarray) -> dict[str, Any]:
    """The edge of a way on which a robot alpha (D,) lies."""

    def detour(edge: dict[str, Any]) -> float:
        start, end = (np.array(plan.nodes[edge[key]]["alpha"]) for key in ("from", "to"))
        return float(np.linalg.norm(alpha - start) + np.linalg.norm(end - alpha) - np.linalg.norm(end - start))

    return min(edges, key=detour)


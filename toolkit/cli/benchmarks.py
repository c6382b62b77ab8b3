"""bench: the commands that measure the toolkit itself."""

from dataclasses import asdict
from pathlib import Path

import tyro

from toolkit.cli.names import TARGETS, TASK, Kind, Metric, make_lab
from toolkit.cli.terminal import Progress, emit, table
from toolkit.errors import ToolkitError

bench = tyro.extras.SubcommandApp()


@bench.command(name="walk")
def bench_walk(
    source: str = "adroit",
    targets: tuple[str, ...] = TARGETS,
    task: str = TASK,
    kind: Kind = "steiner",
    metric: Metric = "l1",
    steps: int = 10,
    episodes: int = 16,
    plot: Path | None = None,
    json: bool = False,
) -> None:
    """Walk the evolution tree with the source expert, untrained, and measure where it breaks.

    Args:
        source: the robot that the expert was trained on.
        targets: where the tree leads.
        task: what the expert does.
        kind: evolution tree: steiner, geometric-median or independent paths.
        metric: distance between robots.
        steps: parts of every edge.
        episodes: per robot.
        plot: draw success along every edge into this file (PNG, PDF or SVG).
        json: print one JSON object.
    """
    if steps < 1 or episodes < 1:
        raise ToolkitError(f"steps is {steps} and episodes {episodes}; give at least one of each")
    lab = make_lab(source, targets, task)
    from toolkit.evaluation import walk
    from toolkit.expert import load_expert
    from toolkit.simulation.rollout import RolloutEngine

    policy, _ = load_expert(source, task)
    tree = lab.tree(metric, kind)
    total = len(tree.edges) * (steps + 1)
    found = []
    with Progress("walk", quiet=json) as progress:
        for waypoint in walk(policy, RolloutEngine(lab.merged), tree, steps, episodes):
            found.append(waypoint)
            progress.show(f"{waypoint.start} to {waypoint.end}", f"{waypoint.successes} of {episodes}", len(found), total)
    if plot is not None:
        from toolkit.results import plot_walk

        plot_walk(found, plot)
    if json:
        emit({"source": source, "task": task, "kind": kind, "metric": metric, "waypoints": [asdict(w) for w in found]}, True, "")
        return
    table(f"{source}'s expert along the tree", ["from", "to", "share", "successes", "diverged"],
          [[w.start, w.end, f"{w.share:.2f}", f"{w.successes} of {w.episodes}", w.diverged] for w in found])  # fmt: skip

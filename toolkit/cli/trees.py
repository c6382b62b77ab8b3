"""tree: the shortest way from the source to all targets."""

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

from toolkit.cli.names import TARGETS, TASK, Kind, Metric, find_arm, find_pick, find_robot, find_task
from toolkit.cli.terminal import emit, room_for, table
from toolkit.errors import ToolkitError

if TYPE_CHECKING:
    from toolkit.evolution import EvolutionTree


def tree(
    source: str = "adroit",
    targets: tuple[str, ...] = TARGETS,
    task: str = TASK,
    points: Path | None = None,
    metric: Metric = "l1",
    kind: Kind = "steiner",
    arms: bool = False,
    growth: bool = False,
    effort: float = 1.0,
    plot: Path | None = None,
    json: bool = False,
) -> None:
    """Find the evolution tree: the shortest way from the source to all targets, with its meta robots.

    Args:
        source: the robot that the expert was trained on.
        targets: where the policy should go.
        task: in whose scene robots stand that are changes of one model, as ant-maze; of arms with grippers the tree is the same in all.
        points: read source and targets from a JSON file instead: {"source": {"name", "alpha"}, "targets": [...]}.
        metric: distance between robots.
        kind: steiner (shortest tree), geometric-median (one meta robot) or independent (one path per target).
        arms: also compare the source's hand on every arm among the targets, and suggest the one whose tree is shortest.
        growth: also show how the tree grows as the targets join one by one.
        effort: how long to search and prove; 1 suits a replan, 20 takes up to half a minute with 11 to 20 robots.
        plot: draw the tree and its table into this file (PNG, PDF or SVG).
        json: print one JSON object.
    """
    if arms and points is not None:
        raise ToolkitError("--arms needs robots with arms, which a points file does not have; leave out --points or --arms")
    room_for(plot)
    from toolkit.evolution import evolution_tree, load_points, plot_tree

    more = {}
    if points is not None:
        start, goals = load_points(points)
    else:
        systems = [find_robot(name) for name in (source, *targets)]
        what = find_pick(task) if arms else find_task(task)
        from toolkit.morphology.lab import check_players, check_roles
        from toolkit.morphology.survey import as_points, compare_arms

        check_roles(systems[0], systems[1:])
        check_players(systems, what)
        start, *others = as_points(systems, what)
        goals = tuple(others)
        if arms:
            first, *more_arms = (find_arm(name) for name in (source, *targets))
            more["arms"] = [asdict(cost) for cost in compare_arms(first, more_arms, metric)]
    found = evolution_tree(start, goals, metric, kind, effort)
    if growth:
        from toolkit.morphology.survey import growth as grown

        more["growth"] = [asdict(cost) for cost in grown(start, goals, metric)]
    if json:
        emit(found.to_json() | more, True, "")
    else:
        _show(found, more, kind, metric)
    if plot is not None:  # last: the tree is found, whatever becomes of its picture
        plot_tree(found, plot)


def _show(found: "EvolutionTree", more: dict, kind: str, metric: str) -> None:
    """A tree for people, and what was asked for besides."""
    names = [node.name for node in found.nodes]
    table(f"{kind} tree, {metric.upper()}", ["from", "to", "length"],
           [[names[e.start], names[e.end], f"{e.length:.2f}"] for e in found.edges])
    proof = "proven shortest of its kind" if found.optimal else f"no tree is shorter than {found.lower_bound:.2f}"
    print(f"Length {found.length:.2f} ({proof}); independent paths {found.independent_length:.2f}; "
          f"ratio {found.ratio:.2f}, the saving that the tree promises.")
    columns = ["length", "independent paths", "ratio", "proven"]
    numbers = lambda c: [f"{c['length']:.2f}", f"{c['independent_length']:.2f}", f"{c['ratio']:.2f}", "yes" if c["optimal"] else "no"]  # noqa: E731
    if "growth" in more:
        table("Targets joining one by one", ["with", *columns], [[c["targets"][-1], *numbers(c)] for c in more["growth"]])
    if "arms" in more:
        best = more["arms"][0]
        table("The hand on other arms", ["arm", *columns], [[c["arm"], *numbers(c)] for c in more["arms"]])
        print(f"The best arm for the source is {best['arm']}: the tree to these targets is shortest from there.")

"""tree: the shortest way from the source to all targets."""

from pathlib import Path

from toolkit.cli.names import TARGETS, TASK, Kind, Metric, make_lab
from toolkit.cli.terminal import emit, table


def tree(
    source: str = "adroit",
    targets: tuple[str, ...] = TARGETS,
    points: Path | None = None,
    metric: Metric = "l1",
    kind: Kind = "steiner",
    plot: Path | None = None,
    json: bool = False,
) -> None:
    """Find the evolution tree: the shortest way from the source to all targets, with its meta robots.

    Args:
        source: the robot that the expert was trained on.
        targets: where the policy should go.
        points: read source and targets from a JSON file instead: {"source": {"name", "alpha"}, "targets": [...]}.
        metric: distance between robots.
        kind: steiner (shortest tree), geometric-median (one meta robot) or independent (one path per target).
        plot: draw the tree into this file (PNG, PDF or SVG).
        json: print one JSON object.
    """
    from toolkit.evolution import evolution_tree, load_points, plot_tree

    if points is not None:
        start, goals = load_points(points)
        found = evolution_tree(start, goals, metric, kind)
    else:
        found = make_lab(source, targets, TASK).tree(metric, kind)
    if plot is not None:
        plot_tree(found, plot)
    if json:
        emit(found.to_json(), True, "")
        return
    names = [node.name for node in found.nodes]
    table(f"{kind} tree, {metric.upper()}", ["from", "to", "length"],
           [[names[e.start], names[e.end], f"{e.length:.2f}"] for e in found.edges])  # fmt: skip
    proof = "proven shortest" if found.optimal else f"no tree is shorter than {found.lower_bound:.2f}"
    print(f"Length {found.length:.2f} ({proof}); independent paths {found.independent_length:.2f}; "
          f"ratio {found.ratio:.2f}, the saving that the tree promises.")  # fmt: skip

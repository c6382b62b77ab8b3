"""audit: whether robots between two robots can do what the two can."""

from pathlib import Path

from toolkit.cli.inspection import stored_run
from toolkit.cli.names import TARGETS, TASK, Kind, Metric, find_pick, make_lab, merged_arms, transfer_config
from toolkit.cli.terminal import Progress, emit, table
from toolkit.errors import ToolkitError


def audit(
    source: str = "adroit",
    targets: tuple[str, ...] = TARGETS,
    task: str = TASK,
    kind: Kind = "steiner",
    metric: Metric = "l1",
    run: Path | None = None,
    pairs: int | None = None,
    seed: int = 0,
    robots: int = 17,
    episodes: int = 4,
    bend: bool = True,
    tries: int = 160,
    causes: bool = True,
    plot: Path | None = None,
    json: bool = False,
) -> None:
    """Measure what the robots along the evolution tree can do, without any policy, and whether it changes evenly.

    A policy cannot be taken through robots that cannot grip. Every edge is measured at evenly spaced robots and where it looks
    worst: grip, balance, height, opening, closing time, reach, clearance, how the arm follows, and whether a script holds. A
    robot that is worse than both ends of its edge is named, with the element and the quantities that make it so.

    Args:
        source: the robot that the expert was trained on.
        targets: where the tree leads.
        task: what lies on the table; its object's width is what is gripped.
        kind: evolution tree: steiner, geometric-median or independent paths.
        metric: distance between robots.
        run: audit the tree of this run instead.
        pairs: in place of the edges, audit the straight ways between so many random pairs of robots on the tree.
        seed: of the pairs.
        robots: evenly spaced per edge, its ends included.
        episodes: of the script, per grasp, on every fourth robot; 0: no script.
        bend: where a straight edge leads through worse robots, let it turn as a transfer does, so that some digits go first, or as a
            search finds it; it is no longer in L1. --no-bend audits straight edges only.
        tries: turns that are searched at random for an edge that no digits' going first mends, a second each, and then three times as
            many group by group of its parameters; 0: none.
        causes: ask what is to blame for the worst of each kind.
        plot: draw the audit into this file (PNG, PDF or SVG).
        json: print one JSON object.
    """
    if robots < 2 or episodes < 0:
        raise ToolkitError(f"an audit needs 2 robots per edge or more, and 0 episodes or more; got {robots} and {episodes}")
    if tries < 0:
        raise ToolkitError(f"an audit searches 0 turns or more; got {tries}")
    if pairs is not None and pairs < 1:
        raise ToolkitError(f"an audit of pairs needs 1 pair or more; got {pairs}")
    find_pick(task if run is None else transfer_config(run)["task"])
    import numpy as np

    from toolkit.capability.audit import QUANTITIES, run_audit, verdict
    from toolkit.capability.ways import pairs_on, ways_in, ways_of

    with Progress("audit", quiet=json) as progress:
        if run is None:
            lab = make_lab(source, targets, task)
            merged, ways = merged_arms(lab.merged), ways_of(lab.tree(metric, kind))
        else:
            stored = stored_run(run)
            merged, ways = merged_arms(stored.merged), ways_in(stored.tree())
        if pairs is not None:
            ways = pairs_on(ways, pairs, np.random.default_rng(seed))
        progress.show("audit", f"{len(ways)} {'edges' if pairs is None else 'pairs'}, {robots} robots each", 0, len(ways), now=True)
        seen = lambda name, done, total: progress.show("audit", name, done, total, now=True)  # noqa: E731
        edges = run_audit(merged, ways, seen, bend, robots=robots, episodes=episodes, causes=causes, tries=tries)
    content = {"edges": [edge.to_json() for edge in edges]}
    if plot is not None:
        from toolkit.capability.figure import save_audit

        save_audit(content["edges"], plot)
    if json:
        emit(content, True, "")
    else:
        _show(edges)
        print(verdict(edges))
        names = {v.quantity for edge in edges for v in edge.violations}
        if names:
            print(f"Quantities that leave what the ends allow: {', '.join(QUANTITIES[name] for name in QUANTITIES if name in names)}.")


def _show(edges: list) -> None:
    rows = []
    for edge in edges:
        ends, inner = edge.ends, list(edge.robots.values())
        worst: dict[str, str] = {}
        for violation in edge.violations:
            worst.setdefault(violation.quantity, violation.sentence())
        found = "\n".join(worst.values()) or edge.reserve or "even"
        held = [robot.script for robot in inner if robot.script is not None]
        rows.append([
            edge.way.start, edge.way.told,
            f"{ends[0].grip_n:.0f} to {ends[1].grip_n:.0f}",
            f"{min(r.grip_n for r in inner):.0f} to {max(r.grip_n for r in inner):.0f}",
            f"{min(held):.0%}" if held else "", found,
        ])
    columns = ["from", "to", "grip at the ends [N]", "in between [N]", "script, worst", "worst of each kind"]
    table("What the robots in between can do", columns, rows)

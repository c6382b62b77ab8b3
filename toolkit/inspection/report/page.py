"""A run's report: one HTML file that needs nothing else, and its pictures as PNGs beside it."""

import base64
import html
import json
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from toolkit.capability.figure import audit_figure
from toolkit.errors import ToolkitError
from toolkit.inspection.drawn_tree import Plan
from toolkit.inspection.report import figures
from toolkit.inspection.report.stills import renderer_of
from toolkit.inspection.visual import visual_of
from toolkit.io.atomic import write_atomically
from toolkit.morphology.lab import Merged
from toolkit.runs.phases import Phase, load_phases
from toolkit.runs.run import Run, read_audit, read_report, read_untrained, transfer_records

STILLS = 8
"""Along each path."""
STYLE = """
:root { color-scheme: light; }
body { font: 16px/1.5 system-ui, sans-serif; color: #111; background: #fff; margin: 0 auto; max-width: 54rem; padding: 1rem; }
h1 { font-size: 1.5rem; line-height: 1.25; } h2 { font-size: 1.15rem; margin-top: 2.2rem; border-bottom: 1px solid #bbb; }
img { width: 100%; max-width: 40rem; height: auto; display: block; margin: .5rem 0; }
figure { margin: 0; } figcaption { color: #444; font-size: .9rem; }
.wide { overflow-x: auto; } table { border-collapse: collapse; width: 100%; font-variant-numeric: tabular-nums; }
th, td { border-bottom: 1px solid #ccc; padding: .3rem .6rem; text-align: left; vertical-align: top; }
th { border-bottom: 2px solid #111; } td:first-child { white-space: nowrap; } td.number { text-align: right; }
pre { overflow-x: auto; background: #f4f4f4; padding: .6rem; font-size: .8rem; }
.bar { display: inline-block; height: .7em; background: #444; vertical-align: middle; margin-right: .4em; }
@media (max-width: 30rem) {
  table { font-size: .62rem; } th, td { padding: .25rem .15rem; } .bar { display: none; }
  pre { white-space: pre-wrap; word-break: break-all; }
}
.note { border-left: 4px solid #111; padding: .2rem .8rem; background: #f4f4f4; }
"""


class _Html(str):
    """HTML, as opposed to a text that is shown in it."""


def write_report(folder: Path, merged: Merged, tree: dict[str, Any], out: Path | None = None,
                 progress: Callable[[str], None] = lambda what: None) -> Path:
    """Write the page and its pictures; works on a run that goes on, or was stopped, too.

    Args:
        folder: the run folder.
        merged: its merged robot.
        tree: as in tree.json.
        out: folder of the report; default: <run>/page.
        progress: told what is being made.

    Returns:
        The HTML file.

    Raises:
        ToolkitError: the folder is no run, or ``out`` cannot be written.
    """
    out = out or folder / "page"
    run = Run.open(folder)
    unread: list[str] = []
    records, phases, plan = transfer_records(run), load_phases(folder, unread.append), Plan(tree)
    report = read_report(folder, ("targets", "totals", "wall_s", "time"))
    pictures: dict[str, bytes] = {}
    progress("figures")
    walked = walked_edges(plan, records, phases)
    pictures["tree"] = figures.png(figures.tree_figure(plan, walked))
    ways = [np.stack([phase.start, phase.end]) for phase in phases.values() if phase.end is not None and phase.stage == "evolve"]
    pictures["projection"] = figures.png(figures.projection_figure(plan, ways))
    pictures["curves"] = figures.png(figures.curves_figure(records))
    pictures["parameters"] = figures.png(figures.heat_figure(merged.space, {
        name: np.array(node["alpha"]) for name, node in plan.nodes.items() if node["kind"] != "meta"}))
    audit = read_audit(folder)
    if audit is not None and audit["edges"]:
        pictures["audit"] = figures.png(audit_figure(audit["edges"]))
    missing = unread
    try:
        for index, strip in enumerate(_strips(plan, merged, progress), start=1):
            pictures[f"morph-{index}"] = figures.png(strip)
    except ToolkitError as error:
        missing.append(str(error))
    page = _page(run, plan, records, phases, report, pictures, missing)
    try:
        out.mkdir(parents=True, exist_ok=True)
        for name, data in pictures.items():
            write_atomically(out / f"{name}.png", data)
        write_atomically(out / "index.html", page.encode())
    except OSError as error:
        raise ToolkitError(f"report {out} cannot be written ({error.strerror}); choose another --out") from None
    return out / "index.html"


def walked_edges(plan: Plan, records: Sequence[dict[str, Any]], phases: dict[str, Phase]) -> list[tuple[str, str, float, float | None]]:
    """(from, to, share walked, success last measured) of every edge that a path has begun."""
    targets: dict[str, list[str]] = {}
    success: dict[str, float | None] = {}
    moved: set[str] = set()
    every = [name for name, node in plan.nodes.items() if node["kind"] == "target"]
    for record in records:
        path = record["path"]
        targets.setdefault(path, every)
        if record["event"] == "split":
            targets[path] = record["targets"].split()
        if (record["event"] == "check" or (record["event"] == "look" and record["held"])) and record["stage"] == "evolve":
            success[path] = record["success"]
        if record["event"] == "moved":
            moved.add(path)
    out = []
    for path, names in targets.items():
        own = sorted((phase for phase in phases.values() if phase.path == path), key=lambda phase: phase.number)
        edge = plan.way_of(own[0].targets, own[0].start) if own else plan.edge_of(names)
        ends = [phase.end for phase in own if phase.end is not None]
        if edge is not None and path in moved:
            share = max((plan.fraction(edge, end) for end in ends), default=1.0)
            out.append((edge["from"], edge["to"], share, success.get(path)))
    return out


def _strips(plan: Plan, merged: Merged, progress: Callable[[str], None]) -> Iterator[Figure]:
    """Stills along every edge of the tree."""
    renderer = renderer_of(visual_of(merged))
    try:
        for edge in plan.edges:
            progress(f"stills from {edge['from']} to {edge['to']}")
            start, end = (np.array(plan.nodes[edge[key]]["alpha"]) for key in ("from", "to"))
            shares = np.linspace(0.0, 1.0, STILLS)
            pictures = [renderer.take(np.clip(start + share * (end - start), 0.0, 1.0)) for share in shares]
            yield figures.strip_figure(f"{edge['from']} to {edge['to']}", pictures, shares.tolist())
    finally:
        renderer.close()


def _page(run: Run, plan: Plan, records: list[dict[str, Any]], phases: dict[str, Phase], report: dict[str, Any] | None,
          pictures: dict[str, bytes], missing: list[str]) -> str:
    config = run.config
    title = f"{config.get('source', '?')} to {', '.join(config.get('targets', []))}: {config.get('task', '?')}"
    parts = [f"<h1>{html.escape(title)}</h1>", _status(records, report), "<h2>Targets</h2>", _targets(run, records, report)]
    legend = ("To scale, lengths on the edges. Square: source; diamonds: meta robots; circles: targets. Thick: walked; the darker, the "
              "more success. Thin: planned. Slanting: a path that left from elsewhere than planned.")
    parts += ["<h2>Evolution tree</h2>", _figure(pictures, "tree", legend)]
    parts += [_figure(pictures, "projection", "The tree and the walked paths in the plane in which the robots differ most.")]
    legend = "One line per path. Hollow: a robot too far away, so that a shorter step followed."
    parts += ["<h2>Learning</h2>", _nothing(records), _figure(pictures, "curves", legend), _paths(records), _trouble(phases)]
    parts += ["<h2>Robots on their way</h2>"]
    audit = read_audit(run.path)
    if audit is not None:
        legend = ("What the robots of every edge can do, without any policy: dots are its ends, crosses robots that are worse than the "
                  "ends allow; what they allow is grey.")
        parts += [f"<p>{html.escape(audit['verdict'])}</p>", *([_figure(pictures, "audit", legend)] if "audit" in pictures else [])]
    parts += [f'<p class="note">{html.escape(f"{path}: {why}")}</p>' for path, why in ((report or {}).get("stalls") or {}).items()]
    parts += [f'<p class="note">{html.escape(why)}</p>' for why in missing]
    parts += [_figure(pictures, name, "") for name in pictures if name.startswith("morph-")]
    parts += ["<h2>Parameters</h2>", _figure(pictures, "parameters", "alpha of every robot: white 0, black 1; rows are joints and shapes.")]
    settings = json.dumps(config, indent=1)
    versions = _read(run.path / "versions.json")
    parts += ["<h2>Configuration</h2>", f"<pre>{html.escape(settings)}</pre>", f"<pre>{html.escape(versions)}</pre>"]
    head = f'<meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1"><title>{html.escape(title)}</title>'
    return f'<!DOCTYPE html>\n<html lang="en"><head>{head}<style>{STYLE}</style></head>\n<body>\n' + "\n".join(parts) + "\n</body></html>\n"


def _nothing(records: list[dict[str, Any]]) -> str:
    """What stands in place of curves that are zero all along."""
    if not records or any(record["sim_epochs"] for record in records):
        return ""
    return "<p>Nothing was trained: the policy held on every robot of its way as it was.</p>"


def _status(records: list[dict[str, Any]], report: dict[str, Any] | None) -> str:
    if report is not None:
        totals = report["totals"]
        return (f"<p>Finished: {totals['train_iterations']} updates, {totals['sim_epochs']} training episodes, {totals['check_episodes']} "
                f"checking episodes, {totals['diverged']} diverged simulations. "
                f"The transfer took {report['time']['wall_s'] / 60:.1f} minutes, with the final evaluation "
                f"{report['wall_s'] / 60:.1f}.</p>")
    reached = [record["target"] for record in records if record["event"] == "arrived"]
    names = html.escape(", ".join(reached) or "none yet")
    return (f'<p class="note">Not finished: {len(records)} records so far; targets reached: {names}. '
            "Success on the unmodified robots is measured at the end.</p>")


def _targets(run: Run, records: list[dict[str, Any]], report: dict[str, Any] | None) -> str:
    head = ("target", "direct, untrained", "unmodified robot", "95 % interval", "F(beta)")
    rows, untrained = [], read_untrained(run.path)
    for name in run.config.get("targets", []):
        before = "{successes} of {episodes}".format(**untrained[name]) if name in untrained else ""
        both = (report or {}).get("targets", {}).get(name)
        if both is None:
            reached = any(record["event"] == "arrived" and record["target"] == name for record in records)
            rows.append([name, before, "not measured yet", "", "reached" if reached else "not reached yet"])
            continue
        native, merged = both["native"], both["merged"]
        low, high = native["ci95"]
        bar = f'<span class="bar" style="width:{4 * native["success_rate"]:.2f}em"></span>'
        rows.append([name, before, _Html(f"{bar}{native['successes']} of {native['episodes']}"), f"{low:.2f} to {high:.2f}",
                     f"{merged['successes']} of {merged['episodes']}"])
    return _table(head, rows)


def _paths(records: list[dict[str, Any]]) -> str:
    """What each path cost and where it stands."""
    last: dict[str, dict[str, Any]] = {}
    success: dict[str, float] = {}
    lowest: dict[str, float] = {}
    for record in records:
        last[record["path"]] = record
        if record["event"] == "check":
            success[record["path"]] = record["success"]
            lowest[record["path"]] = min(lowest.get(record["path"], 1.0), record["success"])
    totals = {"train_iterations": "updates", "sim_epochs": "training episodes", "check_episodes": "checking episodes"}
    totals |= {"diverged": "diverged"} if any(record["diverged"] for record in last.values()) else {}
    share = lambda of, path: f"{of[path]:.0%}" if path in of else ""  # noqa: E731
    rows = [[path, f"{record['event']} ({record['stage']})", *(record[key] for key in totals), share(success, path), share(lowest, path)]
            for path, record in last.items()]
    return _table(("path", "last event", *totals.values(), "last success", "lowest"), rows)


def _trouble(phases: dict[str, Phase]) -> str:
    """The phases with failures among the episodes that are kept."""
    rows = []
    for phase in phases.values():
        failure = phase.episode("failure")
        if failure is not None:
            kind = "exploring" if failure.noise else "without noise"
            first = f"seed {failure.seed}, {kind}, after {failure.update} updates"
            rows.append([phase.path, phase.number, phase.stage, " ".join(phase.targets), first])
    if not rows:
        return "<p>No phase holds a failed episode.</p>" if phases else ""
    return "<h3>Phases with failures</h3>" + _table(("path", "phase", "stage", "to", "first failure"), rows)


def _table(head: Sequence[str], rows: Sequence[Sequence[Any]]) -> str:
    """An HTML table; every text is escaped but what this page wrote as HTML itself."""
    cell = lambda value: str(value) if isinstance(value, _Html) else html.escape(str(value))  # noqa: E731
    number = lambda value: ' class="number"' if isinstance(value, int) else ""  # noqa: E731
    body = "".join("<tr>" + "".join(f"<td{number(value)}>{cell(value)}</td>" for value in row) + "</tr>" for row in rows)
    heads = "".join(f"<th>{html.escape(h)}</th>" for h in head)
    return f'<div class="wide"><table><thead><tr>{heads}</tr></thead><tbody>{body}</tbody></table></div>'


def _figure(pictures: dict[str, bytes], name: str, caption: str) -> str:
    data = base64.b64encode(pictures[name]).decode()
    picture = f'<img alt="{html.escape(name)}" src="data:image/png;base64,{data}">'
    return f"<figure>{picture}<figcaption>{html.escape(caption)}</figcaption></figure>"


def _read(file: Path) -> str:
    return file.read_text(encoding="utf-8", errors="replace") if file.is_file() else ""

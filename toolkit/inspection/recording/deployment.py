"""A deployment's log as curves for the Rerun viewer: what each tick cost, how old its state was, what was asked of the arm.

    time/own, time/arm     [ms] of the runtime's own work, and of waiting for the arm
    state/age, state/held  [ms] age of the state; whether the arm was held, and whether the tick was late
    arm/joints, action, object/height   [rad], the policy's action, [m]
"""

from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from toolkit.deploy.runtime import LOG_FORMAT, STAGES
from toolkit.errors import ToolkitError
from toolkit.inspection.recording.layout import quiet_layout
from toolkit.inspection.recording.learning import PATH_COLOURS
from toolkit.inspection.recording.stream import finish
from toolkit.io.jsonfiles import content_of, parsed_object, require
from toolkit.io.quoting import markdown

TIMELINE = "tick"
ACTIONS = ("x", "y", "z", "rx", "ry", "rz", "gripper")
TITLES = {
    "time/own": "The runtime's own time [ms]", "time/arm": "Waiting for the arm [ms]", "state/age": "Age of the state [ms]",
    "state/held": "Held and late ticks", "action": "Action of the policy", "arm/joints": "Arm angles [rad]",
    "object/height": "Height of the object [m]",
}
_NUMBERS = [(float, None)]
_NOTE = {"episode": int}
_TICK = _NOTE | {"tick": int, "late": bool, "hold": bool, "action": _NUMBERS} | {f"{stage}_ms": float for stage in STAGES}
_ALSO = {"joints": _NUMBERS, "object": _NUMBERS, "age_ms": (float, None), "fault": str}
"""What a tick's line may hold besides."""
PAGE = (("time/own", "time/arm", "state/age", "state/held"), ("action", "arm/joints", "object/height"))
"""Columns of the page."""


def record_deployment(log: Path) -> Path:
    """Draw a log of ``deploy --log`` into an .rrd file beside it; returns that file.

    Raises:
        ToolkitError: no such log, or another file.
    """
    about, rows = read_log(log)
    out = log.with_suffix(".rrd")
    ticks = [row for row in rows if "tick" in row]
    stream = rr.RecordingStream("meta-evolve deployment")
    try:
        out.unlink(missing_ok=True)
        out.touch()
        stream.save(out)
    except (OSError, RuntimeError) as error:
        raise ToolkitError(f"recording {out} cannot be written ({error}); copy the log to a folder that can be") from None
    curves = _curves(ticks)
    stream.send_blueprint(_layout(curves))
    for entity, (names, values) in curves.items():
        _draw(stream, entity, names, values)
    text = rr.TextDocument(_summary(about, rows, ticks), media_type=rr.MediaType.MARKDOWN)
    stream.log("summary", text, static=True)
    finish(stream, out)
    return out


def read_log(log: Path) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """What a log of ``deploy --log`` is about, and its lines.

    Raises:
        ToolkitError: no such log, another file, or a line that is damaged.
    """
    mend = "give a file that `meta-evolve deploy --log` wrote"
    lines = content_of(log, mend).split(b"\n")
    try:
        about = parsed_object(lines[0], "line 1", "it says what is logged")
    except ToolkitError as error:
        raise ToolkitError(f"{log} is no deployment log ({error}); {mend}") from None
    if about.get("format") != LOG_FORMAT:
        raise ToolkitError(f"{log} is no deployment log; {mend}")
    rows = []
    for number, line in enumerate(lines[1:-1], start=2):  # a killed run leaves a torn last line
        row = parsed_object(line, f"{log} line {number}", "delete that line")
        shape = (_TICK if "tick" in row else _NOTE) | {key: shape for key, shape in _ALSO.items() if key in row}
        rows.append(require(row, shape, f"{log} line {number}", "delete that line"))
    wanted = {"action": len(ACTIONS), "object": 3, "joints": max((len(row["joints"]) for row in rows if "joints" in row), default=0)}
    odd = [(key, row) for row in rows for key, size in wanted.items() if key in row and len(row[key]) != size]
    if odd:
        key, row = odd[0]
        raise ToolkitError(f"{log} is damaged: tick {row.get('tick')} of episode {row['episode']} has {len(row[key])} numbers of {key}, "
                           f"not {wanted[key]}; delete that line")
    return about, rows


def _curves(ticks: list[dict[str, Any]]) -> dict[str, tuple[tuple[str, ...], np.ndarray]]:
    """Entity -> names of its lines, and their values (ticks, lines); NaN where a tick has none."""

    def column(key: str, size: int | None = None) -> np.ndarray:
        values = [row.get(key) or [None] * (size or 0) if size else [row.get(key)] for row in ticks]
        return np.array(values, float).reshape(len(ticks), size or 1)

    joints = max((len(row.get("joints", ())) for row in ticks), default=0)
    own, arm = STAGES[1:4], (STAGES[0], STAGES[4])
    parts = {stage: column(f"{stage}_ms") for stage in STAGES}
    times = np.hstack([parts[stage] for stage in own])
    curves = {
        "time/own": ((*own, "tick"), np.hstack([times, times.sum(axis=1, keepdims=True)])),
        "time/arm": (arm, np.hstack([parts[stage] for stage in arm])),
        "state/age": (("age",), column("age_ms")),
        "state/held": (("held", "late"), np.hstack([column("hold"), column("late")])),
        "action": (ACTIONS, column("action", len(ACTIONS))),
        "object/height": (("object",), column("object", 3)[:, 2:]),
    }
    return curves | ({"arm/joints": (tuple(f"joint {j + 1}" for j in range(joints)), column("joints", joints))} if joints else {})


def _draw(stream: rr.RecordingStream, entity: str, names: tuple[str, ...], values: np.ndarray) -> None:
    colours = [PATH_COLOURS[line % len(PATH_COLOURS)] for line in range(len(names))]
    stream.log(entity, rr.SeriesLines(names=list(names), colors=colours, widths=[1.5] * len(names)), static=True)
    if len(values):
        columns = rr.Scalars.columns(scalars=values.ravel()).partition([len(names)] * len(values))
        stream.send_columns(entity, [rr.TimeColumn(TIMELINE, sequence=range(len(values)))], columns)


def _layout(curves: dict[str, tuple[tuple[str, ...], np.ndarray]]) -> rrb.Blueprint:
    """The whole log on every axis from the start: the viewer would show the surroundings of the first tick."""
    views = {}
    for entity, (_, values) in curves.items():
        known = values[np.isfinite(values)]
        # Rare long waits are to be seen as such, not to flatten everything else.
        low, high = np.percentile(known, [0.0, 99.5]) if len(known) and entity != "state/held" else (0.0, 1.0)
        room = 0.1 * max(high - low, 1e-3)
        first, last = (rr.TimeRangeBoundary.absolute(seq=tick) for tick in (0, max(1, len(values))))
        whole = rrb.TimeAxis(view_range=rr.TimeRange(start=first, end=last))
        views[entity] = rrb.TimeSeriesView(
            origin=entity, name=TITLES[entity], axis_x=whole, axis_y=rrb.ScalarAxis(range=(low - room, high + room)),
            plot_legend=rrb.PlotLegend(visible=True, corner=rrb.Corner2D.RightTop))
    columns = [rrb.Vertical(*(views[entity] for entity in names if entity in views)) for names in PAGE]
    summary = rrb.TextDocumentView(origin="summary", name="What happened")
    return quiet_layout(rrb.Horizontal(summary, *columns, column_shares=[1, 2, 2]), TIMELINE)


def _summary(about: dict[str, Any], rows: list[dict[str, Any]], ticks: list[dict[str, Any]]) -> str:
    faults = Counter(row["fault"] for row in ticks if "fault" in row)
    episodes = len({row["episode"] for row in ticks})
    robot, task, form, pace = (markdown(str(about.get(key))) for key in ("robot", "task", "form", "pace"))
    lines = [f"# {robot}: {task}", "", f"{len(ticks)} ticks of {episodes} episodes, {form} commands, {pace}.", ""]
    if ticks:
        own = np.array([sum(row[f"{stage}_ms"] for stage in STAGES[1:4]) for row in ticks])
        half, most = np.percentile(own, [50, 99])
        lines += [f"Half of the ticks took less than {half:.2f} ms, 99 of 100 less than {most:.2f} ms, the longest {own.max():.2f} ms. "
                  f"Late ticks: {sum(row['late'] for row in ticks)}.", ""]
    lines += [f"- held for {markdown(kind)}: {count} ticks" for kind, count in faults.items()] or ["No fault."]
    lines += [f"- episode {row['episode']} stopped: {markdown(str(row['stop']))}" for row in rows if "stop" in row]
    return "\n".join(lines)

"""A picture of an audit: one small panel per quantity, one column per edge, what the ends allow as a band."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from toolkit.capability.ways import turn_in, turning
from toolkit.errors import ToolkitError

ROWS = {
    "grip_n": "grip [N]", "balance": "balance", "height_mm": "height [mm]", "opening_mm": "opening [mm]",
    "closing_steps": "closing [steps]", "clearance_mm": "clearance [mm]", "tracking": "tracking", "script": "script",
    "tolerance": "tolerance",
}
"""Quantity -> label of its row."""
LINE, BROKEN, BAND = "#0072b2", "#d55e00", "#e8e8e8"


def audit_figure(edges: Sequence[dict[str, Any]]) -> Figure:
    """Draw audited edges, as ``Edge.to_json`` gives them; ends are marked, robots that break the promise are in colour.

    A quantity that no robot of any edge was measured for, as in a transfer's own short audit, has no row.
    """
    measured = {quantity for quantity in ROWS for edge in edges for robot in edge["robots"] if robot.get(quantity) is not None}
    rows = {quantity: label for quantity, label in ROWS.items() if quantity in measured} or ROWS
    figure = Figure(figsize=(0.8 + 1.55 * max(len(edges), 1), 1.15 * len(rows) + 0.6), facecolor="white", layout="constrained")
    FigureCanvasAgg(figure)
    panels = figure.subplots(len(rows), max(len(edges), 1), squeeze=False, sharex=True, sharey="row")
    for column, edge in enumerate(edges):
        turn = turn_in(edge)
        turned = "" if turn is None else f"\n{turning(turn)}"
        panels[0][column].set_title(f"{edge['from']}\nto {edge['to']}{turned}", fontsize=8)
        for row, (quantity, label) in enumerate(rows.items()):
            axes = panels[row][column]
            _panel(axes, edge, quantity)
            axes.tick_params(labelsize=7)
            if column == 0:
                axes.set_ylabel(label, fontsize=8)
        panels[-1][column].set_xlabel("share of the way", fontsize=7)
    return figure


def _panel(axes: Any, edge: dict[str, Any], quantity: str) -> None:
    robots = [(robot["share"], robot[quantity]) for robot in edge["robots"] if robot.get(quantity) is not None]
    broken = [v for v in edge["violations"] if v["quantity"] == quantity]
    if broken:
        low, high = (limit if limit is not None else default for limit, default in zip(broken[0]["allowed"], (-1e9, 1e9), strict=True))
        values = [value for _, value in robots]
        beyond = 0.1 * (max(values) - min(values))  # a limit that is open, or far away, ends at the panel's
        axes.axhspan(max(low, min(values) - beyond), min(high, max(values) + beyond), color=BAND, zorder=0, linewidth=0)
    if robots:
        shares, values = np.array(robots, float).T
        axes.plot(shares, values, "-", color=LINE, linewidth=1.0, zorder=1)
        ends = [np.argmin(shares), np.argmax(shares)]
        axes.plot(shares[ends], values[ends], "o", color=LINE, markersize=4, zorder=2)
    marks = [(v["share"], v["value"]) for v in broken if v["value"] is not None]
    if marks:
        axes.plot(*np.array(marks).T, "x", color=BROKEN, markersize=5, markeredgewidth=1.4, zorder=3)
    axes.set_xlim(-0.04, 1.04)
    axes.margins(y=0.15)


def save_audit(edges: Sequence[dict[str, Any]], path: Path) -> None:
    """Draw audited edges into a file; its suffix chooses the format (.png, .svg, .pdf).

    Raises:
        ToolkitError: it cannot be written, or its suffix names no image format.
    """
    try:
        audit_figure(edges).savefig(path, dpi=150)
    except (OSError, ValueError) as error:
        raise ToolkitError(f"the plot cannot be written to {path} ({error}); name a .png or .svg file") from error

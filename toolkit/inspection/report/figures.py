"""Figures of a run, readable in black and white: lines differ by dash and marker, shares of success by lightness and number."""

from collections.abc import Sequence
from io import BytesIO
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from toolkit.inspection.drawn_tree import Plan, matrix
from toolkit.io.quoting import letters
from toolkit.morphology.parameters import ParameterSpace

DASHES = ("-", "--", "-.", ":", (0, (5, 1)), (0, (1, 1)), (0, (3, 1, 1, 1)), (0, (7, 2, 2, 2)))
MARKERS = "osv^Dx+*"
COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#444444", "#96821e")
PANELS = {
    "success": ("check", "success", "Success without noise"),
    "train_success": ("update", "train_success", "Success while training"),
    "mean_return": ("update", "mean_return", "Discounted return"),
    "kl": ("update", "kl", "KL divergence of an update"),
    "sim_epochs": (None, "sim_epochs", "Training episodes"),
    "diverged": (None, "diverged", "Diverged simulations"),
}
"""Key -> event that tells it (None: every record), its key there, and the title of its panel."""
PAGE = 4.8
"""[inch] of a figure: as wide as a phone in points, so that its letters can be read there too."""

PAPER = {"facecolor": "white", "edgecolor": "none", "alpha": 0.8, "pad": 0.4}
"""Behind letters that may stand on a line."""


@letters
def png(figure: Figure) -> bytes:
    """The figure as a PNG."""
    out = BytesIO()
    figure.savefig(out, format="png", dpi=160)
    return out.getvalue()


def _figure(width: float, height: float) -> Figure:
    figure = Figure(figsize=(width, height), facecolor="white", layout="constrained")
    FigureCanvasAgg(figure)
    return figure


@letters
def tree_figure(plan: Plan, walked: Sequence[tuple[str, str, float, float | None]]) -> Figure:
    """The tree to scale. Walked edges are thick, darker with more success, which is also written on them.

    Args:
        plan: the tree.
        walked: (from, to, share of the edge that is done, success or None) of every edge with a path on it.
    """
    figure = _figure(PAGE, 0.9 + 0.55 * len(plan.nodes))
    axes = figure.subplots()
    for edge in plan.edges:
        line = plan.stretch(edge, 0.0, 1.0)
        axes.plot(*line.T, color="#bbbbbb", linewidth=1.2, zorder=1)
        axes.annotate(f"{edge['length']:.1f}", (line[-2] + line[-1]) / 2 + (0, -8), ha="center", va="bottom", fontsize=8, color="#444444",
                      bbox=PAPER, zorder=4)
    for start, end, share, success in walked:
        own = {"from": start, "to": end}  # of a path that left from elsewhere than the plan's edge
        edge = next((edge for edge in plan.edges if (edge["from"], edge["to"]) == (start, end)), own)
        line = plan.stretch(edge, 0.0, share)
        grey = 0.75 - 0.75 * (success if success is not None else 0.3)
        axes.plot(*line.T, color=str(grey), linewidth=4.5, zorder=2, solid_capstyle="butt")
        text = "walked" if success is None else f"success {success:.0%}"
        if edge is own:
            axes.annotate(text, line[-2] + 0.75 * (line[-1] - line[-2]) + (0, 10), ha="center", va="top", fontsize=8, bbox=PAPER, zorder=4)
        else:  # from the edge's corner on: around the middle of a short one it would lie on the line that comes down to it
            axes.annotate(text, line[-2] + (0, 10), (8, 0), textcoords="offset points", va="top", fontsize=8, bbox=PAPER, zorder=4)
    for name, node in plan.nodes.items():
        marker = {"source": "s", "meta": "D", "target": "o"}[node["kind"]]
        axes.plot(*plan.places[name], marker, color="white", markeredgecolor="black", markersize=9, zorder=3)
        left = node["kind"] == "source"
        axes.annotate(name, plan.places[name], xytext=(-8 if left else 8, 8), textcoords="offset points", fontsize=9, weight="bold",
                      ha="right" if left else "left", zorder=4)
    axes.margins(x=0.2, y=0.2)
    axes.invert_yaxis()
    axes.set_axis_off()
    return figure


@letters
def projection_figure(plan: Plan, ways: Sequence[np.ndarray]) -> Figure:
    """The tree and the paths walked, (n, D) robots each, in the plane of most variance."""
    figure = _figure(PAGE, 0.8 * PAGE)
    axes = figure.subplots()
    index = {name: plan.project(np.array(node["alpha"]))[0] for name, node in plan.nodes.items()}
    for edge in plan.edges:
        axes.plot(*np.array([index[edge["from"]], index[edge["to"]]])[:, :2].T, color="#bbbbbb", linewidth=1.2)
    for way in ways:
        axes.plot(*plan.project(way)[:, :2].T, color="black", linewidth=1.8, marker=".", markersize=4)
    for name, spot in index.items():
        marker = {"source": "s", "meta": "D", "target": "o"}[plan.nodes[name]["kind"]]
        axes.plot(*spot[:2], marker, color="white", markeredgecolor="black", markersize=8, zorder=3)
        axes.annotate(name, spot[:2], xytext=(7, 5), textcoords="offset points", fontsize=9, bbox=PAPER)
    share = [*plan.share, 0.0, 0.0]
    axes.set_xlabel(f"1st principal component ({share[0]:.0%} of the variance)", fontsize=8)
    axes.set_ylabel(f"2nd ({share[1]:.0%})", fontsize=8)
    axes.margins(0.15)
    axes.tick_params(labelsize=7)
    return figure


@letters
def heat_figure(space: ParameterSpace, robots: dict[str, np.ndarray]) -> Figure:
    """alpha of robots (D,) as matrices: a row per joint or shape, a column per quantity, white 0 to black 1."""
    places, rows, columns = matrix(space)
    width = int(places[:, 0].max()) + 1
    figure = _figure(PAGE, (0.095 * len(rows) + 0.3) * len(robots) + 0.7)
    panels = figure.subplots(len(robots), 1, sharex=True, squeeze=False)[:, 0]
    for axes, (name, alpha) in zip(panels, robots.items(), strict=True):
        image = np.full((len(rows), width), np.nan)
        image[places[:, 1].astype(int), places[:, 0].astype(int)] = alpha
        axes.set_facecolor("#f2f2f2")
        axes.imshow(image, cmap="Greys", vmin=0, vmax=1, aspect="auto", interpolation="nearest")
        for line in range(1, len(rows)):
            axes.axhline(line - 0.5, color="white", linewidth=0.4)
        axes.set_title(name, fontsize=9, loc="left")
        axes.set_yticks(range(len(rows)), rows, fontsize=6)
        axes.set_xticks(list(columns.values()), list(columns), rotation=90, fontsize=5)
        axes.tick_params(length=0)
    return figure


@letters
def curves_figure(records: Sequence[dict[str, Any]]) -> Figure:
    """Learning curves over the run's records, one line per path; hollow: a robot too far away, a shorter step follows.

    A count that is zero all along has no panel; the page says so in words.
    """
    records = [r | {"event": "check"} if r["event"] == "look" and r.get("held") else r for r in records]  # a look that held is a check
    told = lambda event, name: any(event == r["event"] and r.get(name) is not None or event is None and r.get(name) for r in records)  # noqa: E731
    shown = {key: panel for key, panel in PANELS.items() if told(*panel[:2])} or {"success": PANELS["success"]}
    figure = _figure(PAGE, 0.5 + 1.4 * len(shown))
    panels = figure.subplots(len(shown), 1, sharex=True, squeeze=False)[:, 0]
    paths = list(dict.fromkeys(record["path"] for record in records))
    for axes, (key, (event, name, title)) in zip(panels, shown.items(), strict=True):
        for k, path in enumerate(paths):
            points = [(i, record[name]) for i, record in enumerate(records)
                      if record["path"] == path and event in (None, record["event"]) and record.get(name) is not None]
            if points:
                axes.plot(*zip(*points, strict=True), color=COLOURS[k % 8], linestyle=DASHES[k % 8], marker=MARKERS[k % 8], markersize=3.5,
                          linewidth=1.3, label=path)
            short = [(i, record[name]) for i, record in enumerate(records) if record["path"] == path and event == record["event"] == "check"
                     and record.get("held") is False]
            if short:
                axes.plot(*zip(*short, strict=True), linestyle="", marker=MARKERS[k % 8], markersize=3.5, color=COLOURS[k % 8],
                          markerfacecolor="white", zorder=3)
        if not axes.lines:
            axes.annotate("none yet", (0.5, 0.5), xycoords="axes fraction", ha="center", fontsize=8, color="#666666")
        if "success" in key:
            axes.set_ylim(-0.04, 1.04)
        axes.set_title(title, fontsize=9, loc="left")
        axes.tick_params(labelsize=7)
        axes.grid(color="#dddddd", linewidth=0.6)
    panels[-1].set_xlabel("record of metrics.jsonl", fontsize=8)
    lines = {line.get_label(): line for axes in panels for line in axes.lines if not line.get_label().startswith("_")}
    if lines:
        figure.legend(lines.values(), lines.keys(), loc="outside upper left", ncols=5, fontsize=7, frameon=False)
    return figure


@letters
def strip_figure(title: str, pictures: Sequence[np.ndarray], shares: Sequence[float]) -> Figure:
    """Stills (h, w, 3) in two rows of four, each with how far along the path it is."""
    columns = 4
    rows = (len(pictures) + columns - 1) // columns
    figure = _figure(PAGE, 0.3 + 1.35 * rows)
    panels = np.atleast_1d(figure.subplots(rows, columns)).ravel()
    for axes in panels:
        axes.set_axis_off()
    for axes, picture, share in zip(panels, pictures, shares, strict=False):
        axes.imshow(picture)
        axes.set_title(f"{share:.0%}", fontsize=8)
    figure.suptitle(title, fontsize=10, x=0.01, ha="left")
    return figure

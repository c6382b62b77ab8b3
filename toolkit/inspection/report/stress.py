"""A picture of a stress test: success over each condition, the borne range shaded."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from toolkit.evaluation.stress import CONDITIONS, GOOD, Tried, ranges_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes

COLUMNS = 3


def stress_figure(robot: str, tried: Sequence[Tried], file: Path) -> None:
    """Write the picture to a file that matplotlib knows by its ending."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    ranges = ranges_of(tried)
    rows = -(-len(ranges) // COLUMNS)
    figure = Figure(figsize=(9.0, 0.6 + 2.0 * rows), layout="constrained")
    FigureCanvasAgg(figure)
    nominal = next(t for t in tried if not t.conditions)
    figure.suptitle(f"{robot}: success of {nominal.episodes} episodes under laboratory conditions")
    panels = figure.subplots(rows, COLUMNS, squeeze=False, sharey=True).ravel()
    for panel, name in zip(panels, ranges, strict=False):
        _panel(panel, name, nominal, tried, ranges[name])
    for panel in panels[len(ranges) :]:
        panel.set_axis_off()
    figure.savefig(file, dpi=160)


def _panel(panel: "Axes", name: str, nominal: Tried, tried: Sequence[Tried], borne: tuple[float, float]) -> None:
    condition = CONDITIONS[name]
    points = sorted([(condition.nominal, nominal.rate), *((t.conditions[name], t.rate) for t in tried
                                                          if set(t.conditions) == {name})])
    panel.axvspan(*borne, color="0.9")
    panel.axhline(GOOD, color="0.6", linewidth=0.8, linestyle=":")
    panel.plot(*zip(*points, strict=True), color="#0072b2", marker="o", markersize=4)
    panel.plot([condition.nominal], [nominal.rate], color="black", marker="s", linestyle="none")
    panel.set_ylim(-0.05, 1.05)
    panel.set_title(name.replace("_", " "), fontsize=9)
    panel.set_xlabel("times its own" if condition.unit == "1" and condition.nominal == 1.0 else condition.unit, fontsize=8)
    panel.tick_params(labelsize=8)

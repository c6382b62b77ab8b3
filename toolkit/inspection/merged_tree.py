"""The merged robot's kinematic tree as a picture: which joint belongs to which robots."""

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes

from toolkit.errors import ToolkitError
from toolkit.io.quoting import letters
from toolkit.morphology.matching import Matching

# Okabe and Ito's colours (2008), told apart under every common colour blindness; each robot also keeps its own sector.
COLOURS = ("#0072B2", "#E69F00", "#009E73", "#CC79A7", "#56B4E9", "#D55E00", "#F0E442", "#000000")
NODE_RADIUS = 0.27
"""Of a joint's disc, in columns."""


@letters
def plot_merged_tree(matching: Matching, path: str | Path) -> None:
    """Draw the merged tree: a disc per joint with one sector per robot, coloured where that robot has the joint.

    Args:
        matching: the merged tree.
        path: image file; the suffix chooses the format (.png, .svg, .pdf).

    Raises:
        ToolkitError: the file cannot be written, or its suffix names no image format.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    spots = _layout(matching)
    columns, rows = spots.max(axis=0)
    figure = Figure(figsize=(1.0 * (columns + 2.4), 0.95 * (rows + 2.3)), facecolor="white", layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots()
    _draw_bones(axes, matching, spots)
    for index, slot in enumerate(matching.slots):
        _draw_joint(axes, spots[index], [system.present(index) for system in matching.systems])
        axes.annotate(slot.name, spots[index] + [0, NODE_RADIUS + 0.07], ha="center", va="top", fontsize=9)
    _draw_key(axes, matching, columns)
    axes.set(xlim=(-1.6, columns + 0.6), ylim=(rows + 0.7, -1.5), aspect="equal")
    axes.set_title(f"Merged kinematic tree of {', '.join(matching.names)}", fontsize=11)
    axes.set_axis_off()
    try:
        figure.savefig(path, dpi=150)
    except (OSError, ValueError) as error:
        raise ToolkitError(f"the plot cannot be written to {path} ({error}); name a .png or .svg file") from error


def _layout(matching: Matching) -> np.ndarray:
    """(slots, 2) column and row of each slot: the arm in the middle, a row per finger, a column per joint from the base."""
    flange = matching.arm_size - 1
    spots = np.zeros((len(matching.slots), 2))
    spots[: flange + 1, 0] = np.arange(flange + 1)
    children: dict[int, list[int]] = {}
    for index, slot in enumerate(matching.slots[flange + 1 :], start=flange + 1):
        children.setdefault(slot.parent, []).append(index)
        spots[index, 0] = spots[slot.parent, 0] + 1
    elements = [slot.element for slot in matching.slots]  # a finger's inner knuckle lies beside that finger
    fingers = sorted(children[flange], key=lambda index: elements.index(elements[index]))
    for row, finger in enumerate(fingers):
        below = [finger]
        while below:
            spots[below, 1] = row
            below = [child for index in below for child in children.get(index, [])]
    spots[: flange + 1, 1] = (len(fingers) - 1) / 2
    return spots


def _draw_bones(axes: Axes, matching: Matching, spots: np.ndarray) -> None:
    (x, y), flange = spots[0], matching.arm_size - 1
    axes.plot([x - 0.85, spots[flange, 0]], [y, y], color="#777777", linewidth=5, zorder=1, solid_capstyle="butt")
    axes.annotate("world", (x - 0.9, y), ha="center", va="center", fontsize=9, rotation=90)
    for index, slot in enumerate(matching.slots):
        if index > flange:
            (x, y), (u, v) = spots[slot.parent], spots[index]
            bend = (u - 0.5, u - 0.5) if slot.parent == flange else (x, u)
            axes.plot([x, *bend, u], [y, y, v, v], color="#777777", linewidth=1.5, zorder=1)


def _draw_joint(axes: Axes, spot: np.ndarray, owned: list[bool]) -> None:
    """A disc of equal sectors, clockwise from the top, the first robot first."""
    from matplotlib.patches import Wedge

    width = 360.0 / len(owned)
    for k, has in enumerate(owned):
        start = -90.0 + k * width  # the row axis points down, so angles grow clockwise
        colour = COLOURS[k % len(COLOURS)] if has else "white"
        sector = Wedge(tuple(spot), NODE_RADIUS, start, start + width, facecolor=colour, edgecolor="#333333", zorder=3)
        sector.set_linewidth(0.8)
        axes.add_patch(sector)


def _draw_key(axes: Axes, matching: Matching, columns: float) -> None:
    """One disc per robot that shows its sector alone, with its name and number of joints."""
    step = max(2.0, (columns + 1.6) / len(matching.names))
    for k, system in enumerate(matching.systems):
        spot = np.array([-0.8 + k * step, -1.05])
        _draw_joint(axes, spot, [other == k for other in range(len(matching.systems))])
        count = sum(joint is not None and joint.mujoco_joint >= 0 for joint in system.joints)
        text = f"{system.robot.name}\n{count} joints"
        axes.annotate(text, (spot[0] + NODE_RADIUS + 0.1, spot[1]), ha="left", va="center", fontsize=9)

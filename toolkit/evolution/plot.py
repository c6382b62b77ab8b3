"""An evolution tree as a picture with its table."""

import itertools
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from toolkit.errors import ToolkitError
from toolkit.evolution.tree import EvolutionTree
from toolkit.io.quoting import letters

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# Okabe and Ito's colours (2008), told apart under every common colour blindness; shapes say the same again.
_LOOK = {"source": ("#0072B2", "s"), "meta": ("#E69F00", "D"), "target": ("#009E73", "o")}


@letters
def plot_tree(tree: EvolutionTree, path: str | Path) -> None:
    """Draw the tree from left to right, with the length of every edge and the totals, into an image file.

    Columns count the edges from the source, so horizontal distance is not length; the numbers are.

    Args:
        tree: any tree.
        path: image file; the suffix chooses the format (.png, .svg, .pdf).

    Raises:
        ToolkitError: the file cannot be written, or its suffix names no image format.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    spots = _layout(tree)
    columns, rows = spots.max(axis=0) + 1
    figure = Figure(figsize=(max(6.5, 2.3 * columns), 1.6 + 0.85 * rows), facecolor="white", layout="constrained")
    FigureCanvasAgg(figure)
    axes, below = figure.subplots(2, 1, height_ratios=[0.85 * rows + 0.4, 0.75])
    _draw_edges(axes, tree, spots)
    _draw_nodes(axes, tree, spots)
    axes.set(xlim=(-0.5, columns - 0.5), ylim=(-0.75, rows - 0.35))
    axes.set_title(f"Evolution tree: {tree.kind}, {tree.metric.upper()}")
    axes.set_axis_off()
    _draw_table(below, tree)
    try:
        figure.savefig(path, dpi=150)
    except (OSError, ValueError) as error:
        raise ToolkitError(f"The plot cannot be written to {path} ({error}); name a .png or .svg file.") from error


def _draw_table(axes: "Axes", tree: EvolutionTree) -> None:
    axes.set_axis_off()
    proof = "yes" if tree.optimal else f"no; none is below {tree.lower_bound:.4g}"
    table = axes.table(
        [[f"{tree.length:.4g}", f"{tree.independent_length:.4g}", f"{tree.ratio:.2f}", proof]],
        colLabels=["total length", "independent paths", "ratio", "proven shortest of its kind"],
        cellLoc="center",
        loc="center",
    )
    table.scale(1, 1.4)


def _layout(tree: EvolutionTree) -> np.ndarray:
    """(nodes, 2) column and row of each node: leaves one row apart, others midway between their children."""
    children: dict[int, list[int]] = {index: [] for index in range(len(tree.nodes))}
    spots = np.zeros((len(tree.nodes), 2))
    for edge in tree.edges:
        children[edge.start].append(edge.end)
        spots[edge.end, 0] = spots[edge.start, 0] + 1
    rows = itertools.count()

    def place(index: int) -> float:
        below = [place(child) for child in children[index]]
        spots[index, 1] = (below[0] + below[-1]) / 2 if below else next(rows)
        return spots[index, 1]

    place(0)
    return spots


def _draw_edges(axes: "Axes", tree: EvolutionTree, spots: np.ndarray) -> None:
    for edge in tree.edges:
        (x, y), (u, v) = spots[edge.start], spots[edge.end]
        axes.plot([x, u], [y, v], color="#555555", linewidth=1.6, zorder=1)
        axes.annotate(
            f"{edge.length:.3g}",
            (x + 0.55 * (u - x), y + 0.55 * (v - y)),
            ha="center",
            va="center",
            fontsize=9,
            bbox={"facecolor": "white", "edgecolor": "none", "pad": 1.5},
        )


def _draw_nodes(axes: "Axes", tree: EvolutionTree, spots: np.ndarray) -> None:
    for kind, (colour, marker) in _LOOK.items():
        mine = [index for index, node in enumerate(tree.nodes) if node.kind == kind]
        if mine:
            axes.scatter(spots[mine, 0], spots[mine, 1], s=110, color=colour, marker=marker, edgecolor="black", label=kind, zorder=3)
    for node, (x, y) in zip(tree.nodes, spots, strict=True):
        name = node.name if len(node.name) <= 22 else node.name[:21] + "\u2026"
        axes.annotate(
            name,
            (x, y),
            xytext=(0, -10),
            textcoords="offset points",
            ha="center",
            va="top",
            fontsize=10,
            bbox={"facecolor": "white", "edgecolor": "none", "pad": 0.5, "alpha": 0.85},
            zorder=2,
        )
    axes.legend(loc="upper left", ncols=3, frameon=False, fontsize=9)

"""The page of the evolution: the tree to scale, its projections, and alpha with the names of its parameters.

    evolution/tree/plan, nodes     the tree; x is the length from the source
    evolution/tree/done, here      what has been walked, coloured by success, and where the robot is
    evolution/pca2/..., pca3/...   the same in the plane and in space of most variance
    evolution/alpha/cells, names   every dimension of alpha as a dot: a row per joint or shape, a column per quantity
    evolution/changes              what has changed since the source, quantity by quantity
"""

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from rerun.chunk import Chunk

from toolkit.inspection.drawn_tree import ROW, WIDTH, Plan, matrix
from toolkit.inspection.recording.stream import Stream
from toolkit.morphology.parameters import ParameterSpace

KIND_COLOURS = {"source": (86, 180, 233), "meta": (170, 170, 170), "target": (204, 121, 167)}
"""Okabe and Ito (2008): apart for colour-blind eyes too."""
FAILED, HALFWAY, DONE = np.array([213, 94, 0]), np.array([240, 200, 80]), np.array([0, 178, 130])
UNKNOWN, PLANNED, TEXT = (150, 150, 150), (95, 100, 110), (225, 228, 232)
HERE = (255, 255, 255)
LINE = 1.65
"""Distance of the heat map's rows, in columns."""
HEAD_ROW = 1.1 * LINE
"""Distance of the rows in which the heads of its columns stand, in columns."""
TABLES = 8
"""Frames between two tables of what has changed."""
LETTER = 0.78
"""Width of a letter beside the heat map, in columns."""


def success_colour(success: float | None) -> tuple[int, int, int]:
    """From vermilion (0 %) by yellow to green (100 %); grey if nobody knows."""
    if success is None or not np.isfinite(success):
        return UNKNOWN
    low, high, share = (FAILED, HALFWAY, 2 * success) if success < 0.5 else (HALFWAY, DONE, 2 * success - 1)
    red, green, blue = (int(value) for value in np.round(low + (high - low) * share))
    return red, green, blue


class EvolutionPage:
    """Draws the page.

    Args:
        stream: to draw into.
        plan: the tree.
        space: names of the dimensions; None for a tree of anybody's points.
    """

    def __init__(self, stream: Stream, plan: Plan, space: ParameterSpace | None) -> None:
        self.stream, self.plan, self.space = stream, plan, space
        self._walked: list[tuple[dict[str, Any], float, float, float | None]] = []  # edge, from, to, success
        self._ways: list[tuple[np.ndarray, float | None]] = []  # projected ends, success
        self._draw_plan()
        if space is not None:
            cells, self._rows, self._columns = matrix(space)
            self._cells = cells * (1.0, LINE)
            self._draw_names(space)

    def visit(self, film: np.ndarray, iteration: int, alphas: np.ndarray, targets: Sequence[str]) -> None:
        """The robot is at alphas (T, D) at times film (T,) [s], on its way to ``targets``."""
        count = len(film)
        ways = [(way, alpha) for alpha in alphas if (way := self.plan.way_of(targets, alpha)) is not None]
        if len(ways) == count:
            here = np.array([self.plan.stretch(way, 0.0, self.plan.fraction(way, alpha))[-1] for way, alpha in ways])
            self.stream.rows("evolution/tree/here", film, iteration, rr.Points2D.columns(positions=here))
        spots = self.plan.project(alphas)
        self.stream.rows("evolution/pca2/here", film, iteration, rr.Points2D.columns(positions=spots[:, :2] * (1, -1)))
        self.stream.rows("evolution/pca3/here", film, iteration, rr.Points3D.columns(positions=spots))
        if self.space is not None:
            colours = heat(alphas).reshape(-1, 3)
            self.stream.rows("evolution/alpha/cells", film, iteration, rr.Points2D.columns(
                positions=np.tile(self._cells, (count, 1)), colors=colours).partition([len(self._cells)] * count))
            for k in sorted({*range(0, count, TABLES), count - 1}):
                text = rr.TextDocument(self._changes(self.space, alphas[k]), media_type=rr.MediaType.MARKDOWN)
                self.stream.row("evolution/changes", float(film[k]), iteration, text)

    def walked(
        self, film: float, iteration: int, start: np.ndarray, end: np.ndarray, targets: Sequence[str], success: float | None
    ) -> None:
        """A phase from start (D,) to end (D,) is done; ``success`` as last measured, 0 to 1."""
        edge = self.plan.way_of(targets, start)
        if edge is not None:
            self._walked.append((edge, self.plan.fraction(edge, start), self.plan.fraction(edge, end), success))
            lines = [self.plan.stretch(e, a, b) for e, a, b, _ in self._walked]
            colours = [success_colour(value) for *_, value in self._walked]
            last = {(e["from"], e["to"]): index for index, (e, *_) in enumerate(self._walked)}
            labels = [_percent(value) if last[e["from"], e["to"]] == index else "" for index, (e, _, _, value) in enumerate(self._walked)]
            self.stream.row("evolution/tree/done", film, iteration, rr.LineStrips2D(lines, colors=colours, radii=rr.Radius.ui_points(4.0)))
            ends = [(line[-2] + line[-1]) / 2 - (0.0, 0.3 * ROW) for line in lines]
            keep = [k for k, label in enumerate(labels) if label]
            texts, tints = [labels[k] for k in keep], [colours[k] for k in keep]
            marks = rr.Points2D([ends[k] for k in keep], labels=texts, colors=tints, radii=rr.Radius.ui_points(2.0), show_labels=True)
            self.stream.row("evolution/tree/success", film, iteration, marks)
        self._ways.append((self.plan.project(np.stack([start, end])), success))
        lines, colours = [way for way, _ in self._ways], [success_colour(value) for _, value in self._ways]
        flat = [line[:, :2] * (1, -1) for line in lines]
        self.stream.row("evolution/pca2/done", film, iteration, rr.LineStrips2D(flat, colors=colours, radii=rr.Radius.ui_points(3.0)))
        self.stream.row("evolution/pca3/done", film, iteration, rr.LineStrips3D(lines, colors=colours, radii=rr.Radius.ui_points(3.0)))

    # ---- what stands from the start ----------------------------------------------------------------------------

    def _draw_plan(self) -> None:
        plan, put = self.plan, self.stream.static
        names = list(plan.nodes)
        kinds = [plan.nodes[name]["kind"] for name in names]
        labels = [name if kind == "meta" else f"{name} ({kind})" for name, kind in zip(names, kinds, strict=True)]
        colours = [KIND_COLOURS.get(kind, UNKNOWN) for kind in kinds]
        lines = [plan.stretch(edge, 0.0, 1.0) for edge in plan.edges]
        thin, dot, big, speck = (rr.Radius.ui_points(size) for size in (1.5, 7.0, 6.0, 0.5))
        put("evolution/tree/plan", rr.LineStrips2D(lines, colors=PLANNED, radii=thin))
        middles = [(line[-2] + line[-1]) / 2 for line in lines]
        lengths = [f"{edge['length']:.1f}" for edge in plan.edges]
        put("evolution/tree/lengths", rr.Points2D(middles, labels=lengths, colors=UNKNOWN, radii=speck, show_labels=True))
        put("evolution/tree/nodes", rr.Points2D([plan.places[n] for n in names], colors=colours, radii=dot))
        aside = [(24 + 7.5 * len(label), -0.13 * ROW) if kind == "target" else (0, 0) for label, kind in zip(labels, kinds, strict=True)]
        beside = np.array([plan.places[name] for name in names]) + aside
        put("evolution/tree/names", rr.Points2D(beside, labels=labels, colors=TEXT, radii=speck, show_labels=True))
        put("evolution/tree/here", rr.Points2D.from_fields(colors=HERE, radii=big))
        spots = plan.project(np.array([plan.nodes[name]["alpha"] for name in names]))
        index = {name: k for k, name in enumerate(names)}
        ways = [spots[[index[edge["from"]], index[edge["to"]]]] for edge in plan.edges]
        flat, ends = spots[:, :2] * (1, -1), [k for k, kind in enumerate(kinds) if kind != "meta"]
        named = [names[k] for k in ends]
        put("evolution/pca2/plan", rr.LineStrips2D([way[:, :2] * (1, -1) for way in ways], colors=PLANNED, radii=thin))
        put("evolution/pca2/nodes", rr.Points2D(flat, colors=colours, radii=dot))
        put("evolution/pca2/names", rr.Points2D(flat[ends], labels=named, colors=TEXT, radii=speck, show_labels=True))
        put("evolution/pca3/plan", rr.LineStrips3D(ways, colors=PLANNED, radii=thin))
        put("evolution/pca3/nodes", rr.Points3D(spots, colors=colours, radii=dot))
        put("evolution/pca3/names", rr.Points3D(spots[ends], labels=named, colors=TEXT, radii=speck, show_labels=True))
        for entity, kind in (("pca2", rr.Points2D), ("pca3", rr.Points3D)):
            put(f"evolution/{entity}/here", kind.from_fields(colors=HERE, radii=big))

    def _draw_names(self, space: ParameterSpace) -> None:
        """Names of the heat map's rows and columns; a dot under the pointer tells its parameter."""
        put = self.stream.static
        names = dimension_names(space)
        put("evolution/alpha/cells", rr.Points2D.from_fields(radii=0.45, labels=names, show_labels=False))
        places = [(-1.5 - 0.5 * LETTER * len(name), LINE * (row - 0.33)) for row, name in enumerate(self._rows)]
        put("evolution/alpha/rows", rr.Points2D(places, labels=self._rows, colors=TEXT, radii=0.01, show_labels=True))
        heads = head_places(self._columns)
        put("evolution/alpha/columns", rr.Points2D(heads, labels=list(self._columns), colors=TEXT, radii=0.01, show_labels=True))
        leaders = [[(x, y + 0.8 * HEAD_ROW), (x, -0.6 * LINE)] for x, y in heads]
        put("evolution/alpha/leaders", rr.LineStrips2D(leaders, colors=PLANNED, radii=rr.Radius.ui_points(0.4)))

    @staticmethod
    def _changes(space: ParameterSpace, alpha: np.ndarray) -> str:
        """What has changed since the source, as Markdown: a line per quantity, with its largest change in physical units."""
        change = np.abs(alpha - space.betas[0])
        found: dict[str, tuple[set[int], float, str]] = {}
        for parameter in space.parameters:
            if change[parameter.dimension] < 1e-9:
                continue
            low, high = parameter.low, parameter.high
            share = 1.0 - alpha[parameter.dimension] if parameter.flipped else alpha[parameter.dimension]
            size = change[parameter.dimension] * (high - low)
            item, _, quantity = parameter.name.partition(".")
            quantity = (quantity or item).split(".")[0]
            dimensions, largest, line = found.get(quantity, (set(), -1.0, ""))
            if size > largest:
                largest, line = size, f"{parameter.name} | {parameter.values[0]:.3g} | {low + share * (high - low):.3g} | {parameter.unit}"
            found[quantity] = dimensions | {parameter.dimension}, largest, line
        if not found:
            return "Nothing has changed yet: this is the source."
        lines = [f"| {quantity} | {len(dimensions)} | {line} |" for quantity, (dimensions, _, line) in found.items()]
        head = ["| changed since the source | dimensions | the largest | source | now | unit |", "|---|---|---|---|---|---|"]
        return "\n".join([*head, *lines])


DARK = (22, 24, 28)


def head_places(columns: dict[str, float]) -> list[tuple[float, float]]:
    """Where the heads of the heat map's columns stand: over their middles, in as few rows as keep them from overlapping."""
    ends: list[float] = []
    places = []
    for name, middle in columns.items():
        half = 0.5 * LETTER * (len(name) + 2)
        row = next((row for row, end in enumerate(ends) if end <= middle - half), len(ends))
        ends[row : row + 1] = [middle + half]
        places.append((middle, -LINE - (row + 1) * HEAD_ROW))
    return places


Extent = tuple[int, float, float, float, float]
"""How many dimensions a heat map of alpha shows, and what it spans with its names: left, right, top, bottom."""


def alpha_extent(space: ParameterSpace) -> Extent:
    """The extent of a space's heat map."""
    cells, rows, columns = matrix(space)
    return _extent(cells * (1.0, LINE), rows, head_places(columns))


def _extent(cells: np.ndarray, rows: Sequence[str], heads: Sequence[Sequence[float]]) -> Extent:
    right, bottom = cells.max(axis=0)
    top = min(y for _, y in heads)
    return len(cells), -2.5 - LETTER * max(map(len, rows)), float(right) + 2.5, float(top) - LINE, float(bottom) + LINE


def recorded_extent(chunks: Iterable[Chunk]) -> Extent | None:
    """The extent of a recording's heat map; None if it has none."""
    found: dict[str, dict[str, Any]] = {}
    for chunk in chunks:
        name = chunk.entity_path.removeprefix("/evolution/alpha/")
        if name in ("cells", "rows", "columns"):
            row = chunk.to_record_batch().slice(0, 1).to_pylist()[0]
            found.setdefault(name, {}).update({key: value for key, value in row.items() if value is not None})
    try:
        cells, rows, heads = (found[name][f"Points2D:{key}"] for name, key in
                              (("cells", "positions"), ("rows", "labels"), ("columns", "positions")))
    except KeyError:
        return None
    return _extent(np.array(cells), rows, heads)


def evolution_views(plan: Plan, extent: Extent | None) -> dict[str, rrb.View]:
    """The page's views, by name; without an extent there is no heat map."""
    spread = np.array([*plan.places.values(), (1.2 * WIDTH, 0.0)])  # names of targets stand to their right
    bounds = _around(spread, (0.14 * WIDTH, 0.6 * ROW))
    spots = plan.project(np.array([node["alpha"] for node in plan.nodes.values()]))
    share = [*plan.share, 0.0, 0.0]
    views: dict[str, rrb.View] = {
        "tree": rrb.Spatial2DView(
            origin="evolution/tree", name="Tree to scale: lengths, done paths by success, current robot (white)", visual_bounds=bounds,
            background=DARK),
        "pca2": rrb.Spatial2DView(
            origin="evolution/pca2", name=f"2 principal components: {share[0] + share[1]:.0%} of the variance", background=DARK,
            visual_bounds=_around(spots[:, :2] * (1, -1), (3.5, 2.0))),
        "pca3": rrb.Spatial3DView(
            origin="evolution/pca3", name=f"3 components: {sum(share[:3]):.0%} of the variance", background=DARK, line_grid=False,
            eye_controls=rrb.EyeControls3D(position=(15.0, -21.0, 15.0), look_target=spots.mean(axis=0), eye_up=(0.0, 0.0, 1.0))),
    }
    if extent is not None:
        size, left, right, top, bottom = extent
        bounds = rrb.VisualBounds2D(x_range=(left, right), y_range=(top, bottom))
        name = f"alpha: {size} dimensions, blue 0 to yellow 1 (hover for names)"
        views["alpha"] = rrb.Spatial2DView(origin="evolution/alpha", name=name, background=DARK, visual_bounds=bounds)
        views["changes"] = rrb.TextDocumentView(origin="evolution/changes", name="Parameters")
    return views


def _around(points: np.ndarray, margin: tuple[float, float]) -> rrb.VisualBounds2D:
    low, high = points.min(axis=0) - margin, points.max(axis=0) + margin
    return rrb.VisualBounds2D(x_range=(low[0], high[0]), y_range=(low[1], high[1]))


def heat(values: np.ndarray) -> np.ndarray:
    """Colours (..., 3) of values in [0, 1]: blue by teal to light yellow, of even steps in lightness, all far from the dark behind."""
    stops = np.array([(66, 98, 186), (58, 139, 176), (84, 175, 138), (160, 207, 94), (253, 234, 69)], float)  # viridis without its dark end
    position = np.clip(values, 0.0, 1.0) * (len(stops) - 1)
    index = np.minimum(position.astype(int), len(stops) - 2)
    share = (position - index)[..., None]
    return np.round(stops[index] + (stops[index + 1] - stops[index]) * share).astype(np.uint8)


def dimension_names(space: ParameterSpace) -> list[str]:
    """The name of every dimension: its first parameter, and how many move with it."""
    members: dict[int, list[str]] = {}
    for parameter in space.parameters:
        members.setdefault(parameter.dimension, []).append(parameter.name)
    return [members[k][0] + (f" +{len(members[k]) - 1}" if len(members[k]) > 1 else "") for k in range(space.size)]


def _percent(success: float | None) -> str:
    return "" if success is None or not np.isfinite(success) else f"{success:.0%}"

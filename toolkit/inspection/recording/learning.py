"""The page of the learning: one entity per quantity, one line per path.

    learning/<key>     as many numbers per row as there are paths; NaN where a path is not at work
"""

from collections.abc import Collection, Iterable, Sequence
from typing import Any

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from rerun.chunk import Chunk

from toolkit.inspection.recording.stream import Stream

PATH_COLOURS = ((0, 114, 178), (213, 94, 0), (0, 158, 115), (204, 121, 167), (230, 159, 0), (86, 180, 233), (120, 120, 120), (150, 130, 20))
CURVES = {
    "success": "Success without noise [0 to 1]",
    "train_success": "Success while training [0 to 1]",
    "mean_return": "Discounted return",
    "kl": "KL divergence of an update",
    "sim_epochs": "Training episodes",
    "train_iterations": "Updates",
    "diverged": "Diverged simulations",
    "wall": "Wall time [s]",
}
"""Key of a record -> title of its plot. The last four are totals of the path so far."""
FLAT = {
    "success": "Nothing was checked.",
    "train_success": "Nothing was trained: the policy held on every robot as it was.",
    "mean_return": "Nothing was trained, so that there are no returns.",
    "kl": "No update moved all weights along the natural gradient: only such a step measures it.",
    "sim_epochs": "No training episodes were needed.",
    "train_iterations": "No updates were needed.",
    "diverged": "No simulation diverged.",
    "wall": "No time has passed.",
}
"""What stands in place of a curve that is zero all along, or is not there."""


class LearningPage:
    """Draws the page.

    Args:
        stream: to draw into.
        paths: names of all that have a line; the viewer wants as many numbers in every row.
    """

    def __init__(self, stream: Stream, paths: Sequence[str]) -> None:
        self.stream, self.paths = stream, list(paths)
        self._wall: dict[str, float] = {}
        self._before = 0.0
        self._waiting: dict[str, list[np.ndarray]] = {}
        self._name_lines()
        for key, sentence in FLAT.items():
            stream.static(f"learning/flat/{key}", rr.TextDocument(f"**{CURVES[key]}**\n\n{sentence}", media_type=rr.MediaType.MARKDOWN))

    def add(self, iteration: int, record: dict[str, Any]) -> None:
        """One record of the run."""
        path = record["path"]
        if path not in self.paths:
            return
        seconds = record.get("seconds")
        if seconds is not None:
            self._wall[path] = self._wall.get(path, 0.0) + max(0.0, seconds - self._before)
            self._before = seconds
        values = {key: record.get(key) for key in CURVES} | {"wall": self._wall.get(path)}
        if record["event"] == "explore" or (record["event"] == "look" and not record["held"]):
            values["success"] = None  # with noise, or on a robot that nothing trains for
        for key, value in values.items():
            if value is not None:
                row = np.full(len(self.paths), np.nan)
                row[self.paths.index(path)] = value
                self.stream.row(f"learning/{key}", None, iteration, rr.Scalars(row))
                self._waiting.setdefault(key, []).append(row)

    def repeat(self, begin: float, end: float) -> None:
        """The viewer shows one timeline at a time: on the film, the points since the last call fill [begin, end] s."""
        for key, rows in self._waiting.items():
            times = np.linspace(begin, end, len(rows), endpoint=False)
            columns = rr.Scalars.columns(scalars=np.concatenate(rows)).partition([len(row) for row in rows])
            self.stream.rows(f"learning/{key}", times, None, columns)
        self._waiting.clear()

    def _name_lines(self) -> None:
        colours = [PATH_COLOURS[k % len(PATH_COLOURS)] for k in range(len(self.paths))]
        for key in CURVES:
            self.stream.static(f"learning/{key}", rr.SeriesLines(names=self.paths, colors=colours, widths=[2.0] * len(colours)),
                               rr.SeriesPoints(names=self.paths, colors=colours, marker_sizes=[3.0] * len(colours)))


def flat_curves(chunks: Iterable[Chunk]) -> set[str]:
    """Keys of the curves of a recording that are zero all along, or empty, and have a sentence for it."""
    told, moving = set(), set()
    for chunk in chunks:
        place, _, key = chunk.entity_path.rpartition("/")
        if place == "/learning/flat":
            told.add(key)
        if place == "/learning":
            batch = chunk.to_record_batch()
            rows = batch.column("Scalars:scalars").to_pylist() if "Scalars:scalars" in batch.schema.names else []
            if any(np.nan_to_num(row or 0.0).any() for row in rows):
                moving.add(key)
    return told - moving


def learning_views(flat: Collection[str] = ()) -> dict[str, rrb.View]:
    """One plot per quantity; of those whose curve is ``flat`` a sentence."""
    unit = rrb.ScalarAxis(range=(-0.03, 1.03))
    return {
        key: rrb.TextDocumentView(origin=f"learning/flat/{key}", name=title) if key in flat else rrb.TimeSeriesView(
            origin=f"learning/{key}", name=title, axis_y=unit if "success" in key else None,
            plot_legend=rrb.PlotLegend(visible=key == "success", corner=rrb.Corner2D.RightBottom))
        for key, title in CURVES.items()
    }

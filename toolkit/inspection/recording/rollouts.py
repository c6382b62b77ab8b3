"""The page of the rollouts: what an episode did, as curves under the robot's film.

    signals/position     [m] of the grasp frame, x y z, wanted by OSC and reached
    signals/action       the six OSC deltas and the closing action; signals/closing: the closing progress
    signals/distance     [m] from object to goal; signals/grip: [N] of the robot on the object; signals/reward
    signals/caption      which episode it is, and how it ended
"""

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from toolkit.inspection.film import Film, closing_action
from toolkit.inspection.recording.stream import Stream

BLUE, ORANGE, GREEN, VERMILION, GREY, SKY, PINK = (
    (0, 114, 178), (230, 159, 0), (0, 158, 115), (213, 94, 0), (120, 120, 120), (86, 180, 233), (204, 121, 167),
)
LINES = {
    "position": (("x wanted", SKY), ("y wanted", ORANGE), ("z wanted", PINK), ("x", BLUE), ("y", VERMILION), ("z", GREEN)),
    "action": (("dx", BLUE), ("dy", VERMILION), ("dz", GREEN), ("rx", SKY), ("ry", ORANGE), ("rz", PINK), ("close", (150, 150, 150))),
    "distance": (("object to goal [m]", BLUE), ("tolerance [m]", GREY)),
    "grip": (("robot on object [N]", VERMILION),),
    "reward": (("reward", GREEN), ("closing progress", ORANGE)),
}
TITLES = {
    "position": "Grasp frame [m]: x blue, y vermilion, z green; thin and pale: where OSC wants it",
    "action": "Action: dx blue, dy vermilion, dz green, rx sky, ry orange, rz pink, close grey",
    "distance": "Object to goal [m]",
    "grip": "Contact force of the robot on the object [N]",
    "reward": "Reward and closing progress",
}
"""Of two lines there is a legend; more do not fit into it, so that the title tells them apart."""
SIGNALS = "signals"
WINDOW = 5.5
"""[s] around the time cursor that the curves show."""


class RolloutsPage:
    """Draws the page.

    Args:
        stream: to draw into.
        tolerance: [m] that counts as at the goal.
        root: entity that holds everything; one per robot that is compared.
    """

    def __init__(self, stream: Stream, tolerance: float, root: str = SIGNALS) -> None:
        self.stream, self.tolerance, self.root = stream, tolerance, root
        for key, lines in LINES.items():
            names, colours = zip(*lines, strict=True)
            widths = [1.0 if "wanted" in name or "tolerance" in name else 2.0 for name in names]
            stream.static(f"{self.root}/{key}", rr.SeriesLines(names=names, colors=colours, widths=widths))

    def act(self, times: np.ndarray, iteration: int, film: Film) -> None:
        """The curves of a film whose frames stand at times (T + 1,) [s]."""
        after = times[1 : len(film.qpos)]
        if len(after) == 0:
            return
        position = np.concatenate([film.target, film.grasp[1:]], axis=1)
        action = np.concatenate([np.clip(film.actions[:, :6], -1, 1), np.clip(closing_action(film.actions), -1, 1)[:, None]], axis=1)
        distance = np.stack([film.distance[1:], np.full(len(after), self.tolerance)], axis=1)
        reward = np.stack([film.rewards, film.closing], axis=1)
        gap = times[len(after)] + 1e-3  # a line would otherwise run on to the next episode
        for key, values in (("position", position), ("action", action), ("distance", distance), ("grip", film.grip[:, None]),
                            ("reward", reward)):
            ended = np.concatenate([values, np.full((1, values.shape[1]), np.nan)])
            columns = rr.Scalars.columns(scalars=ended.ravel()).partition([values.shape[1]] * len(ended))
            self.stream.rows(f"{self.root}/{key}", np.append(after, gap), iteration, columns)

    def caption(self, time: float, iteration: int, text: str) -> None:
        """What is seen from now on, as Markdown."""
        self.stream.row(f"{self.root}/caption", time, iteration, rr.TextDocument(text, media_type=rr.MediaType.MARKDOWN))


def rollouts_views(root: str = SIGNALS, whole: bool = False) -> dict[str, rrb.View]:
    """The page's curves and caption, of the robot under ``root``: around the cursor, or whole."""
    before, after = (rr.TimeRangeBoundary.cursor_relative(seconds=seconds) for seconds in (-WINDOW, WINDOW))
    window = None if whole else rrb.TimeAxis(view_range=rr.TimeRange(start=before, end=after))
    views: dict[str, rrb.View] = {
        key: rrb.TimeSeriesView(origin=f"{root}/{key}", name=title, axis_x=window,
                                plot_legend=rrb.PlotLegend(visible=len(LINES[key]) == 2, corner=rrb.Corner2D.RightTop))
        for key, title in TITLES.items()
    }
    views["caption"] = rrb.TextDocumentView(origin=f"{root}/caption", name="Episode")
    return views

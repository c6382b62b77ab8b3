"""The page of the rollouts: what an episode did, as curves under the robot's film.

    signals/position     [m] of the grasp frame, x y z, wanted by OSC and reached
    signals/action       the six OSC deltas and the closing action; signals/closing: the closing progress
    signals/distance     [m] from object to goal; signals/grip: [N] of the robot on the object; signals/reward
    signals/joints       of a family: [rad, m] of every hinge and slide; signals/action: of every actuator; signals/reward
    signals/caption      which episode it is, and how it ended
"""

from collections.abc import Iterable

import mujoco
import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from rerun.chunk import Chunk

from tasks.pick import PickTask
from toolkit.inspection.recording.stream import Stream
from toolkit.inspection.trajectory import PickTrajectory, Trajectory, closing_action
from toolkit.morphology.lab import Merged

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
MODEL_TITLES = {
    "joints": "Joints [rad or m] (the pointer tells which)", "action": "Action: share of each actuator's range", "reward": "Reward",
}
"""Of robots of a family."""
SIGNALS = "signals"
WINDOW = 5.5
"""[s] around the time cursor that the curves show."""


class RolloutsPage:
    """Draws the page.

    Args:
        stream: to draw into.
        merged: whose episodes are shown.
        root: entity that holds everything; one per robot that is compared.

    Attributes:
        pick: whether it is a pick.  tolerance: [m] that counts as at its goal, else None.
    """

    def __init__(self, stream: Stream, merged: Merged, root: str = SIGNALS) -> None:
        self.stream, self.root = stream, root
        task = merged.task
        self.pick, self._joints = isinstance(task, PickTask), np.zeros(0, int)
        self.tolerance: float | None = None
        if isinstance(task, PickTask):
            self.tolerance = task.goal_tolerance
            for key, lines in LINES.items():
                names, colours = zip(*lines, strict=True)
                widths = [1.0 if "wanted" in name or "tolerance" in name else 2.0 for name in names]
                stream.static(f"{self.root}/{key}", rr.SeriesLines(names=names, colors=colours, widths=widths))
            return
        model = merged.template
        scalar = np.flatnonzero(np.isin(model.jnt_type, (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE)))
        self._joints = model.jnt_qposadr[scalar]
        named = {"joints": [model.joint(joint).name for joint in scalar], "action": task.action.names, "reward": ["reward"]}
        for key, each in named.items():
            stream.static(f"{self.root}/{key}", rr.SeriesLines(names=list(each)))

    def act(self, times: np.ndarray, iteration: int, trajectory: Trajectory) -> None:
        """The curves of a trajectory whose frames stand at times (T + 1,) [s]."""
        after = times[1 : len(trajectory.qpos)]
        if len(after) == 0:
            return
        gap = times[len(after)] + 1e-3  # a line would otherwise run on to the next episode
        curves = self._of_pick(trajectory) if isinstance(trajectory, PickTrajectory) else self._of_model(trajectory)
        for key, values in curves.items():
            ended = np.concatenate([values, np.full((1, values.shape[1]), np.nan)])
            columns = rr.Scalars.columns(scalars=ended.ravel()).partition([values.shape[1]] * len(ended))
            self.stream.rows(f"{self.root}/{key}", np.append(after, gap), iteration, columns)

    def _of_model(self, trajectory: Trajectory) -> dict[str, np.ndarray]:
        """Curve -> (T, lines)."""
        actions, rewards = np.clip(trajectory.actions, -1, 1), trajectory.rewards[:, None]
        return {"joints": trajectory.qpos[1:, self._joints], "action": actions, "reward": rewards}

    def _of_pick(self, trajectory: PickTrajectory) -> dict[str, np.ndarray]:
        """Curve -> (T, lines)."""
        position = np.concatenate([trajectory.target, trajectory.grasp[1:]], axis=1)
        action = np.clip(np.column_stack([trajectory.actions[:, :6], closing_action(trajectory.actions)]), -1, 1)
        distance = np.stack([trajectory.distance[1:], np.full(len(trajectory.rewards), self.tolerance)], axis=1)
        reward = np.stack([trajectory.rewards, trajectory.closing], axis=1)
        return {"position": position, "action": action, "distance": distance, "grip": trajectory.grip[:, None], "reward": reward}

    def caption(self, time: float, iteration: int, text: str) -> None:
        """What is seen from now on, as Markdown."""
        self.stream.row(f"{self.root}/caption", time, iteration, rr.TextDocument(text, media_type=rr.MediaType.MARKDOWN))


def rollouts_views(root: str = SIGNALS, whole: bool = False, pick: bool = True) -> dict[str, rrb.View]:
    """The page's curves and caption, of the robot under ``root``: around the cursor, or whole; of a pick, or of a family's robot."""
    before, after = (rr.TimeRangeBoundary.cursor_relative(seconds=seconds) for seconds in (-WINDOW, WINDOW))
    window = None if whole else rrb.TimeAxis(view_range=rr.TimeRange(start=before, end=after))
    views: dict[str, rrb.View] = {
        key: rrb.TimeSeriesView(origin=f"{root}/{key}", name=title, axis_x=window,
                                plot_legend=rrb.PlotLegend(visible=pick and len(LINES[key]) == 2, corner=rrb.Corner2D.RightTop))
        for key, title in (TITLES if pick else MODEL_TITLES).items()
    }
    views["caption"] = rrb.TextDocumentView(origin=f"{root}/caption", name="Episode")
    return views


def recorded_pick(chunks: Iterable[Chunk]) -> bool:
    """Whether a recording is of picks, and not of a family's robots."""
    return all(chunk.entity_path != f"/{SIGNALS}/joints" for chunk in chunks)

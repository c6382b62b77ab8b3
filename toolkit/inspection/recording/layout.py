"""The layout of the viewer: one tab per page, on one timeline, so that nobody arranges panels by hand."""

from collections.abc import Callable

import numpy as np
import rerun.blueprint as rrb

from toolkit.inspection.recording.stream import FILM, ITERATION

Layout = Callable[[bool], rrb.Blueprint]
"""Makes the layout of a recording, or of an excerpt of it."""
PAGES = ("evolution", "morph", "rollouts", "learning", "summary")
SHARES = {"distance": 2, "position": 3, "joints": 4, "action": 3, "grip": 2, "reward": 2}
"""Of the height that an episode's curves have, in their order."""
BACKGROUND = (236, 239, 244)
Eye = tuple[np.ndarray, np.ndarray]
"""Where something is seen from (3,), and the point looked at (3,) [m]."""


def robot_view(name: str, eye: Eye) -> rrb.Spatial3DView:
    """The scene from somewhere, looking at some point."""
    controls = rrb.EyeControls3D(position=eye[0], look_target=eye[1], eye_up=(0.0, 0.0, 1.0))
    shown = ["+ $origin/**", "- $origin/robot/bones"]  # they run through the joints; who asks for them in the viewer sees them
    return rrb.Spatial3DView(origin="scene", contents=shown, name=name, eye_controls=controls, background=BACKGROUND, line_grid=False)


def pages_layout(views: Callable[[], dict[str, rrb.View]], page: str | None = None, timeline: str = FILM) -> rrb.Blueprint:
    """All pages as tabs, or one of them alone.

    Args:
        views: makes them by name, from the pages' own ``views``; anew for every page, as a view has one place only.
        page: one of PAGES; None: all.
        timeline: that is shown first.
    """
    wanted = [page] if page in PAGES else PAGES
    built = {name: container for name in wanted if (container := _page(name, views())) is not None}
    root = built[page] if page in built else rrb.Tabs(*built.values(), active_tab=0)
    return quiet_layout(root, timeline, moves=page != "summary")


def quiet_layout(root: rrb.Container | rrb.View, timeline: str, moves: bool = True) -> rrb.Blueprint:
    """A layout without the viewer's side panels, which play a timeline again and again."""
    return rrb.Blueprint(
        root,
        rrb.BlueprintPanel(state="hidden"),
        rrb.SelectionPanel(state="hidden"),
        rrb.TimePanel(state="collapsed" if moves else "hidden", timeline=timeline, loop_mode="all"),
        auto_views=False,
    )


def page_timeline(page: str | None) -> str:
    """The timeline on which a page reads best."""
    return ITERATION if page == "learning" else FILM


def _page(name: str, views: dict[str, rrb.View]) -> rrb.Container | None:
    have = lambda *keys: [views[key] for key in keys if key in views]  # noqa: E731
    if name == "evolution":
        paths = rrb.Vertical(views["tree"], rrb.Horizontal(*have("pca2", "pca3")))
        return rrb.Horizontal(paths, *have("alpha"), name="Evolution")
    if name == "morph" and "robot" in views:
        return rrb.Horizontal(views["robot"], rrb.Vertical(*have("tree", "changes"), row_shares=[2, 3]), column_shares=[3, 2], name="Morph")
    if name == "rollouts" and "scene" in views:
        left = rrb.Vertical(views["scene"], *have("caption"), row_shares=[4, 1])
        curves = {key: share for key, share in SHARES.items() if key in views}
        right = rrb.Vertical(*have(*curves), row_shares=list(curves.values()))
        return rrb.Horizontal(left, right, column_shares=[5, 4], name="Rollouts")
    if name == "learning":
        keys = have("success", "train_success", "mean_return", "kl", "sim_epochs", "train_iterations", "diverged", "wall")
        return rrb.Grid(*keys, grid_columns=4, name="Learning") if keys else None
    if name == "summary" and "summary" in views:
        beside = have("tree", "pca2")
        both = rrb.Horizontal(views["summary"], rrb.Vertical(*beside), column_shares=[3, 2], name="Summary")
        return both if beside else rrb.Vertical(views["summary"], name="Summary")
    return None

"""The layout: a tab per page of what a recording holds, and each page on the timeline on which it reads best."""

import pytest
import rerun.blueprint as rrb

from toolkit.inspection.recording.layout import PAGES, SHARES, page_timeline, pages_layout
from toolkit.inspection.recording.stream import FILM, ITERATION

CURVES = ("success", "train_success", "mean_return", "kl", "sim_epochs", "train_iterations", "diverged", "wall")
ALL = ("tree", "pca2", "pca3", "alpha", "changes", "robot", "scene", "caption", *SHARES, *CURVES, "summary")


def views(names=ALL):
    """Makes views of these names anew, each with its name as its origin."""
    return lambda: {name: rrb.TextDocumentView(origin=name, name=name) for name in names}


def origins(part):
    """Where the views of a container, and of those in it, look."""
    return [str(part.origin)] if isinstance(part, rrb.View) else [name for inner in part.contents for name in origins(inner)]


def test_the_pages_are_tabs_in_their_order():
    root = pages_layout(views()).root_container
    assert isinstance(root, rrb.Tabs) and [tab.name.lower() for tab in root.contents] == list(PAGES)
    shown = [set(origins(tab)) for tab in root.contents]
    assert set().union(*shown) == set(ALL), "every view has its page"
    assert shown[PAGES.index("rollouts")] == {"scene", "caption", *SHARES} and shown[PAGES.index("learning")] == set(CURVES)


def test_a_view_stands_in_one_place_only():
    """The viewer takes a view out of the page where it was before: each page needs its own."""
    ids = [view.id for tab in pages_layout(views()).root_container.contents for view in every_view(tab)]
    assert len(set(ids)) == len(ids)


def every_view(part):
    return [part] if isinstance(part, rrb.View) else [view for inner in part.contents for view in every_view(inner)]


@pytest.mark.parametrize("page", PAGES)
def test_one_page_alone_is_that_page(page):
    tabs = {tab.name.lower(): tab for tab in pages_layout(views()).root_container.contents}
    alone = pages_layout(views(), page).root_container
    assert alone.name == tabs[page].name and origins(alone) == origins(tabs[page])
    assert page_timeline(page) == (ITERATION if page == "learning" else FILM)


@pytest.mark.parametrize("names, pages", [
    (("tree", "pca2", "pca3"), ["evolution"]),  # a tree of anybody's points: no robots, no heat map
    (("tree", "pca2", "pca3", "robot", "changes"), ["evolution", "morph"]), (("tree", "summary"), ["evolution", "summary"]),
    (("tree", "scene", "caption", "joints", "reward"), ["evolution", "rollouts"]),  # of a family: no grip, no distance
])
def test_a_page_of_nothing_is_no_tab(names, pages):
    root = pages_layout(views(names)).root_container
    assert [tab.name.lower() for tab in root.contents] == pages
    assert set().union(*(origins(tab) for tab in root.contents)) == set(names)


def test_curves_have_their_shares_of_the_height():
    """In their order, whichever there are."""
    (page,) = [tab for tab in pages_layout(views(("tree", "scene", "reward", "joints"))).root_container.contents if tab.name == "Rollouts"]
    curves = page.contents[1]
    assert origins(curves) == ["joints", "reward"] and list(curves.row_shares) == [SHARES["joints"], SHARES["reward"]]

"""Figures of a run: what is drawn is what the run's records, its tree and its robots say."""

from io import BytesIO

import numpy as np
import pytest
from matplotlib.image import AxesImage
from PIL import Image

from toolkit.inspection.drawn_tree import Plan, matrix
from toolkit.inspection.report.figures import PANELS, curves_figure, heat_figure, png, projection_figure, strip_figure, tree_figure
from toolkit.morphology.parameters import Field, ParameterSpace

NODES = [{"name": name, "kind": kind, "alpha": alpha} for name, kind, alpha in
         [("s", "source", [0, 0, 0]), ("m", "meta", [1, 0, 0]), ("t", "target", [1, 1, 0]), ("u", "target", [1, 0, 3])]]
EDGES = [{"from": "s", "to": "m", "length": 1.0}, {"from": "m", "to": "t", "length": 1.0}, {"from": "m", "to": "u", "length": 3.0}]
PLAN = Plan({"nodes": NODES, "edges": EDGES})
COST = {"stage": "evolve", "train_iterations": 0, "check_episodes": 4, "diverged": 0}
RECORDS = [
    {"event": "check", "path": "path 1", "success": 0.5, "held": True, "sim_epochs": 0, **COST},
    {"event": "look", "path": "path 1", "success": 0.25, "held": False, "sim_epochs": 0, **COST},
    {"event": "update", "path": "path 1", "train_success": 0.4, "kl": 0.01, "mean_return": 0.2, "sim_epochs": 12, **COST},
    {"event": "check", "path": "path 2", "success": 0.75, "held": False, "sim_epochs": 0, **COST},
    {"event": "look", "path": "path 1", "success": 1.0, "held": True, "sim_epochs": 12, **COST},
]


def test_a_png_is_as_large_as_the_figure_says():
    figure = tree_figure(PLAN, [])
    assert Image.open(BytesIO(png(figure))).size == tuple(np.round(160 * figure.get_size_inches()).astype(int))


def test_walked_edges_are_darker_with_more_success_and_as_long_as_walked():
    axes = tree_figure(PLAN, [("s", "m", 1.0, 0.9), ("m", "u", 0.5, 0.2), ("m", "t", 0.25, None)]).axes[0]
    thick = [line for line in axes.lines if line.get_linewidth() > 4]
    grey = [float(line.get_color()) for line in thick]
    assert len(thick) == 3 and grey[0] < grey[2] < grey[1], "nine of ten, unknown, two of ten"
    along = [np.linalg.norm(np.diff(line.get_xydata()[-2:], axis=0)) for line in thick]
    whole = [np.linalg.norm(np.diff(PLAN.stretch(edge, 0.0, 1.0)[-2:], axis=0)) for edge in (EDGES[0], EDGES[2], EDGES[1])]
    np.testing.assert_allclose(along, np.array(whole) * [1.0, 0.5, 0.25])
    texts = {text.get_text() for text in axes.texts}
    assert {"success 90%", "success 20%", "walked", "1.0", "3.0", "s", "m", "t", "u"} == texts


def test_the_projection_shows_the_ways_in_the_plane_of_most_variance():
    way = np.array([[0, 0, 0], [1, 0, 0], [1, 0, 1.5]])
    axes = projection_figure(PLAN, [way]).axes[0]
    (walked,) = [line for line in axes.lines if line.get_color() == "black" and len(line.get_xdata()) == 3]
    points = np.array([node["alpha"] for node in NODES], float)
    _, _, directions = np.linalg.svd(points - points.mean(axis=0))
    scale = 10 / np.abs((points - points.mean(axis=0)) @ directions.T).max()  # the farthest robot lies at 10
    wanted = scale * (way - points.mean(axis=0)) @ directions[:2].T
    np.testing.assert_allclose(np.abs(walked.get_xydata()), np.abs(wanted), atol=1e-9)
    assert {text.get_text() for text in axes.texts} == {"s", "m", "t", "u"}


def test_a_robots_matrix_is_its_alpha():
    """Each number in its own cell; no cell that no dimension has."""
    values = np.array([[[1.0, 5.0], [2.0, 0.0]], [[2.0, 0.0], [5.0, 1.0]]])
    fields = [Field(name, ("arm1", "arm2"), ("arm1", "arm2"), ("x", "y"), "m", values + shift)
              for name, shift in (("anchor", 0.0), ("com", np.array([[[0.0, 0], [0, 3]], [[7, 0], [0, 0]]])))]
    space = ParameterSpace(["hand", "arm"], fields)
    robots = {"hand": space.betas[0], "between": np.linspace(0.2, 0.8, space.size)}
    panels = heat_figure(space, robots).axes
    assert [panel.get_title(loc="left") for panel in panels] == ["hand", "between"]
    places, rows, _ = matrix(space)
    for panel, alpha in zip(panels, robots.values(), strict=True):
        (image,) = [artist for artist in panel.get_children() if isinstance(artist, AxesImage)]
        shown = np.ma.filled(image.get_array(), np.nan)
        np.testing.assert_allclose(shown[places[:, 1].astype(int), places[:, 0].astype(int)], alpha)
        assert np.isfinite(shown).sum() == space.size and [label.get_text() for label in panel.get_yticklabels()] == rows


def test_curves_have_a_point_per_record_and_short_ones_are_hollow():
    figure = curves_figure(RECORDS)
    panels = {panel.get_title(loc="left"): panel for panel in figure.axes}
    titles = {key: title for key, (_, _, title) in PANELS.items()}
    assert list(panels) == [titles[key] for key in ("success", "train_success", "mean_return", "kl", "sim_epochs")], "nothing diverged"
    solid = {line.get_label(): line.get_xydata().tolist() for line in panels[titles["success"]].lines if line.get_linestyle() != "None"}
    assert solid == {"path 1": [[0, 0.5], [4, 1.0]], "path 2": [[3, 0.75]]}, "a look that held is a check, one that did not is none"
    (hollow,) = [line for line in panels[titles["success"]].lines if line.get_markerfacecolor() == "white"]
    assert hollow.get_xydata().tolist() == [[3, 0.75]]
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["path 1", "path 2"]
    assert panels[titles["sim_epochs"]].lines[0].get_xydata().tolist() == [[0, 0], [1, 0], [2, 12], [4, 12]]


def test_before_the_first_record_there_is_one_empty_panel():
    (panel,) = curves_figure([]).axes
    assert panel.get_title(loc="left") == PANELS["success"][2] and panel.texts[0].get_text() == "none yet"


@pytest.mark.parametrize("count", [1, 4, 7])
def test_a_strip_shows_each_still_with_its_share(count):
    pictures = [np.full((4, 6, 3), 30 * k, np.uint8) for k in range(count)]
    shares = np.linspace(0, 1, count)
    figure = strip_figure("adroit to jaco", pictures, shares)
    shown = [panel for panel in figure.axes if panel.images]
    assert len(figure.axes) == 4 * -(-count // 4) and [panel.get_title() for panel in shown] == [f"{share:.0%}" for share in shares]
    for panel, picture in zip(shown, pictures, strict=True):
        np.testing.assert_array_equal(panel.images[0].get_array(), picture)

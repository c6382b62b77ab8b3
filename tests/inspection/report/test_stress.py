"""The picture of a stress test: every value tried stands where it was, and what is borne is shaded."""

import numpy as np
import pytest
from matplotlib.figure import Figure
from PIL import Image

from toolkit.evaluation.stress import CONDITIONS, GOOD, Tried
from toolkit.inspection.report.stress import COLUMNS, stress_figure

TRIED = [
    Tried({}, 20, 20), Tried({"delay": 2.0}, 20, 18), Tried({"delay": 1.0}, 20, 19), Tried({"delay": 3.0}, 20, 4),
    Tried({"object_mass": 0.5}, 20, 2), Tried({"object_mass": 2.0}, 20, 20), Tried({"yaw_error": 0.17}, 20, 20),
    Tried({"table_height": -0.01}, 20, 20), Tried({"delay": 1.0, "object_mass": 2.0}, 20, 0),
]


@pytest.fixture
def drawn(tmp_path, monkeypatch):
    """The figure that is written."""
    kept, save = [], Figure.savefig
    monkeypatch.setattr(Figure, "savefig", lambda figure, *rest, **more: (kept.append(figure), save(figure, *rest, **more)))
    stress_figure("jaco", TRIED, tmp_path / "stress.png")
    assert Image.open(tmp_path / "stress.png").size[0] > 1000
    return kept[0]


def test_each_condition_has_its_panel_with_what_was_tried_alone(drawn):
    """Rising, the nominal value among them; a pair of conditions is no point of either."""
    panels = {panel.get_title().replace(" ", "_"): panel for panel in drawn.axes if panel.axison}
    assert list(panels) == ["delay", "object_mass", "yaw_error", "table_height"] and len(drawn.axes) == 2 * COLUMNS
    line = next(line for line in panels["delay"].lines if len(line.get_xdata()) == 4)
    np.testing.assert_array_equal(line.get_xydata(), [[0, 1.0], [1, 0.95], [2, 0.9], [3, 0.2]])
    assert panels["object_mass"].get_xlabel() == "times its own" and panels["yaw_error"].get_xlabel() == CONDITIONS["yaw_error"].unit
    assert all(GOOD in np.ravel(panel.lines[0].get_ydata()) for panel in panels.values()), "the line that is asked for"
    assert "jaco" in drawn.get_suptitle() and "20 episodes" in drawn.get_suptitle()


@pytest.mark.parametrize("name, borne", [("delay", (0, 2)), ("object_mass", (1, 2)), ("table_height", (-0.01, 0))])
def test_what_is_borne_is_shaded(drawn, name, borne):
    """By hand: up to the last value from the nominal one with nine of ten."""
    (panel,) = [panel for panel in drawn.axes if panel.get_title() == name.replace("_", " ")]
    (shade,) = panel.patches
    assert (shade.get_x(), shade.get_x() + shade.get_width()) == pytest.approx(borne)

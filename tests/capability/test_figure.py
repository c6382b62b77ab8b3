"""A picture of an audit shows what was measured."""

from toolkit.capability.figure import ROWS, audit_figure


def test_a_picture_has_rows_for_what_was_measured_alone():
    robot = dict.fromkeys(ROWS) | {"grip_n": 20.0}
    edges = [{"from": "s", "to": name, "turn": None, "violations": [],
              "robots": [robot | {"share": share, "height_mm": 3.0 + share if name == "a" else None} for share in (0.0, 1.0)]}
             for name in ("a", "b")]
    panels = audit_figure(edges).axes
    assert len(panels) == 4 and [axes.get_ylabel() for axes in panels if axes.get_ylabel()] == ["grip [N]", "height [mm]"]
    assert [len(axes.lines) > 0 for axes in panels] == [True, True, True, False], "b was not measured for height"

"""Tables and documents on a terminal of any width, and in a file."""

import re

import pytest

from toolkit.cli import main

pytestmark = pytest.mark.usefixtures("at_home")


@pytest.mark.parametrize("width", [40, 200])
def test_a_narrow_terminal_breaks_no_name(capsys, monkeypatch, width):
    """On a terminal of any width every name of a table is there in one piece."""
    import rich.console

    from robots import ROBOTS

    monkeypatch.setattr(rich.console.Console, "is_terminal", True)
    monkeypatch.setenv("COLUMNS", str(width))
    main(["robots"])
    out = re.sub(r"\x1b\[[0-9;]*m", "", capsys.readouterr().out).split("Tasks:")[0]
    assert max(map(len, out.splitlines())) <= width
    for robot in ROBOTS.values():
        assert robot.name in out.split() and robot.gripper.robosuite_type in out.split(), out


def test_a_document_is_drawn_on_a_terminal_alone(capsys, monkeypatch):
    import rich.console

    from toolkit.cli.terminal import document

    text = "# adroit to jaco\n\n| target | unmodified robot |\n|---|---|\n| jaco | 3 of 4 |\n"
    document(text)
    assert capsys.readouterr().out == text + "\n", "a file gets Markdown"
    monkeypatch.setattr(rich.console.Console, "is_terminal", True)
    document(text)
    out = capsys.readouterr().out
    assert "|---|" not in out and "3 of 4" in out and "─" in out

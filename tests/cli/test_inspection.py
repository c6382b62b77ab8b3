"""view, report and doctor: what cannot be looked at is said before the work; every check that fails has its mend."""

import json
import time
from pathlib import Path

import pytest
from command_line import refusal

from toolkit.cli import main
from toolkit.runs.run import Run

pytestmark = pytest.mark.usefixtures("at_home")


def test_viewing_what_has_no_recording(capsys, trained):
    assert f"no recording at {trained}" in refusal(capsys, "view", trained)
    assert "make it with --rebuild" in refusal(capsys, "view", trained)


@pytest.mark.parametrize("option, name", [("--still", "a.jpg"), ("--still", "a"), ("--video", "a.avi"), ("--video", "a")])
def test_a_picture_or_film_that_cannot_be_is_refused_before_the_work(capsys, trained, option, name):
    said = refusal(capsys, "view", trained, option, name)
    assert f"cannot be written to {name}; name a {'.png file' if option == '--still' else '.mp4 or .gif file'}" in said
    assert not Path(name).exists()


def test_viewing_needs_one_run_or_two_to_compare(capsys, trained):
    assert "takes one run folder" in refusal(capsys, "view", trained, trained)
    assert "compare two targets" in refusal(capsys, "view", trained, "--compare", "kinova3")


@pytest.mark.parametrize("command", [["view", "nowhere", "--rebuild"], ["report", "nowhere"]])
def test_looking_at_what_is_no_run(capsys, command):
    assert "nowhere does not exist" in refusal(capsys, *command)


def test_following_waits_for_a_run_that_is_still_to_begin(capsys, monkeypatch):
    """A Ctrl-C while it waits is no failure; a folder of something else is refused at once."""
    Run.create("other", {"colour": "green"})
    assert "no transfer's run folder" in refusal(capsys, "view", "other", "--live")

    def interrupted(seconds):
        raise KeyboardInterrupt

    monkeypatch.setattr(time, "sleep", interrupted)
    main(["view", "nowhere", "--live"])
    said = capsys.readouterr().out
    assert "waiting for the transfer of nowhere to begin" in said and "stopped looking" in said and not Path("nowhere").exists()


@pytest.mark.slow
def test_doctor(capsys):
    try:
        main(["doctor", "--json"])
        status = 0
    except SystemExit as stop:
        status = stop.code
    found = json.loads(capsys.readouterr().out)["checks"]
    assert all({"name", "ok", "detail", "mend"} == row.keys() and row["ok"] in (True, False, None) for row in found)
    assert {"python", "mujoco", "robosuite", "torch"} <= {row["name"] for row in found}
    assert status == (1 if any(row["ok"] is False for row in found) else 0)
    assert all(row["mend"] for row in found if row["ok"] is False), "a broken thing without a word on how to mend it"

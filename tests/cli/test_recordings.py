"""recordings: a stand-in is made and listed, and what is broken or missing is said."""

import json
from pathlib import Path

import pytest
from command_line import answer, refusal

from toolkit.cli import main
from toolkit.cli.names import TASK

pytestmark = pytest.mark.usefixtures("at_home")


def test_a_standin_is_made_listed_and_refused_when_broken(capsys):
    made = answer(capsys, "recordings", "make", "hands", "--objects", TASK, "--each", 2, "--frames", 10)
    assert made["synthetic"] and len(made["recordings"]) == 2 and 0 < made["bytes"] < 10**6
    listed = answer(capsys, "recordings", "list", "hands", "--frame-rate", 30)
    assert [row["recording"] for row in listed["recordings"]] == made["recordings"] and listed["broken"] == []
    assert {row["object"] for row in listed["recordings"]} == {TASK} and listed["recordings"][0]["seconds"] == pytest.approx(0.33)
    assert "hands exists and is not an empty folder" in refusal(capsys, "recordings", "make", "hands")
    assert "cup" in refusal(capsys, "recordings", "make", "more", "--objects", "cup")
    (Path("hands") / made["recordings"][0] / "pose.npz").unlink()
    with pytest.raises(SystemExit) as stop:
        main(["recordings", "list", "hands", "--json"])
    out, err = capsys.readouterr()
    listed = json.loads(out)
    assert stop.value.code == 2 and "pose.npz: expected a file, found none" in err
    assert [row["recording"] for row in listed["recordings"]] == made["recordings"][1:] and len(listed["broken"]) == 1


@pytest.mark.parametrize("command", [("list", "nowhere"), ("retarget", "nowhere")])
def test_a_folder_without_recordings_is_said(capsys, command):
    assert "expected folders <subject>/<time>/meta.yml, found none" in refusal(capsys, "recordings", *command)

"""Names: what is unknown, named twice or not yet there is said in one sentence, with what there is."""

from pathlib import Path

import pytest
from command_line import refusal

from toolkit.runs.run import Run

pytestmark = pytest.mark.usefixtures("at_home")


@pytest.mark.parametrize("command", ["match", "tree", "transfer", "expert"])
def test_an_unknown_source_is_named(capsys, command):
    said = refusal(capsys, command, "--source", "panda9000")
    assert "'panda9000' is unknown" in said and "adroit, iiwa, jaco, kinova3" in said


@pytest.mark.parametrize("command", ["match", "tree", "transfer"])
def test_an_unknown_target_is_named(capsys, command):
    assert "'panda9000' is unknown" in refusal(capsys, command, "--targets", "jaco", "panda9000")


@pytest.mark.parametrize("command", ["transfer", "expert"])
def test_an_unknown_task_is_named(capsys, command):
    assert "'juggle' is unknown; there are: 061_foam_brick" in refusal(capsys, command, "--task", "juggle")


@pytest.mark.parametrize("command", ["match", "tree", "transfer"])
def test_a_source_among_the_targets_is_refused(capsys, learner, command):
    said = refusal(capsys, command, "--source", "adroit", "--targets", "jaco", "adroit")
    assert said == "'adroit' is both source and target; leave it out of the targets"


def test_a_robot_named_twice_is_refused(capsys, learner):
    assert "name each once" in refusal(capsys, "transfer", "--targets", "jaco", "jaco")


@pytest.mark.parametrize("arguments", [["evaluate"], ["export", "--out", "bundle"]])
def test_an_unknown_target_of_a_run_is_named(capsys, trained, arguments):
    said = refusal(capsys, arguments[0], trained, "--target", "panda9000", *arguments[1:])
    assert said == f"target 'panda9000' is not in {trained}; it has: kinova3, iiwa"
    assert not Path("bundle").exists()


@pytest.mark.parametrize("arguments", [["evaluate"], ["export", "--target", "kinova3", "--out", "bundle"]])
def test_a_config_of_something_else_is_refused(capsys, arguments):
    Run.create("other", {"colour": "green"})
    refusal(capsys, arguments[0], "other", *arguments[1:])


@pytest.mark.parametrize("arguments", [["evaluate"], ["export", "--target", "kinova3", "--out", "bundle"]])
def test_advice_fits_the_command(capsys, arguments):
    assert "--resume" not in refusal(capsys, arguments[0], "nowhere", *arguments[1:])

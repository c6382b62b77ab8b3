"""evaluate: runs and experts alike, and one sentence for what cannot be evaluated."""

from pathlib import Path

import numpy as np
import pytest
from command_line import answer, refusal

from toolkit.cli.names import TASK, find_task
from toolkit.runs.run import Run

pytestmark = pytest.mark.usefixtures("at_home")


def test_evaluating_what_is_no_run(capsys, tmp_path):
    (tmp_path / "folder").mkdir()
    assert "holds no config.json, so it is not a run folder" in refusal(capsys, "evaluate", "folder")
    assert "nowhere does not exist" in refusal(capsys, "evaluate", "nowhere")


def test_evaluating_a_torn_config(capsys, trained):
    (Path(trained) / "config.json").write_text('{"source": "adr')
    assert "truncated or damaged" in refusal(capsys, "evaluate", trained)


def test_evaluating_before_the_policy_is_there_says_how_to_finish(capsys, trained):
    said = refusal(capsys, "evaluate", trained, "--target", "iiwa")
    assert said.endswith(f"finish it with: meta-evolve transfer --run {trained} --resume")


def test_evaluating_an_expert_before_it_is_trained_says_how_to_finish(capsys):
    Run.create("expert", {"source": "adroit", "task": TASK, "demos": None})
    assert "finish it with its own command and --resume" in refusal(capsys, "evaluate", "expert")


def test_an_expert_has_one_target_its_source(capsys):
    name = f"adroit-{TASK}"
    assert refusal(capsys, "evaluate", name, "--target", "iiwa") == f"target 'iiwa' is not in {name}; it has: adroit"
    assert "task 'juggling' is unknown" in refusal(capsys, "evaluate", name, "--task", "juggling")


@pytest.mark.parametrize("kept", ["name", "folder"])
def test_an_expert_is_evaluated_by_name_and_from_its_run_folder(capsys, monkeypatch, kept):
    from toolkit.evaluation import success as evaluation
    from toolkit.expert.shelf import load_expert

    policy, _ = load_expert("adroit", find_task(TASK))
    Run.create("expert", {"source": "adroit", "task": TASK, "demos": None})
    policy.save(Path("expert/adroit.policy.safetensors"))
    asked = []

    def played(policy, robot, task, episodes, seed, progress, cluster):
        asked.append((policy.parameters, robot.name, task.name))
        return evaluation.Evaluation(robot.name, "native", episodes, episodes, 0, seed)

    monkeypatch.setattr(evaluation, "evaluate_native", played)
    found = answer(capsys, "evaluate", f"adroit-{TASK}" if kept == "name" else "expert", "--task", f"{TASK}-wide", "--native")
    assert (found["target"], found["env"], found["episodes"]) == ("adroit", "native", 100)
    (parameters, robot, task), = asked
    assert (robot, task) == ("adroit", f"{TASK}-wide")
    np.testing.assert_array_equal(parameters, policy.parameters)


def test_evaluating_a_damaged_policy(capsys, trained):
    file = Path(trained) / "kinova3.policy.safetensors"
    file.write_bytes(file.read_bytes()[:-40])
    assert "is damaged" in refusal(capsys, "evaluate", trained, "--target", "kinova3")


@pytest.mark.parametrize("option, value", [("--episodes", 0), ("--episodes", -3), ("--seed", -2000)])
def test_an_evaluation_of_nothing_is_refused(capsys, trained, option, value):
    assert str(value) in refusal(capsys, "evaluate", trained, "--target", "kinova3", "--native", "--episodes", 1, option, value)

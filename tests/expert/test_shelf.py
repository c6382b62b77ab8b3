"""Experts by name: saved, found, refused, and those that come with the package."""

import json
import shlex
from dataclasses import replace

import numpy as np
import pytest

from robots import MODEL_ROBOTS, ROBOTS
from tasks import MODEL_TASKS, TASKS
from tasks.pick import ACTION, OBSERVATION
from tasks.task import PractisedTask
from toolkit.errors import ToolkitError
from toolkit.evaluation.success import evaluate_merged
from toolkit.expert.shelf import RECORDED, SHIPPED, expert_files, load_expert, save_expert, shipped_experts, shipped_pair
from toolkit.expert.training import new_learner
from toolkit.learning.policy import GaussianPolicy, ValueFunction

SOURCE = "adroit"
CARDS = sorted(SHIPPED.glob("*.json"))
pytestmark = pytest.mark.usefixtures("log_elsewhere")


def named(title):
    """A pick of another name."""
    return replace(TASKS["061_foam_brick"], title=title)


def test_an_expert_comes_back_as_it_was_saved(tmp_path, monkeypatch):
    policy, value = new_learner(TASKS["061_foam_brick"], 3)
    save_expert(policy, value, tmp_path / "new" / "folder", "arm-cup", {"command": "made by hand"})
    monkeypatch.setattr("toolkit.expert.shelf.SHIPPED", tmp_path / "new" / "folder")
    again, critic = load_expert("arm", named("cup"))
    np.testing.assert_array_equal(again.parameters, policy.parameters)
    np.testing.assert_array_equal(critic.parameters, value.parameters)
    assert json.loads((tmp_path / "new" / "folder" / "arm-cup.json").read_text()) == {"command": "made by hand"}


def test_any_expert_can_be_named(tmp_path, monkeypatch):
    policy, value = new_learner(TASKS["061_foam_brick"], 3)
    save_expert(policy, value, tmp_path, "arm-cup-recordings", {})
    np.testing.assert_array_equal(load_expert("arm", named("cup"), str(tmp_path / "arm-cup-recordings"))[0].parameters, policy.parameters)
    monkeypatch.setattr("toolkit.expert.shelf.SHIPPED", tmp_path)
    np.testing.assert_array_equal(load_expert("arm", named("mug"), "arm-cup-recordings")[0].parameters, policy.parameters)
    with pytest.raises(ToolkitError, match="there is no expert 'arm-mug'.*arm-cup-recordings"):
        load_expert("arm", named("cup"), "arm-mug")


@pytest.mark.parametrize("source, task", [("jaco", "061_foam_brick"), ("adroit", "juggling"), ("", "cup")])
def test_an_unknown_pair_gets_the_command_that_trains_it(source, task):
    with pytest.raises(ToolkitError) as refused:
        load_expert(source, named(task))
    said = str(refused.value)
    assert f"no expert is shipped for source {source!r} and task {task!r}" in said and "adroit-061_foam_brick" in said
    assert shlex.split(said.rsplit("train one with: ", 1)[1]) == ["meta-evolve", "expert", "--source", source, "--task", task]


def test_a_scripted_expert_goes_before_a_recorded_one_and_the_task_before_its_wide_variant(tmp_path, monkeypatch):
    monkeypatch.setattr("toolkit.expert.shelf.SHIPPED", tmp_path)
    order = ["arm-cup-wide-recordings", "arm-cup-recordings", "arm-cup-wide", "arm-cup"]
    for name in order:
        save_expert(*new_learner(TASKS["061_foam_brick"], 0), tmp_path, name, {})
        assert expert_files("arm", "cup") == (tmp_path / f"{name}.policy.safetensors", tmp_path / f"{name}.value.safetensors")
    assert expert_files("arm", "cup-wide")[0].name == "arm-cup-wide.policy.safetensors"
    assert shipped_experts() == sorted(order) and {shipped_pair(name)[1] for name in order} == {"cup", "cup-wide"}


def test_the_expert_of_a_task_serves_its_variants_that_have_none(tmp_path, monkeypatch):
    plain, lighter = MODEL_TASKS["door"], MODEL_TASKS["door-light-staged"]
    served = load_expert("adroit-free", lighter)[0]
    np.testing.assert_array_equal(served.parameters, load_expert("adroit-free", plain)[0].parameters)
    monkeypatch.setattr("toolkit.expert.shelf.SHIPPED", tmp_path)
    with pytest.raises(ToolkitError, match="task 'door-light-staged'"):
        load_expert("adroit-free", lighter)
    for seed, task in enumerate((plain, lighter)):
        policy, value = new_learner(task, seed)
        save_expert(policy, value, tmp_path, f"adroit-free-{task.name}", {})
        np.testing.assert_array_equal(load_expert("adroit-free", lighter)[0].parameters, policy.parameters)


def test_a_pair_of_which_half_is_missing_is_refused(tmp_path, monkeypatch):
    policy, value = new_learner(TASKS["061_foam_brick"], 0)
    save_expert(policy, value, tmp_path, "arm-cup", {})
    (tmp_path / "arm-cup.value.safetensors").unlink()
    monkeypatch.setattr("toolkit.expert.shelf.SHIPPED", tmp_path)
    with pytest.raises(ToolkitError, match="arm-cup.value.safetensors does not exist"):
        load_expert("arm", named("cup"))


def test_the_headline_expert_is_shipped():
    assert f"{SOURCE}-061_foam_brick" in [card.stem for card in CARDS]


@pytest.mark.parametrize("card", CARDS, ids=lambda card: card.stem)
def test_a_shipped_expert_explains_itself(card):
    source, name = shipped_pair(card.stem, MODEL_ROBOTS)
    task = (TASKS | MODEL_TASKS)[name]
    assert source in (MODEL_ROBOTS if name in MODEL_TASKS else ROBOTS)
    files = [card.with_name(f"{card.stem}.{kind}.safetensors") for kind in ("policy", "value")]
    policy = GaussianPolicy.load(files[0], task.observation.names, task.action.names)
    assert policy.observation_names == ValueFunction.load(files[1], task.observation.names).observation_names
    size = sum(file.stat().st_size for file in (*files, card))
    assert size < 10**6, f"{size / 1e6:.1f} MB"
    content = json.loads(card.read_text())
    words = shlex.split(content["command"])
    assert words[:2] == ["meta-evolve", "expert"]
    given = dict(zip(words[2::2], words[3::2], strict=True))
    assert (given["--source"], given["--task"]) == (source, name) and int(given["--seed"]) >= 0
    if isinstance(task, PractisedTask):
        assert "--demos" not in given and content["updates"] <= int(given["--updates"]) and content["policy_steps"] > 10**6
    else:
        assert ("--demos" in given) == (card.stem.endswith(RECORDED) or name in MODEL_TASKS)
        assert int(given["--demonstrations"]) == content["demonstrations"] >= content["demonstrations_kept"] > 0
    result = content["evaluation"]
    assert result["target"] == source and result["env"] in ("native", "native-compiled") and result["episodes"] >= 100
    assert result["success_rate"] == result["successes"] / result["episodes"] >= 0.8, result


@pytest.mark.parametrize("card", [card for card in CARDS if "061_foam_brick" in card.stem], ids=lambda card: card.stem)
def test_a_shipped_expert_succeeds_on_the_merged_source(engine, card):
    file = card.with_name(f"{card.stem}.policy.safetensors")
    policy = GaussianPolicy.load(file, OBSERVATION.names, ACTION.names)
    result = evaluate_merged(policy, engine, SOURCE, 8, seed=77)
    assert result.successes >= 7, f"{result.successes} of 8 unseen seeds on F(beta_0)"

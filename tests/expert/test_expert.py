"""The source expert: a script that succeeds, a clone that follows it, and the experts that come with the package."""

import json
import re
import shlex
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import toolkit
from robots import MODEL_ROBOTS, ROBOTS
from tasks import MODEL_TASKS, TASKS
from tasks.objects import OBJECTS
from tasks.pick import ACTION, ACTION_SIZE, OBSERVATION, OBSERVATION_SIZE
from tasks.task import PractisedTask
from toolkit.demonstrations.scripts import FINGER_DEPTH, PickScript, entry, pick_script
from toolkit.errors import ToolkitError
from toolkit.evaluation.success import evaluate_merged
from toolkit.expert.shelf import RECORDED, SHIPPED, expert_files, load_expert, save_expert, shipped_experts, shipped_pair
from toolkit.expert.training import OBSERVATION_NOISE, ExpertConfig, NoisyScript, _with_noise, new_learner, train_expert
from toolkit.learning.cloning import CloningConfig
from toolkit.learning.npg import NpgConfig
from toolkit.learning.policy import GaussianPolicy, ValueFunction
from toolkit.runs.run import Run
from toolkit.runs.seeds import DEMONSTRATION_SEEDS, EVALUATION_SEEDS

SOURCE = "adroit"
CARDS = sorted(SHIPPED.glob("*.json"))


pytestmark = pytest.mark.usefixtures("log_elsewhere")


@pytest.fixture(scope="module")
def demonstrations(engine):
    beta = engine.merged.space.beta(SOURCE)
    return engine.play(NoisyScript(PickScript(), 0.12), [beta] * 8, list(range(DEMONSTRATION_SEEDS, DEMONSTRATION_SEEDS + 8)))


# -- the script ----------------------------------------------------------------------------------------------


def test_the_script_demonstrates_under_noise(demonstrations):
    kept = sum(episode.success for episode in demonstrations)
    assert kept >= 6, f"{kept} of 8 noisy demonstrations succeed on F(beta_0)"
    assert not any(episode.diverged for episode in demonstrations)


def test_the_script_reads_the_observation_alone(demonstrations):
    """So its label at a remembered observation is what it wanted there; the noise went into the motion only."""
    script = PickScript()
    episode = demonstrations[0]
    wanted = np.array([script(observation) for observation in episode.observations])
    apart = episode.actions - wanted
    assert np.abs(wanted).max() <= 1.0 and wanted.shape[1] == ACTION_SIZE
    assert 0.06 < apart[:, :6].std() < 0.2, f"motion noise has deviation {apart[:, :6].std():.3f}, not 0.12"
    assert 0.02 < apart[:, 6:].std() < 0.06, f"finger noise has deviation {apart[:, 6:].std():.3f}, not 0.036"


def test_the_script_does_not_look_at_fingers():
    """So that one hand's posture never becomes part of the label."""
    rng, script = np.random.default_rng(0), PickScript()
    fingers = sum(name.startswith("finger/") for name in OBSERVATION)
    for _ in range(50):
        observation = 0.1 * rng.standard_normal(OBSERVATION_SIZE)
        other = observation.copy()
        other[:fingers] += 0.3 * rng.standard_normal(fingers)
        np.testing.assert_array_equal(script(observation), script(other))


# -- the data ------------------------------------------------------------------------------------------------


def test_noisy_copies_keep_the_original_and_the_label_of_what_is_seen(demonstrations):
    script, rng = PickScript(), np.random.default_rng(0)
    observations = demonstrations[0].observations
    seen, labels = _with_noise(observations, script, 20, rng)
    assert seen.shape == (21 * len(observations), OBSERVATION_SIZE) and labels.shape == (len(seen), ACTION_SIZE)
    np.testing.assert_array_equal(seen[: len(observations)], observations)
    for i in rng.integers(len(seen), size=50):
        np.testing.assert_array_equal(labels[i], script(seen[i]))
    noise = (seen - np.tile(observations, (21, 1)))[len(observations) :].std(axis=0)
    worst = float(np.abs(noise / OBSERVATION_NOISE - 1).max())
    assert worst < 0.15, f"an entry's noise is {worst:.0%} from its OBSERVATION_NOISE"


def test_finger_noise_alone_keeps_every_label(demonstrations, monkeypatch):
    fingers = np.array([name.startswith("finger/") for name in OBSERVATION.names])
    monkeypatch.setattr("toolkit.expert.training.OBSERVATION_NOISE", np.where(fingers, OBSERVATION_NOISE, 0.0))
    observations = demonstrations[0].observations
    seen, labels = _with_noise(observations, PickScript(), 3, np.random.default_rng(0))
    assert (seen[len(observations) :, fingers] != np.tile(observations, (3, 1))[:, fingers]).all()
    np.testing.assert_array_equal(seen[:, ~fingers], np.tile(observations, (4, 1))[:, ~fingers])
    np.testing.assert_array_equal(labels, np.tile(labels[: len(observations)], (4, 1)))


def test_names_are_one_per_number():
    assert len(OBSERVATION.names) == OBSERVATION_SIZE and len(ACTION.names) == ACTION_SIZE
    observation = np.arange(OBSERVATION_SIZE, dtype=float)
    assert entry(observation, "goal_from_object")[-1] == OBSERVATION_SIZE - 1


BLOCK = 10**6


def test_no_two_purposes_share_seeds():
    """Every constant of the package that names seeds is the first of its own million, and evaluation's are above them all."""
    named = re.compile(r"^(\w+_SEEDS) = (.+)$", re.MULTILINE)
    found = {
        (file.stem, name): eval(value, {"__builtins__": {}})
        for file in sorted(Path(toolkit.__file__).parent.rglob("*.py"))
        for name, value in named.findall(file.read_text())
    }
    assert {file for file, _ in found} == {"seeds"}, "seeds are named in one file"
    assert found.pop(("seeds", "EVALUATION_SEEDS")) == EVALUATION_SEEDS
    assert found.pop(("seeds", "TRAINING_SEEDS")) == BLOCK, "training's seeds are the first million"
    assert {("seeds", "EXPERT_SEEDS"), ("seeds", "VISIT_SEEDS"), ("seeds", "DEMONSTRATION_SEEDS")} <= found.keys()
    blocks = {name: divmod(first, BLOCK) for name, first in found.items()}
    assert len({block for block, _ in blocks.values()}) == len(blocks) and all(rest == 0 for _, rest in blocks.values()), blocks
    assert all(0 < block and (block + 1) * BLOCK <= EVALUATION_SEEDS for block, _ in blocks.values()), blocks


# -- training ------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_few_demonstrations_are_cloned(engine):
    events = []
    config = ExpertConfig(demonstrations=6, copies=2, updates=1, cloning=CloningConfig(epochs=8), npg=NpgConfig(batch_size=4))
    policy, value, card = train_expert(engine, SOURCE, config, events.append)
    losses = [record["loss"] for record in events if record["event"] == "cloning"]
    assert len(losses) == 8 and losses[-1] < 0.7 * losses[0], f"cloning went from {losses[0]:.3f} to {losses[-1]:.3f}"
    assert card["demonstrations"] == 6 and 1 <= card["demonstrations_kept"] <= 6
    assert [record["event"] for record in events].count("update") == 1
    script, fresh = PickScript(), new_learner(TASKS["061_foam_brick"], 0)[0]
    beta = engine.merged.space.beta(SOURCE)
    seen = np.concatenate([e.observations for e in engine.play(script, [beta] * 2, [900, 901])])
    wanted = np.array([script(observation) for observation in seen])
    far = {name: float(np.abs(p.mean(seen) - wanted).mean()) for name, p in (("clone", policy), ("fresh", fresh))}
    assert far["clone"] < 0.5 * far["fresh"], f"mean distance to the script on unseen seeds: {far}"
    assert np.isfinite(value.parameters).all()


def test_no_demonstration_at_all_is_said(engine):
    with pytest.raises(ToolkitError, match="none of 0 scripted demonstrations succeeds on adroit"):
        train_expert(engine, SOURCE, ExpertConfig(demonstrations=0))


class Killed(Exception):
    pass


@pytest.mark.slow
def test_a_killed_training_goes_on_to_the_same_expert(engine, tmp_path):
    """With recorded teachers, whose demonstrations pull the updates; killed before cloning, in both rounds of visits, in an update."""
    config = ExpertConfig(demonstrations=3, copies=1, trials=3, rounds=2, mastered=1.5, visits=2, updates=2,
                          cloning=CloningConfig(epochs=2), npg=NpgConfig(batch_size=2))
    asked = []

    def teachers():
        asked.append(len(Run.open(run).checkpoints()))
        return {"far": PickScript((0.3, 0.0, 0.0)), "good": PickScript()}, {"recordings": 2}

    run = tmp_path / "whole"
    whole = train_expert(engine, SOURCE, config, teachers=teachers, run=Run.create(run, {}))
    run = tmp_path / "killed"
    Run.create(tmp_path / "killed", {})
    for event, round_ in (("demonstrations", None), ("visits", 1), ("visits", 2), ("update", None), (None, None)):

        def kill(record, event=event, round_=round_):
            if record["event"] == event and record.get("round") == round_:
                raise Killed

        try:
            again = train_expert(engine, SOURCE, config, kill, teachers, Run.open(tmp_path / "killed"))
        except Killed:
            assert event is not None
    np.testing.assert_array_equal(again[0].parameters, whole[0].parameters)
    np.testing.assert_array_equal(again[1].parameters, whole[1].parameters)
    assert again[2] == whole[2] and whole[2]["recordings"] == 2 and whole[2]["teacher"] == "good"
    assert asked == [0, 0, 0, 2, 2], "recordings are retargeted again after cloning, or a round begins from nothing"
    arrays, kept = Run.open(run).load_checkpoint("lessons")
    assert len(arrays["seen"]) == len(arrays["labels"]) == kept["shown"] > 0, "updates need the demonstrations alone"
    records = [Run.open(tmp_path / name).read_metrics() for name in ("whole", "killed")]
    taught = ["trial", "trial", "demonstrations", *["cloning"] * 2, *["visits", "cloning"] * 2]
    assert [r["event"] for r in records[0]] == [*taught, *["update"] * 2]
    assert [[{k: v for k, v in r.items() if k != "seconds"} for r in record] for record in records][0] == [
        {k: v for k, v in r.items() if k != "seconds"} for r in records[1]
    ]
    weights = [r["demonstration_weight"] for r in records[0] if r["event"] == "update"]
    assert weights[0] > 0, "recorded demonstrations do not pull"


# -- files ---------------------------------------------------------------------------------------------------


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


def test_a_pair_of_which_half_is_missing_is_refused(tmp_path, monkeypatch):
    policy, value = new_learner(TASKS["061_foam_brick"], 0)
    save_expert(policy, value, tmp_path, "arm-cup", {})
    (tmp_path / "arm-cup.value.safetensors").unlink()
    monkeypatch.setattr("toolkit.expert.shelf.SHIPPED", tmp_path)
    with pytest.raises(ToolkitError, match="arm-cup.value.safetensors does not exist"):
        load_expert("arm", named("cup"))


# -- what comes with the package -----------------------------------------------------------------------------


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


def test_a_tall_object_is_grasped_below_its_top_not_at_its_centre():
    """At the can's centre the palm would rest on its top and the fingers would never close."""
    for item in OBJECTS.values():
        grasped = item.half_height + pick_script(item).object_from_grasp[2]
        assert grasped <= FINGER_DEPTH + 1e-12, f"{item.name} is grasped {grasped:.4f} m below its top"
    assert pick_script(OBJECTS["061_foam_brick"]).object_from_grasp[2] == 0.0

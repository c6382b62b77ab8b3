"""How an expert is trained: what it is shown, cloning, a training that is killed and goes on."""

import numpy as np
import pytest

from tasks import TASKS
from tasks.pick import ACTION, ACTION_SIZE, OBSERVATION, OBSERVATION_SIZE
from toolkit.demonstrations.scripts import PickScript, entry
from toolkit.errors import ToolkitError
from toolkit.expert.training import OBSERVATION_NOISE, ExpertConfig, NoisyScript, _with_noise, new_learner, train_expert
from toolkit.learning.cloning import CloningConfig
from toolkit.learning.npg import NpgConfig
from toolkit.runs.run import Run
from toolkit.runs.seeds import DEMONSTRATION_SEEDS

SOURCE = "adroit"
pytestmark = pytest.mark.usefixtures("log_elsewhere")


@pytest.fixture(scope="module")
def demonstrations(engine):
    beta = engine.merged.space.beta(SOURCE)
    return engine.play(NoisyScript(PickScript(), 0.12), [beta] * 8, list(range(DEMONSTRATION_SEEDS, DEMONSTRATION_SEEDS + 8)))


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

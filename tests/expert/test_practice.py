"""Learning from nothing: rewards are progress, and a killed run goes on to the same policy, whatever its threads."""

from dataclasses import replace

import numpy as np
import pytest

from robots import MODEL_ROBOTS
from tasks.ant_maze import CARDS, AntInMaze
from toolkit.cli.app import main
from toolkit.errors import ToolkitError
from toolkit.evaluation.success import evaluate_native
from toolkit.expert.practice import PracticeConfig, _Learning, practise
from toolkit.expert.shelf import load_expert
from toolkit.runs.run import Run
from toolkit.runs.seeds import EVALUATION_SEEDS
from toolkit.simulation.rollout import NativeEngine

ANT, TASK = MODEL_ROBOTS["ant"], CARDS["ant-maze"]
SHORT = PracticeConfig(practice=1, updates=3, check_every=1, checks=2)
SHORT = replace(SHORT, first=replace(SHORT.first, batch_size=2), then=replace(SHORT.then, batch_size=2))


class Killed(Exception):
    """Stands for a process that ends."""


def numbers(policy, value):
    return np.concatenate([policy.parameters, policy.layers().shift, policy.layers().scale, value.parameters])


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """Events and networks of a short run that nobody disturbs."""
    events, run = [], Run.create(tmp_path_factory.mktemp("practice") / "run", {})
    policy, value, card = practise(NativeEngine(ANT, TASK, threads=2), TASK, SHORT, events.append, run)
    return events, numbers(policy, value), card, run.read_metrics()


def test_a_run_practises_and_then_does_the_task_itself(whole):
    events, _, card, kept = whole
    assert [event["event"] for event in events] == ["practice"] + ["progress"] * 3
    assert [event["event"] for event in kept] == [event["event"] for event in events]
    assert [event["update"] for event in events] == [1, 2, 3, 4]
    assert (card["practice"], card["updates"]) == (1, 3) and card["policy_steps"] > sum(event["steps"] for event in events)
    assert all(np.isfinite(event["kl"]) and event["kl"] > 0 for event in events)


@pytest.mark.parametrize("survived", range(4))
def test_a_killed_run_goes_on_to_the_same_policy(whole, tmp_path, survived):
    """Killed at each event in turn, before its checkpoint, and continued on another number of threads."""
    events, networks, card, kept = whole
    run, seen = Run.create(tmp_path / "run", {}), []

    def kill(event):
        seen.append(event)
        if len(seen) == survived + 1:
            raise Killed

    with pytest.raises(Killed):
        practise(NativeEngine(ANT, TASK, threads=1), TASK, SHORT, kill, run)
    run.end()
    run = Run.open(tmp_path / "run", {})
    policy, value, again = practise(NativeEngine(ANT, TASK, threads=1), TASK, SHORT, run=run)
    np.testing.assert_array_equal(numbers(policy, value), networks)
    timeless = lambda records: [{key: x for key, x in record.items() if key != "seconds"} for record in records]  # noqa: E731
    assert again == card and timeless(run.read_metrics()) == timeless(kept)


def test_progress_is_the_reward_and_a_fall_costs():
    learning = _Learning(NativeEngine(ANT, TASK, threads=1), TASK, SHORT, lambda record: None, None)
    task, engine = learning.stages[1]
    (episode,) = engine.play(lambda seen, rng: np.zeros(8), [np.zeros(1)], [3])
    gained = task.gains(np.vstack([episode.observations, episode.last_observation])).sum()
    for terminated, cost in ((False, 0.0), (True, SHORT.fall)):
        rewarded = learning.rewarded(task, replace(episode, terminated=terminated))
        assert rewarded.total_reward == pytest.approx(gained - cost, abs=1e-12)
    flailing = learning.rewarded(task, replace(episode, actions=np.full_like(episode.actions, 2.0)))
    assert flailing.total_reward == pytest.approx(gained - SHORT.effort * 8 * episode.steps, abs=1e-9)
    broken = replace(episode, diverged=True, terminated=True)
    assert learning.rewarded(task, broken) is broken
    learning.close()


def test_the_best_that_was_measured_is_kept_and_ends_the_run_where_it_masters_the_task(monkeypatch):
    found, learners = iter([0.25, 0.5, 0.25, 0.99]), []

    def measured(self):
        success = next(found)
        learners.append(self.policy.parameters)
        if success >= self.success:
            self.best, self.success = (self.policy.copy(), self.value.copy()), success
        return success

    monkeypatch.setattr(_Learning, "check", measured)
    policy, _, card = practise(NativeEngine(ANT, TASK), TASK, replace(SHORT, practice=0))
    np.testing.assert_array_equal(policy.parameters, learners[1])
    assert card["updates"] == 3 and not np.array_equal(learners[1], learners[2])
    found = iter([0.25, 0.99, 1.0])
    policy, _, card = practise(NativeEngine(ANT, TASK), TASK, replace(SHORT, practice=0))
    assert card["updates"] == 2


def test_the_shipped_expert_leaves_the_maze_in_gymnasiums_own_environment():
    """On unseen starts; its card says 200 of 200."""
    policy, _ = load_expert("ant", TASK)
    found = evaluate_native(policy, ANT, TASK, 12, seed=7, processes=1)
    assert found.successes >= 11 and found.diverged == 0, f"{found.successes} of 12"
    assert policy.hidden == (32, 32)


def test_who_lies_on_its_back_would_not_have_left_the_maze(monkeypatch):
    """So that to end an episode there takes no success away: the expert under strong noise, played on where it has fallen."""
    policy, _ = load_expert("ant", TASK)
    policy.set_log_std(np.full(8, -0.5))
    engine, seeds = NativeEngine(ANT, TASK), range(EVALUATION_SEEDS, EVALUATION_SEEDS + 12)
    fallen = [e.seed for e in engine.play(policy.act, [np.zeros(1)] * len(seeds), seeds) if e.terminated and not e.success]
    monkeypatch.setattr(AntInMaze, "on_its_back", lambda self: False)
    played_on = engine.play(policy.act, [np.zeros(1)] * len(fallen), fallen)
    engine.close()
    assert len(fallen) >= 3 and not any(episode.success for episode in played_on)
    assert np.mean([episode.steps for episode in played_on]) > 150, "they were not played on"


def test_demonstrations_are_refused_before_there_is_a_run_folder(capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as ended:
        main(["expert", "--source", "ant", "--task", "ant-maze", "--demos", "steps.npz"])
    assert ended.value.code == 2 and "learns from nothing; leave out --demos steps.npz" in capsys.readouterr().err
    assert not any(tmp_path.iterdir())


def test_an_impossible_number_is_refused():
    with pytest.raises(ToolkitError, match="PracticeConfig.practice is -1; give 0 or more"):
        PracticeConfig(practice=-1)

"""What is left of a simulation that blew up, and its replay."""

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest

from tasks.pick import ACTION_SIZE
from toolkit.errors import ToolkitError
from toolkit.simulation.divergence import Divergence, replay
from toolkit.simulation.laws import merged_plant
from toolkit.simulation.rollout import RolloutEngine

pytestmark = pytest.mark.usefixtures("log_elsewhere")


@pytest.fixture(scope="module")
def space(pair):
    return pair.space


@pytest.fixture(scope="module")
def merged(pair):
    return pair.merged


@pytest.fixture(scope="module")
def unstable(space, task):
    """The merged robot with steps of physics so long that fast motion blows up."""
    from toolkit.morphology.build import MergedRobot

    merged = MergedRobot(space, task)
    merged.template.opt.timestep = 0.025
    return merged


def wild(observation, rng):
    return rng.choice([-1.0, 1.0], ACTION_SIZE)


@pytest.fixture(scope="module")
def dump(unstable, space, tmp_path_factory):
    """(file, its divergence, the episodes) of a batch in which some simulations blow up."""
    file = tmp_path_factory.mktemp("run") / "divergence.npz"
    engine = RolloutEngine(unstable, threads=2, dump=file)
    episodes = engine.play(wild, [space.beta("kinova3"), *space.betas], list(range(1 + len(space.betas))))
    engine.close()
    return file, Divergence.load(file), episodes


def test_the_first_divergence_of_a_batch_is_dumped_and_blows_up_again(dump, unstable):
    file, saved, episodes = dump
    first = next(episode for episode in episodes if episode.diverged)
    assert saved.seed == first.seed and np.array_equal(saved.alpha, first.alpha)
    np.testing.assert_array_equal(saved.actions, first.actions)
    plant = merged_plant(unstable, saved.alpha, *unstable.new())
    found = replay(plant, saved)
    assert found.diverged and len(found.substeps) <= plant.substeps
    assert f"policy step {first.steps - 1}" in found.cause, found.cause
    content = json.loads(json.dumps(found.to_json(), allow_nan=False))
    assert content["substeps"][-1]["joint"] in [slot.name for slot in unstable.space.matching.slots] + ["object"]


def test_the_steps_of_a_replay_are_those_of_the_episode(unstable, space):
    """One step of physics at a time is the same motion as all of a policy step at once, to the last bit."""
    whole, parts = (merged_plant(unstable, space.beta("kinova3"), *unstable.new()) for _ in range(2))
    action = np.full(ACTION_SIZE, 0.3)
    whole.begin(3)
    parts.begin(3)
    for _ in range(5):
        whole.step(action)
        parts.set_command(action)
        for k in range(parts.substeps):
            parts.play_substeps(action, 1, sets_goal=k == 0)
    np.testing.assert_array_equal(whole.data.qpos, parts.data.qpos)


def test_a_later_divergence_leaves_the_dump_alone(dump, unstable, space):
    file, saved, _ = dump
    engine = RolloutEngine(unstable, threads=1, dump=file)
    (episode,) = engine.play(wild, [space.beta("kinova3")], [77])
    engine.close()
    assert Divergence.load(file).seed == saved.seed


def test_a_policy_that_returns_nan_is_named(merged, space, tmp_path):
    engine = RolloutEngine(merged, threads=1, dump=tmp_path / "divergence.npz")
    engine.play(lambda observation, rng: np.full(ACTION_SIZE, np.nan), [space.beta("kinova3")], [4])
    engine.close()
    saved = Divergence.load(tmp_path / "divergence.npz")
    found = replay(merged_plant(merged, saved.alpha, *merged.new()), saved)
    assert found.diverged and "action 0 is nan at policy step 0" in found.cause


def test_the_dump_of_a_robot_that_has_changed_is_refused(dump, merged):
    _, saved, _ = dump
    changed = dataclasses.replace(saved, state=saved.state[:-1])
    with pytest.raises(ToolkitError, match="have changed since"):
        replay(merged_plant(merged, saved.alpha, *merged.new()), changed)


@pytest.mark.parametrize("content", [b"", b"no archive", b"PK\x03\x04 torn"], ids=["empty", "text", "torn"])
def test_a_broken_dump_gets_one_sentence(tmp_path, content):
    file = tmp_path / "divergence.npz"
    with pytest.raises(ToolkitError, match="does not exist"):
        Divergence.load(file)
    file.write_bytes(content)
    with pytest.raises(ToolkitError, match="no divergence dump"):
        Divergence.load(file)


def test_a_dump_that_would_run_code_is_refused(dump, tmp_path):
    with np.load(dump[0]) as content:
        arrays = dict(content)
    np.savez(tmp_path / "evil.npz", **arrays | {"state": np.array([print], object)})
    with pytest.raises(ToolkitError, match="no divergence dump"):
        Divergence.load(tmp_path / "evil.npz")


def test_mujocos_warnings_keep_off_the_output(unstable, space, capfd):
    """Its own go to standard output, where a command's JSON goes, and into a log file."""
    engine = RolloutEngine(unstable, threads=1)
    episodes = engine.play(wild, list(space.betas), list(range(len(space.betas))))
    engine.close()
    assert any(episode.diverged for episode in episodes)
    assert capfd.readouterr().out == "" and not Path("MUJOCO_LOG.TXT").exists()


def test_the_command_line_replays_a_dump_of_the_unmodified_robot(task, tmp_path, capsys):
    from robots import ROBOTS
    from toolkit.cli.app import main
    from toolkit.simulation.rollout import NativeEngine

    def breaks_off(observation, rng):
        breaks_off.steps += 1
        return np.full(ACTION_SIZE, np.nan if breaks_off.steps == 3 else 0.1)

    breaks_off.steps = 0
    engine = NativeEngine(ROBOTS["kinova3"], task, threads=1, dump=tmp_path / "divergence.npz")
    (episode,) = engine.play(breaks_off, [np.zeros(0)], [5])
    engine.close()
    assert episode.diverged and episode.steps == 3
    main(["replay", str(tmp_path / "divergence.npz"), "--json"])
    found = json.loads(capsys.readouterr().out)
    assert found["robots"] == ["kinova3"] and found["native"] and found["seed"] == 5 and found["step"] == 2
    assert found["diverged"] and found["cause"] == "the policy's action 0 is nan at policy step 2"
    assert found["substeps"][0]["time"] == pytest.approx(0.102)

"""Rollouts: the seed decides everything, the number of threads nothing, and a mad policy harms only itself."""

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest

from tasks.pick import ACTION_SIZE, OBSERVATION_SIZE
from toolkit.demonstrations.scripts import PickScript
from toolkit.errors import ToolkitError
from toolkit.simulation.divergence import Divergence, replay
from toolkit.simulation.laws import merged_plant
from toolkit.simulation.rollout import RolloutEngine, play
from toolkit.simulation.watching import States

FIELDS = (
    "observations",
    "actions",
    "rewards",
    "last_observation",
    "alpha",
    "seed",
    "success",
    "diverged",
    "terminated",
)


pytestmark = pytest.mark.usefixtures("log_elsewhere")


@pytest.fixture(scope="module")
def space(pair):
    return pair.space


@pytest.fixture(scope="module")
def merged(pair):
    return pair.merged


def noisy(observation, rng):
    """The script with a policy's noise on top: reads the observation and draws from the episode's own generator."""
    return PickScript()(observation) + 0.3 * rng.standard_normal(ACTION_SIZE)


def batch(space):
    """(alphas, seeds): both robots, one between and one anywhere, each twice."""
    rng = np.random.default_rng(0)
    alphas = [
        space.beta("adroit"),
        space.beta("kinova3"),
        0.5 * (space.beta("adroit") + space.beta("kinova3")),
        rng.random(space.size),
    ]
    return [*alphas, *alphas], [0, 1, 2, 3, 10, 11, 12, 13]


def same(first, second):
    return all(np.array_equal(getattr(first, f), getattr(second, f), equal_nan=True) for f in FIELDS)


@pytest.fixture(scope="module")
def reference(engine, space):
    return engine.play(noisy, *batch(space))


def test_the_same_seeds_play_the_same_episodes_again(engine, reference, space):
    assert all(map(same, reference, engine.play(noisy, *batch(space)))), "an episode differs from its own repetition"


def test_one_thread_plays_what_two_play(merged, reference, space):
    engine = RolloutEngine(merged, threads=1)
    try:
        again = engine.play(noisy, *batch(space))
    finally:
        engine.close()
    different = [i for i, pair in enumerate(zip(reference, again, strict=True)) if not same(*pair)]
    assert not different, f"episodes {different} differ bitwise between one thread and two"


def test_the_order_of_a_batch_does_not_matter(engine, reference, space):
    alphas, seeds = batch(space)
    order = np.random.default_rng(1).permutation(len(seeds))
    shuffled = engine.play(noisy, [alphas[i] for i in order], [seeds[i] for i in order])
    different = [int(i) for i, episode in zip(order, shuffled, strict=True) if not same(reference[i], episode)]
    assert not different, f"episodes {different} depend on what was played before them"


def test_another_seed_is_another_episode(engine, reference, space):
    (other,) = engine.play(noisy, [space.beta("adroit")], [99])
    assert not np.array_equal(other.observations[0], reference[0].observations[0])


def test_an_episode_records_what_was_seen_and_done(engine, reference, space):
    alphas, seeds = batch(space)
    played = engine.episodes_played
    engine.play(noisy, alphas[:1], seeds[:1])
    assert engine.episodes_played == played + 1
    for episode, alpha, seed in zip(reference, alphas, seeds, strict=True):
        assert episode.observations.shape == (episode.steps, OBSERVATION_SIZE)
        assert episode.actions.shape == (episode.steps, ACTION_SIZE)
        assert np.array_equal(episode.alpha, alpha) and episode.seed == seed
        assert episode.steps <= engine.merged.task.horizon


def test_a_watcher_sees_the_episode_that_was_played(engine, space):
    alpha = space.beta("kinova3")
    (episode,) = engine.play(noisy, [alpha], [5])
    model, data = engine.merged.new()
    states = States()
    again = play(merged_plant(engine.merged, alpha, model, data), noisy, 5, alpha, states)
    assert len(states.qpos) == episode.steps + 1 and again.success == episode.success
    assert np.array(states.qpos).shape[1] == model.nq


# -- policies gone mad ---------------------------------------------------------------------------------------

MAD = [np.nan, np.inf, 1e300, -1e300, 1e12]


@pytest.mark.filterwarnings("ignore:invalid value")
@pytest.mark.parametrize("value", MAD)
def test_a_mad_policy_fails_and_is_never_rewarded(engine, space, value):
    (episode,) = engine.play(lambda observation, rng: np.full(ACTION_SIZE, value), [space.beta("kinova3")], [0])
    assert not episode.success and not episode.rewards.any(), f"a policy that returns {value} was rewarded"
    assert np.isfinite(episode.last_observation).all()


@pytest.mark.filterwarnings("ignore:invalid value")
@pytest.mark.parametrize("value", MAD)
def test_a_mad_policy_harms_no_neighbour(engine, space, value):
    """Its episode shares thread, model and data with sane ones before and after it."""
    alpha = space.beta("kinova3")
    alone = engine.play(noisy, [alpha] * 3, [1, 2, 3])

    def one_is_mad(observation, rng):
        seed, _ = rng.bit_generator.seed_seq.entropy
        action = noisy(observation, rng)
        return np.full(ACTION_SIZE, value) if seed == 0 else action

    episodes = engine.play(one_is_mad, [alpha] * 5, [0, 1, 0, 2, 3])
    different = [seed for seed, i, j in ((1, 0, 1), (2, 1, 3), (3, 2, 4)) if not same(alone[i], episodes[j])]
    assert not different, f"seeds {different} played otherwise beside a policy that returns {value}"


def test_after_a_broken_batch_the_engine_plays_on(engine, reference, space):
    def broken(observation, rng):
        raise RuntimeError("no action")

    with pytest.raises(RuntimeError, match="no action"):
        engine.play(broken, [space.beta("kinova3")] * 4, range(4))
    alphas, seeds = batch(space)
    assert all(map(same, reference[:3], engine.play(noisy, alphas[:3], seeds[:3]))), "a broken batch left its mark"


# -- the task can be done ------------------------------------------------------------------------------------


def test_the_scripted_pick_succeeds_on_the_merged_kinova3(engine, space):
    episodes = engine.play(PickScript(), [space.beta("kinova3")] * 4, range(4))
    assert all(e.success for e in episodes), f"{sum(e.success for e in episodes)} of 4 scripted picks succeed"
    assert all(e.rewards.sum() == 1 and e.rewards[-1] == 1 and e.terminated for e in episodes)


# -- what is left of a simulation that blew up ---------------------------------------------------------------


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

"""Rollouts: the seed decides everything, the number of threads nothing, and a mad policy harms only itself."""

import numpy as np
import pytest

from tasks.pick import ACTION_SIZE, OBSERVATION_SIZE
from toolkit.demonstrations.scripts import PickScript
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


def carried(plant, places):
    """An actor that does nothing while the object is put at each of the places in turn."""
    steps = iter(places)
    address = plant.model.joint("object").qposadr[0]

    def act(observation, rng):
        place = next(steps, None)
        if place is not None:
            plant.data.qpos[address : address + 7] = [*(plant.goal if place == "goal" else place), 1, 0, 0, 0]
            plant.data.qvel[-6:] = 0
        return np.zeros(ACTION_SIZE)

    return act


def test_success_in_a_rollout_needs_consecutive_steps(pair, task):
    plant = merged_plant(pair.merged, pair.space.beta("kinova3"), *pair.merged.new())
    steps, aside = task.hold_steps, [0.3, 0.3, 0.9]
    act = carried(plant, ["goal"] * (steps - 1) + [aside] + ["goal"] * steps)
    episode = play(plant, act, 0, pair.space.beta("kinova3"))
    assert episode.success and episode.terminated
    assert episode.steps == 2 * steps, f"ended after {episode.steps} steps, {2 * steps} expected"
    assert episode.rewards.tolist() == [0.0] * (2 * steps - 1) + [1.0], "one reward, on the last step"


def test_a_lost_object_ends_a_rollout_as_a_failure(pair):
    plant = merged_plant(pair.merged, pair.space.beta("kinova3"), *pair.merged.new())
    episode = play(plant, carried(plant, [None, None, [1.5, 0.0, 0.5]]), 0, pair.space.beta("kinova3"))
    assert (episode.steps, episode.success, episode.diverged, episode.terminated) == (3, False, False, True)
    assert episode.total_reward == 0.0

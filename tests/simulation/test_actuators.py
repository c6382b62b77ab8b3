"""Robots driven through their own actuators, by the engine and by a gymnasium environment of their own."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest
from toys import CRAWL, CRAWLER_ROBOTS, HAND_ROBOTS, LIFT, hand

from toolkit.errors import ToolkitError
from toolkit.evaluation.success import evaluate_compiled, evaluate_merged
from toolkit.learning.policy import GaussianPolicy
from toolkit.morphology.lab import Lab
from toolkit.simulation.divergence import Divergence, replay
from toolkit.simulation.laws import merged_plant, native_plant, native_robot
from toolkit.simulation.rollout import NativeEngine, RolloutEngine, play
from toolkit.simulation.watching import States

FAMILIES = {"crawler": (CRAWLER_ROBOTS, CRAWL), "hand": (HAND_ROBOTS, LIFT)}
either = pytest.mark.parametrize("family", list(FAMILIES))


def lift(observation, rng):
    """Up, now and then."""
    return np.array([rng.choice([-1.0, 1.0]), 1.0, -1.0])


def thrash(observation, rng):
    return rng.uniform(-1.5, 1.5, 3)


@either
def test_the_engine_plays_what_the_environment_plays(family):
    """Same start, same actions: the engine's episode and gymnasium's own step, state for state."""
    robots, task = FAMILIES[family]
    for robot in robots:
        plant, own = native_plant(robot, task), native_robot(robot, task)
        observation, rng = plant.begin(5), np.random.default_rng(0)
        np.testing.assert_array_equal(observation, own.begin(5))
        for _ in range(task.horizon):
            action = thrash(observation, rng)
            observation = plant.step(action)
            seen = own.env.step(action)[0]
            np.testing.assert_allclose(seen, observation, atol=1e-12)
            assert own.scene.at_goal() == plant.at_goal


@either
def test_success_counts_the_same_way_everywhere(family):
    robots, task = FAMILIES[family]
    act = thrash if family == "crawler" else lift
    played = NativeEngine(robots[0], task, threads=2)
    seeds = list(range(12))
    episodes = played.play(act, [np.zeros(1)] * 12, seeds)
    played.close()
    own = native_robot(robots[0], task)
    for seed, episode in zip(seeds, episodes, strict=True):
        rng = np.random.default_rng((seed, 1))
        assert own.play(lambda observation, rng=rng: act(observation, rng), seed) == episode.success
    assert 0 < sum(e.success for e in episodes), "a test of success needs some"


@either
def test_batches_do_not_depend_on_threads(family):
    robots, task = FAMILIES[family]
    lab = Lab(robots[0], robots[1:], task)
    alphas = [share * lab.space.beta(robots[-1].name) for share in np.linspace(0, 1, 6)]
    one, two = (RolloutEngine(lab.merged, threads=threads) for threads in (1, 2))
    for a, b in zip(one.play(thrash, alphas, range(6)), two.play(thrash, alphas, range(6)), strict=True):
        np.testing.assert_array_equal(a.observations, b.observations)
    one.close()
    two.close()


def test_a_policy_is_evaluated_on_both_kinds():
    lab = Lab(HAND_ROBOTS[0], HAND_ROBOTS[1:], LIFT)
    policy = GaussianPolicy(LIFT.observation.names, LIFT.action.names, np.random.default_rng(0))
    engine = RolloutEngine(lab.merged)
    for result in (evaluate_merged(policy, engine, "short", 4), evaluate_compiled(policy, HAND_ROBOTS[1], LIFT, 4)):
        assert result.episodes == 4 and result.diverged == 0
    engine.close()


def test_a_divergence_plays_again(tmp_path):
    lab = Lab(HAND_ROBOTS[0], HAND_ROBOTS[1:], LIFT)
    dump = tmp_path / "divergence.npz"
    engine = RolloutEngine(lab.merged, threads=1, dump=dump)
    broken = lambda observation, rng: np.full(3, np.nan)  # noqa: E731
    (episode,) = engine.play(broken, [lab.space.betas[1]], [3])
    engine.close()
    assert episode.diverged and not episode.success
    found = Divergence.load(dump)
    again = replay(merged_plant(lab.merged, found.alpha, *lab.merged.new()), found)
    assert again.diverged and "action 0 is nan" in again.cause


def test_an_episode_can_be_taped():
    states = States()
    episode = play(native_plant(HAND_ROBOTS[0], LIFT), lift, 0, np.zeros(1), states)
    assert len(states.qpos) == episode.steps + 1 and states.qpos[0].shape == (10,)


def test_an_actuator_without_a_range_is_named():
    unlimited = replace(hand("free"), change=lambda spec: setattr(spec.actuator("lift"), "ctrllimited", mujoco.mjtLimited.mjLIMITED_FALSE))
    with pytest.raises(ToolkitError, match="actuator 'lift' has no control range"):
        native_plant(unlimited, LIFT)

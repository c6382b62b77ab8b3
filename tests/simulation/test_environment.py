"""The unmodified robot as a Gymnasium environment: its episodes are those that success is claimed on."""

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import meta_evolve
from toolkit.demonstrations.scripts import PickScript
from toolkit.simulation.watching import States


@pytest.fixture(scope="module")
def env():
    made = gymnasium.make(meta_evolve.ENVIRONMENT, robot="kinova3", render_mode="rgb_array")
    yield made
    made.close()


@pytest.mark.slow
def test_gymnasium_finds_nothing_wrong(env):
    check_env(env.unwrapped, skip_render_check=False)


def test_an_episode_is_the_native_robots(env, native):
    """Same start, same observations, same end as the robot that success is claimed on."""
    script, robot, states = PickScript(), native("kinova3"), States()
    assert robot.play(script, 7, states)
    observation, info = env.reset(seed=7)
    assert info == {"seed": 7}
    rewards, ended = [], False
    while not ended:
        np.testing.assert_array_equal(env.unwrapped.robot.data.qpos, states.qpos[len(rewards)])
        observation, reward, terminated, truncated, info = env.step(np.clip(script(observation), -1, 1))
        rewards.append(reward)
        ended = terminated or truncated
    assert terminated and not truncated and info == {"success": True, "lost": False, "diverged": False}
    assert rewards == [0.0] * (len(states.qpos) - 2) + [1.0]
    named = env.unwrapped.named(observation)
    assert np.linalg.norm(named["goal_from_object"]) < env.unwrapped.task.goal_tolerance
    np.testing.assert_array_equal(np.concatenate(list(named.values())), observation)


def test_the_horizon_truncates_and_a_blown_up_simulation_ends(env):
    idle = np.zeros(env.action_space.shape)
    env.reset(seed=1)
    steps = 0
    while not (ended := env.step(idle))[3]:
        assert not ended[2]
        steps += 1
    assert steps + 1 == env.unwrapped.task.horizon
    env.reset(seed=1)
    env.unwrapped.robot.data.qvel[:] = 1e12
    observation, reward, terminated, _, info = env.step(idle)
    assert terminated and info["diverged"] and reward == 0.0 and np.isfinite(observation).all()


def test_starts_without_a_seed_differ_and_follow_from_the_one_before(env):
    seeds = []
    for _ in range(2):
        env.reset(seed=5)
        seeds.append([env.reset()[1]["seed"] for _ in range(3)])
    assert seeds[0] == seeds[1] and len(set(seeds[0])) == 3

"""Episodes: what they hold, and what is refused."""

import numpy as np
import pytest
from toy_policies import make_episode, make_policy

from toolkit.errors import ToolkitError


def test_an_episode_is_read_only_and_counts():
    rewards = np.arange(4.0)
    episode = make_episode(make_policy(), np.random.default_rng(0), steps=4, rewards=rewards)
    assert (episode.steps, episode.total_reward) == (4, 6.0)
    with pytest.raises(ValueError):
        episode.rewards[0] = 1.0
    rewards[0] = 1.0  # the caller's own array stays writable


@pytest.mark.parametrize(
    ("changes", "culprit"),
    [
        ({"rewards": np.zeros(3)}, "3 rewards"),
        ({"rewards": np.zeros((20, 1))}, "rewards has shape"),
        ({"last_observation": np.zeros(4)}, "last_observation has 4"),
        ({"rewards": np.full(20, np.nan)}, "rewards is not finite"),
        ({"diverged": True, "success": True}, "success is True"),
        ({"observations": np.zeros((0, 5)), "actions": np.zeros((0, 3)), "rewards": np.zeros(0)}, "0 rows"),
    ],
)
def test_a_bad_episode_is_refused(changes, culprit):
    with pytest.raises(ToolkitError, match=culprit):
        make_episode(make_policy(), np.random.default_rng(0), **changes)


def test_a_diverged_episode_earns_nothing():
    episode = make_episode(make_policy(), np.random.default_rng(0), rewards=np.full(20, 1e30), diverged=True)
    assert episode.total_reward == 0.0

"""Small policies whose every number differs from every other, and episodes that they play."""

import numpy as np

from toolkit.learning.episode import Episode
from toolkit.learning.policy import GaussianPolicy, ValueFunction


def make_policy(n_obs=5, n_act=3, hidden=(4, 4), seed=0, spread=0.5):
    """A policy whose every trained number differs from every other."""
    rng = np.random.default_rng(seed)
    policy = GaussianPolicy([f"obs {i}" for i in range(n_obs)], [f"act {i}" for i in range(n_act)], rng, hidden)
    policy.set_parameters(spread * rng.standard_normal(len(policy.parameters)))
    policy.set_normalisation(rng.standard_normal(n_obs), rng.uniform(0.5, 2.0, n_obs))
    return policy


def make_value(policy, seed=1):
    return ValueFunction(policy.observation_names, np.random.default_rng(seed), policy.hidden)


def make_episode(policy, rng, steps=20, rewards=None, **changes):
    observations = rng.standard_normal((steps + 1, len(policy.observation_names)))
    actions = np.array([policy.act(observation, rng) for observation in observations[:-1]])
    fields = dict(
        observations=observations[:-1],
        actions=actions,
        rewards=actions[:, 0] - observations[:-1, 0] if rewards is None else rewards,
        success=False,
        diverged=False,
        terminated=False,
        last_observation=observations[-1],
        alpha=np.zeros(2),
        seed=7,
    )
    return Episode(**(fields | changes))

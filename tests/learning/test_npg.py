"""Every number of the natural policy gradient by a second route: loops, finite differences, dense solves."""

import dataclasses
import json

import numpy as np
import pytest
import scipy.stats
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from toy_policies import make_episode, make_policy, make_value

from toolkit.errors import ToolkitError
from toolkit.learning import npg
from toolkit.learning.cloning import CloningConfig, clone
from toolkit.learning.episode import Episode
from toolkit.learning.npg import NpgConfig, npg_step
from toolkit.learning.policy import GaussianPolicy, ValueFunction

# -- natural gradient ----------------------------------------------------------------------------------------


@settings(max_examples=50, deadline=None)
@given(
    steps=st.integers(1, 40), gamma=st.floats(0, 1), gae_lambda=st.floats(0, 1), seed=st.integers(0, 2**32 - 1)
)
def test_gae_equals_the_plain_loop(steps, gamma, gae_lambda, seed):
    rng = np.random.default_rng(seed)
    rewards, values, last_value = rng.standard_normal(steps), rng.standard_normal(steps), rng.standard_normal()
    expected, following, advantage = np.zeros(steps), last_value, 0.0
    for t in reversed(range(steps)):
        advantage = rewards[t] + gamma * following - values[t] + gamma * gae_lambda * advantage
        expected[t], following = advantage, values[t]
    assert np.allclose(npg.gae(rewards, values, last_value, gamma, gae_lambda), expected, atol=1e-12)


def test_only_a_cut_episode_is_bootstrapped():
    policy, config = make_policy(), NpgConfig(gae_lambda=1.0)
    value, rng = make_value(policy), np.random.default_rng(0)
    value.set_parameters(rng.standard_normal(len(value.parameters)))
    for terminated in (False, True):
        episode = make_episode(policy, rng, terminated=terminated)
        _, returns, _ = npg._advantages(value, [episode], config)
        last = 0.0 if terminated else value.predict(episode.last_observation[None])[0]
        discounts = config.gamma ** np.arange(21)
        assert returns[0] == pytest.approx(discounts[:-1] @ episode.rewards + discounts[-1] * last, abs=1e-10)


def test_fisher_product_equals_the_fisher_matrix_by_finite_differences():
    policy = make_policy(3, 2, (3,))
    observations = np.random.default_rng(0).standard_normal((7, 3))
    origin, twin, h = policy.parameters, policy.copy(), 1e-5
    jacobian = np.zeros((7, 2, len(origin)))
    for i in range(len(origin)):
        for sign in (1.0, -1.0):
            twin.set_parameters(origin + sign * h * np.eye(len(origin))[i])
            jacobian[:, :, i] += sign * twin.mean(observations) / (2.0 * h)
    fisher = np.einsum("nai,a,naj->ij", jacobian, np.exp(-2.0 * policy.log_std), jacobian) / 7
    fisher[-2:, -2:] += 2.0 * np.eye(2)
    parameters = torch.tensor(origin, requires_grad=True)
    product = npg.fisher_vector_product(policy, torch.from_numpy(observations), parameters, 0.25)
    columns = np.array([product(unit) for unit in np.eye(len(origin))])
    assert np.abs(columns - fisher - 0.25 * np.eye(len(origin))).max() < 1e-8


def test_fisher_product_is_the_hessian_of_the_kl():
    policy = make_policy(3, 2, (3,))
    observations = torch.from_numpy(np.random.default_rng(0).standard_normal((7, 3)))
    old = torch.from_numpy(policy.parameters)

    def kl(new):  # torch's own formula, not ours
        distributions = [
            torch.distributions.Normal(policy.torch_mean(observations, p), policy.torch_log_std(p).exp())
            for p in (old, new)
        ]
        return torch.distributions.kl_divergence(*distributions).sum(dim=1).mean()

    hessian = torch.autograd.functional.hessian(kl, old).numpy()
    product = npg.fisher_vector_product(policy, observations, old.clone().requires_grad_(), 0.0)
    assert np.abs(np.array([product(unit) for unit in np.eye(len(old))]) - hessian).max() < 1e-12
    new = old + 0.1 * torch.from_numpy(np.random.default_rng(1).standard_normal(len(old)))
    assert npg.mean_kl(policy, observations, old, new) == pytest.approx(float(kl(new)), abs=1e-12)


def test_conjugate_gradients_equal_a_dense_solve():
    rng = np.random.default_rng(0)
    root = rng.standard_normal((20, 20))
    matrix, target = root @ root.T + np.eye(20), rng.standard_normal(20)
    x = npg.conjugate_gradients(matrix.__matmul__, target, 100)
    assert np.abs(x - np.linalg.solve(matrix, target)).max() < 1e-8
    early = npg.conjugate_gradients(matrix.__matmul__, target, 3)
    assert early @ matrix @ early == pytest.approx(early @ target), "the step length holds wherever it stops"


@pytest.mark.parametrize("step_size", [1e-4, 1e-2])
def test_the_step_moves_the_policy_by_half_the_step_size(step_size):
    policy = make_policy(38, 28, (32, 32), spread=0.1)
    rng = np.random.default_rng(0)
    episodes = [make_episode(policy, rng, 60) for _ in range(6)]
    statistics = npg_step(policy, make_value(policy), episodes, NpgConfig(step_size=step_size), rng)
    assert not statistics["no_signal"]
    assert statistics["kl"] == pytest.approx(step_size / 2.0, rel=0.1)
    assert abs(statistics["surrogate_before"]) < 1e-12 < statistics["surrogate_after"]
    json.dumps(statistics, allow_nan=False)


@pytest.mark.parametrize("case", ["no reward", "diverged", "one advantage"])
def test_a_batch_without_signal_leaves_the_policy_alone(case):
    policy, rng = make_policy(), np.random.default_rng(0)
    value, config = make_value(policy), NpgConfig()
    if case == "one advantage":  # the value function says 0 everywhere and every reward is the same
        value.set_parameters(np.zeros_like(value.parameters))
        episodes, config = [make_episode(policy, rng, rewards=np.ones(20))], NpgConfig(gae_lambda=0.0)
    else:
        value.set_parameters(rng.standard_normal(len(value.parameters)))
        rewards = np.full(20, 1e6) if case == "diverged" else np.zeros(20)
        episodes = [make_episode(policy, rng, rewards=rewards, diverged=case == "diverged") for _ in range(3)]
    before = policy.parameters
    statistics = npg_step(policy, value, episodes, config, rng)
    assert statistics["no_signal"] and statistics["kl"] == 0.0
    assert policy.parameters.tobytes() == before.tobytes()
    json.dumps(statistics, allow_nan=False)


def test_a_diverged_episode_is_used_up_to_its_first_nan_and_never_rewarded():
    policy, rng = make_policy(), np.random.default_rng(0)
    good, bad = make_episode(policy, rng), make_episode(policy, rng, rewards=np.full(20, 1e9))
    observations = bad.observations.copy()
    observations[12:] = np.nan
    blown = dataclasses.replace(bad, observations=observations, diverged=True)
    value = make_value(policy)
    value.set_return_scale(100.0, 1.0)
    _, returns, _ = npg._advantages(value, [npg._usable(blown)], NpgConfig(gae_lambda=1.0))
    assert np.abs(returns).max() < 1e-9, "the value function must not reward the blow-up either"
    statistics = npg_step(policy, value, [good, blown], NpgConfig(), rng)
    assert statistics["steps"] == 32 and statistics["diverged"] == 1
    assert statistics["mean_reward"] == pytest.approx(good.total_reward / 2)


@pytest.mark.parametrize("threads", [1, 2])
def test_same_seed_same_bits_whatever_the_thread_count(threads):
    def run(n):
        before = torch.get_num_threads()
        torch.set_num_threads(n)
        try:
            policy, rng = make_policy(38, 28, (32, 32)), np.random.default_rng(5)
            value = make_value(policy)
            for _ in range(2):
                npg_step(policy, value, [make_episode(policy, rng, 100) for _ in range(4)], NpgConfig(), rng)
            clone(policy, rng.standard_normal((300, 38)), rng.standard_normal((300, 28)), CloningConfig(epochs=2), rng)
            assert torch.get_num_threads() == n, "the caller's setting comes back"
            return policy.parameters.tobytes() + value.parameters.tobytes()
        finally:
            torch.set_num_threads(before)

    assert run(1) == run(threads)


def test_log_std_keeps_its_floor():
    policy, rng = make_policy(), np.random.default_rng(0)
    policy.set_log_std(np.full(3, -2.0))
    config = NpgConfig(step_size=1.0, min_log_std=-1.9)
    npg_step(policy, make_value(policy), [make_episode(policy, rng)], config, rng)
    assert policy.log_std.min() >= -1.9


def reach(policy, rng, steps=10):
    """Ten steps to bring a point to a target drawn anew; the reward is closeness, the success a hit at the end."""
    position, target = rng.uniform(-1, 1, 2), rng.uniform(-1, 1, 2)
    observations, actions, rewards = [], [], []
    for _ in range(steps):
        observations.append(np.concatenate([position, target]))
        actions.append(policy.act(observations[-1], rng))
        position = position + 0.3 * np.clip(actions[-1], -1, 1)
        rewards.append(np.exp(-np.linalg.norm(position - target)))
    return Episode(
        observations=np.array(observations),
        actions=np.array(actions),
        rewards=np.array(rewards),
        success=bool(np.linalg.norm(position - target) < 0.3),
        diverged=False,
        terminated=False,
        last_observation=np.concatenate([position, target]),
        alpha=np.zeros(1),
        seed=0,
    )


@pytest.mark.slow
def test_npg_learns_to_reach():
    rng = np.random.default_rng(0)
    policy = GaussianPolicy(["x", "y", "goal x", "goal y"], ["vx", "vy"], rng, init_log_std=-0.5)
    value = ValueFunction(policy.observation_names, rng)
    history = [
        npg_step(policy, value, [reach(policy, rng) for _ in range(30)], NpgConfig(step_size=0.1), rng)
        for _ in range(80)
    ]
    first, last = (np.mean([h["success_rate"] for h in part]) for part in (history[:5], history[-5:]))
    assert first < 0.3 and last > 0.9, f"success rate went from {first:.2f} to {last:.2f}"
    assert history[-1]["explained_variance"] > 0.4


# -- demonstrations beside rewards (DAPG) ----------------------------------------------------------------------


def make_demonstrations(policy, update=0, steps=30):
    rng = np.random.default_rng(5)
    observations = rng.standard_normal((steps, len(policy.observation_names)))
    return npg.Demonstrations(observations, policy.mean(observations) + 0.5 * rng.standard_normal((steps, 3)), update)


def log_likelihood(policy, shown, parameters):
    twin = policy.copy()
    twin.set_parameters(parameters)
    return scipy.stats.norm.logpdf(shown.actions, twin.mean(shown.observations), np.exp(twin.log_std)).sum()


def test_the_demonstrations_pull_is_the_gradient_of_their_likelihood():
    policy = make_policy()
    shown = make_demonstrations(policy, update=3)
    pull, share = npg._pull(policy, shown, NpgConfig(demonstration_weight=0.2, demonstration_decay=0.9))
    assert share == pytest.approx(0.2 * 0.9**3)
    here, step = policy.parameters, 1e-6
    for i in range(0, len(here), 5):
        nudge = step * np.eye(len(here))[i]
        slope = (log_likelihood(policy, shown, here + nudge) - log_likelihood(policy, shown, here - nudge)) / (2 * step)
        assert pull[i] == pytest.approx(slope, rel=1e-4, abs=1e-4), f"parameter {i}"


def test_without_reward_the_policy_follows_the_demonstrations_alone():
    policy = make_policy()
    before, shown = policy.parameters, make_demonstrations(policy)
    batch = [make_episode(policy, np.random.default_rng(i), rewards=np.zeros(20)) for i in range(3)]
    statistics = npg_step(policy, make_value(policy), batch, NpgConfig(step_size=1e-3), np.random.default_rng(0), shown)
    assert statistics["no_signal"] and statistics["demonstration_weight"] == pytest.approx(0.1)
    assert statistics["kl"] == pytest.approx(5e-4, rel=0.1), "a step of another length than the one asked for"
    gain = log_likelihood(policy, shown, policy.parameters) - log_likelihood(policy, shown, before)
    assert gain > 0, f"the demonstrations became {gain:.3f} nats likelier"


def test_the_weight_of_demonstrations_falls_with_every_update():
    weights = []
    for update in (0, 10):
        policy = make_policy()
        batch = [make_episode(policy, np.random.default_rng(i)) for i in range(3)]
        shown = make_demonstrations(policy, update)
        weights.append(npg_step(policy, make_value(policy), batch, NpgConfig(), np.random.default_rng(0), shown)["demonstration_weight"])
    assert weights[1] / weights[0] == pytest.approx(0.95**10) and weights[0] > 0.1, "the best advantage of a batch is above 1"


def test_demonstrations_of_no_weight_change_nothing():
    after = []
    for shown in (None, make_demonstrations(make_policy())):
        policy = make_policy()
        batch = [make_episode(policy, np.random.default_rng(i)) for i in range(3)]
        npg_step(policy, make_value(policy), batch, NpgConfig(demonstration_weight=0), np.random.default_rng(0), shown)
        after.append(policy.parameters)
    np.testing.assert_array_equal(*after)
    with pytest.raises(ToolkitError, match="demonstration_decay is 1.5"):
        NpgConfig(demonstration_decay=1.5)

"""Every number of the learner by a second route: loops, finite differences, dense solves, other libraries."""

import copy
import dataclasses
import json
import pickle
import warnings

import numpy as np
import pytest
import safetensors.numpy
import scipy.stats
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from toolkit.errors import ToolkitError
from toolkit.learning import npg
from toolkit.learning.cloning import CloningConfig, clone
from toolkit.learning.episode import Episode
from toolkit.learning.npg import NpgConfig, npg_step
from toolkit.learning.policy import OBSERVATION_CLIP, GaussianPolicy, MeanActor, ValueFunction, single_thread


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


# -- episodes ------------------------------------------------------------------------------------------------


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


# -- policy and value function -------------------------------------------------------------------------------


def test_numpy_and_torch_agree_on_the_mean():
    policy = make_policy(38, 28, (32, 32))
    observations = 5.0 * np.random.default_rng(0).standard_normal((200, 38))
    by_torch = policy.torch_mean(torch.from_numpy(observations), torch.from_numpy(policy.parameters)).numpy()
    assert np.abs(policy.mean(observations) - by_torch).max() < 1e-12
    one_by_one = np.array([policy.mean(observation) for observation in observations])
    assert np.abs(one_by_one - by_torch).max() < 1e-12


def test_acting_emits_no_warning():
    policy = make_policy()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        policy.act(np.zeros(5), np.random.default_rng(0))
        policy.mean(np.zeros((2, 5)))


def test_layers_are_the_network():
    policy = make_policy()
    layers = policy.layers()
    observation = np.array([100.0, -100.0, 0.1, 0.2, 0.3])  # far out: the clip must show
    x = np.clip((observation - layers.shift) / layers.scale, -OBSERVATION_CLIP, OBSERVATION_CLIP)
    for i, (W, b) in enumerate(layers.weights):
        assert W.dtype == b.dtype == np.float64 and W.flags.c_contiguous and b.flags.c_contiguous
        x = W @ x + b
        if i < len(layers.weights) - 1:
            x = np.tanh(x)
    assert np.abs(x - policy.mean(observation)).max() < 1e-14
    policy.set_parameters(2.0 * policy.parameters)
    flat = np.concatenate([array.ravel() for layer in layers.weights for array in layer])
    assert np.array_equal(flat, policy.parameters[:-3]), "layers() must follow the parameters"
    assert np.array_equal(layers.log_std, policy.parameters[-3:])


def test_acting_draws_from_the_stated_distribution():
    policy = make_policy()
    observation = np.ones(5)
    action = policy.act(observation, np.random.default_rng(3))
    noise = np.random.default_rng(3).standard_normal(3)
    assert np.array_equal(action, policy.mean(observation) + np.exp(policy.log_std) * noise)


def test_log_prob_and_entropy_agree_with_scipy():
    policy = make_policy()
    rng = np.random.default_rng(0)
    observations, actions = rng.standard_normal((50, 5)), rng.standard_normal((50, 3))
    tensors = (torch.from_numpy(a) for a in (observations, actions, policy.parameters))
    normal = scipy.stats.norm(policy.mean(observations), np.exp(policy.log_std))
    assert np.allclose(policy.log_prob(*tensors).numpy(), normal.logpdf(actions).sum(axis=1), atol=1e-12)
    assert policy.entropy() == pytest.approx(normal.entropy()[0].sum(), abs=1e-12)


def test_same_seed_same_initial_policy():
    def make(seed):
        return GaussianPolicy(["a"], ["b"], np.random.default_rng(seed)).parameters

    assert np.array_equal(make(0), make(0)) and not np.array_equal(make(0), make(1))


@pytest.mark.parametrize("kind", [GaussianPolicy, ValueFunction])
@settings(max_examples=25, deadline=None)
@given(
    n_obs=st.integers(1, 6),
    hidden=st.lists(st.integers(1, 5), max_size=3),
    magnitude=st.sampled_from([1e-300, 1e-3, 1.0, 1e300]),
    seed=st.integers(0, 2**32 - 1),
)
def test_files_and_copies_keep_every_bit(kind, tmp_path_factory, n_obs, hidden, magnitude, seed):
    path = tmp_path_factory.mktemp("network") / "network.safetensors"
    rng = np.random.default_rng(seed)
    names = [f"näme {i}/[m]" for i in range(n_obs)]
    network = kind(names, ["x", "y"], rng, hidden) if kind is GaussianPolicy else kind(names, rng, hidden)
    network.set_parameters(magnitude * rng.standard_normal(len(network.parameters)))
    network.set_normalisation(rng.standard_normal(n_obs), rng.uniform(1e-9, 1e9, n_obs))
    network.save(path)
    written = path.read_bytes()
    assert [file.name for file in path.parent.iterdir()] == [path.name], "no temporary file is left"
    for twin in (kind.load(path), network.copy(), copy.deepcopy(network)):
        assert twin.observation_names == tuple(names) and twin.hidden == tuple(hidden)
        twin.save(path)
        assert path.read_bytes() == written
        twin.set_parameters(0.0 * twin.parameters)
        assert not np.array_equal(network.parameters, twin.parameters), "a copy must be independent"
        assert not any(a.any() for layer in twin.layers().weights for a in layer), "views must survive copying"


def test_the_file_says_what_it_holds(tmp_path):
    make_policy().save(tmp_path / "p")
    with safetensors.safe_open(tmp_path / "p", framework="numpy") as file:
        header = json.loads(file.metadata()["meta_evolve"])
        assert header["observation_names"] == [f"obs {i}" for i in range(5)]
        assert header["action_names"] == ["act 0", "act 1", "act 2"] and header["hidden"] == [4, 4]
        assert "layer_0.weight" in file.keys()


def tampered(path, change):
    """Rewrite a saved policy after `change(arrays, header)`."""
    with safetensors.safe_open(path, framework="numpy") as file:
        arrays = {name: file.get_tensor(name) for name in file.keys()}
        header = json.loads(file.metadata()["meta_evolve"])
    change(arrays, header)
    safetensors.numpy.save_file(arrays, path, {"meta_evolve": json.dumps(header)})


@pytest.mark.parametrize(
    ("spoil", "sentence"),
    [
        (lambda path: path.unlink(), "does not exist"),
        (lambda path: path.write_bytes(b""), "damaged"),
        (lambda path: path.write_bytes(path.read_bytes()[:-8]), "damaged"),
        (lambda path: path.write_bytes(b"\x80\x04K\x01." * 100), "damaged"),
        (lambda path: safetensors.numpy.save_file({"a": np.zeros(1)}, path), "not a saved policy"),
        (lambda path: make_value(make_policy()).save(path), "holds a value function"),
        (lambda path: tampered(path, lambda a, h: a["layer_1.weight"].fill(np.nan)), "layer_1.weight .* not finite"),
        (lambda path: tampered(path, lambda a, h: a["observation_scale"].fill(0.0)), "scale is not positive"),
        (lambda path: tampered(path, lambda a, h: h["observation_names"].pop()), "header asks for"),
        (lambda path: tampered(path, lambda a, h: a.pop("log_std")), "lacks or adds"),
        (lambda path: tampered(path, lambda a, h: h.update(hidden=[10**12, 4])), "incomplete header"),
        (lambda path: tampered(path, lambda a, h: h.pop("action_names")), "incomplete header"),
        (lambda path: tampered(path, lambda a, h: a.update(log_std=np.zeros(3, np.float32))), "float32"),
    ],
)
def test_a_broken_file_gets_one_clear_sentence(tmp_path, spoil, sentence):
    path = tmp_path / "policy.safetensors"
    make_policy().save(path)
    spoil(path)
    with pytest.raises(ToolkitError, match=sentence) as caught:
        GaussianPolicy.load(path)
    assert str(path) in str(caught.value)


def test_loading_checks_the_expected_names(tmp_path):
    policy = make_policy()
    policy.save(tmp_path / "p")
    GaussianPolicy.load(tmp_path / "p", policy.observation_names, policy.action_names)
    with pytest.raises(ToolkitError, match="has 5 observation entries, not 4"):
        GaussianPolicy.load(tmp_path / "p", policy.observation_names[:4])
    with pytest.raises(ToolkitError, match="action entry 0 is 'act 0', not 'act 2'"):
        GaussianPolicy.load(tmp_path / "p", action_names=policy.action_names[::-1])


def test_wrong_arguments_are_refused(tmp_path):
    policy = make_policy()
    for call, sentence in (
        (lambda: policy.set_parameters(np.zeros(3)), "shape"),
        (lambda: policy.set_parameters(np.full_like(policy.parameters, np.nan)), "parameters\\[0\\]"),
        (lambda: policy.set_normalisation(np.zeros(5), np.zeros(5)), "'obs 0' is 0.0"),
        (lambda: GaussianPolicy(["a", "a"], ["b"], np.random.default_rng(0)), "all different"),
        (lambda: policy.save(tmp_path / "nowhere" / "p"), "cannot be written"),
        (lambda: NpgConfig(gamma=1.5), "gamma is 1.5"),
        (lambda: CloningConfig(epochs=0), "epochs is 0"),
        (lambda: npg_step(policy, make_value(policy), [], NpgConfig(), np.random.default_rng(0)), "0 episodes"),
    ):
        with pytest.raises(ToolkitError, match=sentence):
            call()


def test_the_value_function_fits_returns_of_any_size():
    policy, rng = make_policy(), np.random.default_rng(0)
    value = ValueFunction(policy.observation_names, rng)
    observations = rng.standard_normal((1000, 5))
    for size in (1.0, 1e4):  # warm start across a jump in size
        returns = size * (np.sin(observations[:, 0]) + 30.0)
        tensors = torch.from_numpy(observations), torch.from_numpy(returns)
        with single_thread():  # as an update does
            loss = npg.fit_value(value, *tensors, NpgConfig(value_epochs=30), rng)
        variance = returns.var()
        error = np.square(value.predict(observations) - returns).mean()
        assert error < 0.05 * variance and loss == pytest.approx(error / variance, rel=1e-6)


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


# -- cloning -------------------------------------------------------------------------------------------------


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



def test_cloning_fits_a_linear_map():
    rng = np.random.default_rng(0)
    policy = GaussianPolicy([f"o{i}" for i in range(6)], ["a", "b"], rng)
    observations = rng.uniform(-1.0, 1.0, (2000, 6)) * [1.0, 10.0, 0.1, 1.0, 1.0, 1.0] + [0, 50, 0, 0, 0, 0]
    actions = (observations - [0, 50, 0, 0, 0, 0]) @ rng.standard_normal((6, 2)) * 0.2
    seen = []
    losses = clone(policy, observations, actions, CloningConfig(), rng, lambda *report: seen.append(report))
    assert seen == list(enumerate(losses, start=1))
    error = np.square(policy.mean(observations) - actions).mean() / actions.var()
    assert error < 1e-3, f"unexplained share of the variance is {error:.1e}"
    assert np.array_equal(policy.log_std, [-1.5, -1.5])


def test_a_constant_entry_keeps_the_scale_floor():
    rng = np.random.default_rng(0)
    policy = make_policy(2, 1)
    observations = np.column_stack([rng.standard_normal(50), np.full(50, 0.8)])
    observations.flags.writeable = False
    clone(policy, observations, np.zeros((50, 1)), CloningConfig(epochs=1), rng, scale_floor=np.array([0.01, 0.2]))
    assert policy.layers().scale[1] == 0.2 and policy.layers().shift[1] == pytest.approx(0.8)
    assert policy.layers().scale[0] == pytest.approx(observations[:, 0].std())


def test_cloning_refuses_bad_demonstrations():
    policy, rng = make_policy(), np.random.default_rng(0)
    observations = np.zeros((4, 5))
    observations[2, 1] = np.inf
    for arguments, sentence in (
        ((np.zeros((4, 6)), np.zeros((4, 3))), "observations have shape"),
        ((np.zeros((4, 5)), np.zeros((3, 3))), "actions have shape"),
        ((np.zeros((0, 5)), np.zeros((0, 3))), "observations have shape"),
        ((observations, np.zeros((4, 3))), "row 2"),
    ):
        with pytest.raises(ToolkitError, match=sentence):
            clone(policy, *arguments, CloningConfig(), rng)


def test_a_policys_mean_may_be_sent_to_another_process():
    policy, rng = make_policy(), np.random.default_rng(3)
    sent = pickle.loads(pickle.dumps(MeanActor(policy)))  # noqa: S301 -- as multiprocessing does
    for observation in rng.standard_normal((5, 5)):
        assert np.array_equal(sent(observation, rng), policy.mean(observation))
    assert rng.standard_normal() == [*np.random.default_rng(3).standard_normal(26)][-1], "it draws nothing"

"""Policy and value function by a second route: NumPy against torch, SciPy's distributions, files bit for bit."""

import copy
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
from toy_policies import make_policy, make_value

from tasks.sight import Sight
from toolkit.errors import ToolkitError
from toolkit.learning import npg
from toolkit.learning.cloning import CloningConfig
from toolkit.learning.npg import NpgConfig, npg_step
from toolkit.learning.policy import OBSERVATION_CLIP, GaussianPolicy, MeanActor, ValueFunction, single_thread


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


def test_through_a_sight_a_policy_does_what_it_does_on_what_is_seen():
    rng = np.random.default_rng(2)
    policy = GaussianPolicy(["a", "b", "c"], ["u", "v"], rng, hidden=(5, 4))
    scale = np.array([0.1, 1.0, 30.0])
    policy.set_normalisation(scale * rng.normal(size=3), scale)
    sight = Sight(np.eye(3) + 0.3 * rng.normal(size=(3, 3)) * scale[:, None] / scale, scale * rng.normal(size=3))
    observations = scale * rng.normal(size=(7, 3))
    before = policy.parameters
    np.testing.assert_allclose(policy.through(sight).mean(observations), policy.mean(sight(observations)), rtol=0, atol=1e-12)
    np.testing.assert_array_equal(policy.parameters, before)
    plain = policy.through(Sight.plain(3))
    np.testing.assert_array_equal(plain.parameters, before)
    np.testing.assert_array_equal(plain.layers().shift, policy.layers().shift)


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


def test_a_policys_mean_may_be_sent_to_another_process():
    policy, rng = make_policy(), np.random.default_rng(3)
    sent = pickle.loads(pickle.dumps(MeanActor(policy)))  # noqa: S301 -- as multiprocessing does
    for observation in rng.standard_normal((5, 5)):
        assert np.array_equal(sent(observation, rng), policy.mean(observation))
    assert rng.standard_normal() == [*np.random.default_rng(3).standard_normal(26)][-1], "it draws nothing"

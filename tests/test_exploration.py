"""The search's distribution: mirrored samples, its natural gradient against the likelihood's own, and offsets as policies."""

import numpy as np
import pytest
import torch

from toolkit.errors import ToolkitError
from toolkit.learning.exploration import SearchConfig, mirrored, natural_step, shifted
from toolkit.learning.policy import GaussianPolicy


def test_mirrored_samples_come_in_pairs_and_are_normal():
    z = mirrored(5000, 3, np.random.default_rng(0))
    np.testing.assert_array_equal(z[0::2], -z[1::2])
    np.testing.assert_allclose(z.mean(axis=0), 0.0, atol=1e-12)
    np.testing.assert_allclose(np.cov(z.T), np.eye(3), atol=0.06)


def test_the_step_is_the_natural_gradient_of_the_logarithm_of_success():
    """Against torch: gradient of log sum y p(x), times the inverse of the Fisher matrix of a normal distribution (1 / s^2 and 2)."""
    rng = np.random.default_rng(1)
    z = mirrored(12, 4, rng)
    success = (rng.random(24) < 0.4).astype(float)
    centre, log_deviation = rng.standard_normal(4), rng.normal(-1.0, 0.3, 4)
    x = torch.tensor(centre + np.exp(log_deviation) * z)
    mean, log_s = torch.tensor(centre, requires_grad=True), torch.tensor(log_deviation, requires_grad=True)
    likelihood = torch.distributions.Normal(mean, torch.exp(log_s)).log_prob(x).sum(dim=1)
    y = torch.tensor(success)
    # The score function: the gradient of E[y] is the mean of y grad log p; a baseline, here the batch's mean, changes no expectation.
    plain = torch.autograd.grad((y * likelihood).mean() / y.mean(), mean, retain_graph=True)[0].numpy()
    based = torch.autograd.grad(((y - y.mean()) * likelihood).mean() / y.mean(), log_s)[0].numpy()
    found_mean, found_log = natural_step(z, success, prior=0.0)
    np.testing.assert_allclose(found_mean * np.exp(log_deviation), plain * np.exp(2 * log_deviation), rtol=1e-10)
    np.testing.assert_allclose(found_log, based / 2, rtol=1e-10, atol=1e-12)


def test_without_a_prior_the_mean_goes_to_that_of_the_samples_that_succeeded():
    z, success = np.array([[1.0, 2.0], [-1.0, -2.0], [3.0, 0.0], [-3.0, 0.0]]), np.array([1.0, 0.0, 1.0, 0.0])
    np.testing.assert_allclose(natural_step(z, success, 0.0)[0], [2.0, 1.0])
    np.testing.assert_allclose(natural_step(z, success, 2.0)[0], [1.0, 0.5])


@pytest.mark.parametrize("success", [np.zeros(4), np.ones(4)])
def test_where_all_end_alike_nothing_moves(success):
    mean, spread = natural_step(mirrored(2, 3, np.random.default_rng(0)), success, 2.0)
    np.testing.assert_allclose(mean, 0.0, atol=1e-15)
    np.testing.assert_allclose(spread, 0.0, atol=1e-15)


def test_the_deviation_narrows_where_success_is_near_and_widens_where_it_is_far():
    z = mirrored(2000, 1, np.random.default_rng(2))
    near, far = (np.abs(z[:, 0]) < 0.5).astype(float), (np.abs(z[:, 0]) > 1.5).astype(float)
    assert natural_step(z, near, 0.0)[1][0] < -0.2 and natural_step(z, far, 0.0)[1][0] > 0.5


def test_the_search_finds_what_is_two_deviations_away():
    """Success within one deviation of a place two and a half away, in ten dimensions of which three matter."""
    rng, goal = np.random.default_rng(3), np.array([2.0, -1.0, 1.0, *np.zeros(7)])
    centre, deviation, rates = np.zeros(10), np.ones(10), []
    for _ in range(30):
        z = mirrored(12, 10, rng)
        found = (np.linalg.norm((centre + deviation * z - goal)[:, :3], axis=1) < 1.0).astype(float)
        mean, spread = natural_step(z, found, 2.0)
        centre, deviation = centre + deviation * mean, np.clip(deviation * np.exp(0.5 * spread), 0.25, 2.0)
        rates.append(found.mean())
    assert np.linalg.norm((centre - goal)[:3]) < 0.5 and np.mean(rates[-5:]) > 3 * np.mean(rates[:5]), rates


def policy():
    made = GaussianPolicy(["a", "b"], ["x"], np.random.default_rng(0), hidden=(4,))
    made.set_normalisation(np.array([0.3, -0.2]), np.array([0.5, 2.0]))
    return made


def test_an_offset_is_what_the_policy_sees(tmp_path):
    """And nothing but its normalisation: a file of it plays the same, and the policy itself is left as it was."""
    original, offset = policy(), np.array([0.05, -0.4])
    moved, seen = shifted(original, offset), np.random.default_rng(1).standard_normal((20, 2))
    np.testing.assert_allclose(moved.mean(seen), original.mean(seen - offset), rtol=1e-12, atol=1e-15)
    np.testing.assert_array_equal(moved.parameters, original.parameters)
    np.testing.assert_array_equal(original.layers().shift, [0.3, -0.2])
    moved.save(tmp_path / "moved.safetensors")
    np.testing.assert_array_equal(GaussianPolicy.load(tmp_path / "moved.safetensors").mean(seen), moved.mean(seen))


@pytest.mark.parametrize("field, value", [("batch_size", 7), ("batch_size", 2), ("prior", -1.0), ("deviation_rate", 1.5),
                                          ("narrowest", 0.0), ("widest", 0.5)])  # fmt: skip
def test_settings_are_checked(field, value):
    with pytest.raises(ToolkitError, match=rf"SearchConfig\.{field} is {value}"):
        SearchConfig(**{field: value})

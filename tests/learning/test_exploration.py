"""The search's distribution: mirrored samples, its natural gradient against the likelihood's own, and offsets as policies."""

import numpy as np
import pytest
import torch

from toolkit.errors import ToolkitError
from toolkit.learning.exploration import Directions, Explored, Gain, Gains, SearchConfig, Trials, leading_features, mirrored, natural_step
from toolkit.learning.policy import GaussianPolicy


def step_of(z, success, prior):
    """The natural step from one batch at the origin with unit deviations."""
    zero, one = np.zeros(z.shape[1]), np.ones(z.shape[1])
    return natural_step(Trials.none(z.shape[1]).add(z, zero, one, success, len(z)), zero, one, prior)


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
    played = Trials.none(4).add(x.numpy(), centre, np.exp(log_deviation), success, 24)
    found_mean, found_log = natural_step(played, centre, np.exp(log_deviation), prior=0.0)
    np.testing.assert_allclose(found_mean * np.exp(log_deviation), plain * np.exp(2 * log_deviation), rtol=1e-10)
    np.testing.assert_allclose(found_log, based / 2, rtol=1e-10, atol=1e-12)


def test_without_a_prior_the_mean_goes_to_that_of_the_samples_that_succeeded():
    z, success = np.array([[1.0, 2.0], [-1.0, -2.0], [3.0, 0.0], [-3.0, 0.0]]), np.array([1.0, 0.0, 1.0, 0.0])
    np.testing.assert_allclose(step_of(z, success, 0.0)[0], [2.0, 1.0])
    np.testing.assert_allclose(step_of(z, success, 2.0)[0], [1.0, 0.5])


@pytest.mark.parametrize("success", [np.zeros(4), np.ones(4)])
def test_where_all_end_alike_nothing_moves(success):
    mean, spread = step_of(mirrored(2, 3, np.random.default_rng(0)), success, 2.0)
    np.testing.assert_allclose(mean, 0.0, atol=1e-15)
    np.testing.assert_allclose(spread, 0.0, atol=1e-15)


def test_the_deviation_narrows_where_success_is_near_and_widens_where_it_is_far():
    z = mirrored(2000, 1, np.random.default_rng(2))
    near, far = (np.abs(z[:, 0]) < 0.5).astype(float), (np.abs(z[:, 0]) > 1.5).astype(float)
    assert step_of(z, near, 0.0)[1][0] < -0.2 and step_of(z, far, 0.0)[1][0] > 0.5


def test_what_was_measured_at_the_centre_counts_as_trials_there():
    """Written out as so many more trials with z = 0, which their own weights (1, of one distribution) leave as they are."""
    rng = np.random.default_rng(3)
    z, centre, deviation = mirrored(8, 3, rng), rng.standard_normal(3), rng.uniform(0.5, 2.0, 3)
    success = (rng.random(16) < 0.3).astype(float)
    drawn = centre + deviation * z
    played = Trials.none(3).add(drawn, centre, deviation, success, 16)
    all_drawn, all_ended = np.vstack([drawn, np.tile(centre, (10, 1))]), np.append(success, [1.0] * 4 + [0.0] * 6)
    written = natural_step(Trials.none(3).add(all_drawn, centre, deviation, all_ended, 26), centre, deviation, 1.0)
    for found, expected in zip(natural_step(played, centre, deviation, 1.0, 0.4, 10), written, strict=True):
        np.testing.assert_allclose(found, expected, rtol=1e-12)


def test_a_centre_that_succeeds_more_often_than_what_is_drawn_around_it_narrows_the_deviation():
    """Also where nothing that was drawn succeeds; the centre then stays where it is."""
    z, zero, one = mirrored(8, 3, np.random.default_rng(5)), np.zeros(3), np.ones(3)
    mean, spread = natural_step(Trials.none(3).add(z, zero, one, np.zeros(16), 16), zero, one, 1.0, 0.25, 16)
    np.testing.assert_allclose(mean, 0.0, atol=1e-15)
    assert (spread < -0.1).all()
    near = (np.abs(z[:, 0]) < 0.5).astype(float)
    played = Trials.none(3).add(z, zero, one, near, 16)
    often, seldom = (natural_step(played, zero, one, 1.0, rate, 16)[1] for rate in (0.9, 0.0))
    assert (often < seldom).all()


def search(reuse, seed, batches=8, width=0.9):
    """Rates of success per batch, and of the centre at the end, where a place two deviations away is to be found."""
    rng, goal = np.random.default_rng(seed), np.array([1.5, -1.0, 0.9, *np.zeros(4)])
    centre, deviation, trials, rates = np.zeros(7), np.ones(7), Trials.none(7), []
    chance = lambda x: np.exp(-0.5 * (((x - goal)[..., :3] / width) ** 2).sum(axis=-1) ** 2)  # noqa: E731
    for _ in range(batches):
        drawn = centre + deviation * mirrored(12, 7, rng)
        success = (rng.random(24) < chance(drawn)).astype(float)
        trials = trials.add(drawn, centre, deviation, success, reuse)
        mean, spread = natural_step(trials, centre, deviation, 1.0)
        centre, deviation = centre + deviation * mean, np.clip(deviation * np.exp(0.5 * spread), 0.25, 2.0)
        rates.append(success.mean())
    return rates, float(chance(centre))


def test_the_search_finds_what_is_two_deviations_away():
    found = [search(144, seed) for seed in range(20)]
    first, last = np.mean([rates[0] for rates, _ in found]), np.mean([rates[-1] for rates, _ in found])
    reached = np.mean([end for _, end in found])
    assert last > 4 * first and reached > 0.8, f"success rose from {first:.2f} to {last:.2f}, {reached:.2f} at the centre"


def test_earlier_trials_save_episodes():
    """Nothing else changed: used again, trials reach more than those of the last batch alone."""
    with_all, last_only = (np.mean([search(reuse, seed, 6, 0.5)[1] for seed in range(60)]) for reuse in (144, 24))
    assert with_all > last_only + 0.05, f"{with_all:.2f} with earlier trials, {last_only:.2f} without"


def test_weights_make_trials_of_several_distributions_speak_for_one():
    """Importance sampling: the mean of x^2 under N(1, 0.5), from trials of N(0, 1) and N(0.7, 0.8)."""
    rng, trials = np.random.default_rng(4), Trials.none(1)
    for centre, deviation in ((0.0, 1.0), (0.7, 0.8)):
        drawn = rng.normal(centre, deviation, (20_000, 1))
        trials = trials.add(drawn, np.array([centre]), np.array([deviation]), np.zeros(len(drawn)), 10**6)
    weights = trials.weights(np.array([1.0]), np.array([0.5]))
    assert weights.mean() == pytest.approx(1.0, abs=0.02)
    assert weights @ trials.offsets[:, 0] ** 2 / len(weights) == pytest.approx(1.25, abs=0.03)


def test_only_the_last_trials_are_kept():
    one, two = np.zeros((4, 2)), np.ones((4, 2))
    trials = Trials.none(2).add(one, np.zeros(2), np.ones(2), np.zeros(4), 6).add(two, np.ones(2), np.ones(2), np.ones(4), 6)
    np.testing.assert_array_equal(trials.success, [0, 0, 1, 1, 1, 1])
    np.testing.assert_array_equal(trials.centres[:, 0], [0, 0, 1, 1, 1, 1])


def policy():
    made = GaussianPolicy(["a", "b"], ["x"], np.random.default_rng(0), hidden=(4,))
    made.set_normalisation(np.array([0.3, -0.2]), np.array([0.5, 2.0]))
    return made


def offsets_of(size):
    """Directions that offset every entry of ``size`` observations, and no response."""
    return Directions(Explored(np.ones(size), np.zeros(1)), np.zeros((0, 5)))


def test_an_offset_is_what_the_policy_sees(tmp_path):
    """And nothing but its normalisation: a file of it plays the same, and the policy itself is left as it was."""
    original, offset = policy(), np.array([0.05, -0.4])
    moved, seen = offsets_of(2).moved(original, offset), np.random.default_rng(1).standard_normal((20, 2))
    np.testing.assert_allclose(moved.mean(seen), original.mean(seen - offset), rtol=1e-12, atol=1e-15)
    np.testing.assert_array_equal(moved.parameters, original.parameters)
    np.testing.assert_array_equal(original.layers().shift, [0.3, -0.2])
    moved.save(tmp_path / "moved.safetensors")
    np.testing.assert_array_equal(GaussianPolicy.load(tmp_path / "moved.safetensors").mean(seen), moved.mean(seen))


def test_only_what_is_declared_is_moved():
    """The second of two observations, the first and the last of three actions: d = 1 + 2 K, deviations in that order."""
    explored = Explored(np.array([0.0, 0.5]), np.array([0.1, 0.0, 0.2]))
    original = GaussianPolicy(["a", "b"], ["x", "y", "z"], np.random.default_rng(0), hidden=(4,))
    seen = np.random.default_rng(1).standard_normal((200, 2))
    directions = Directions(explored, leading_features(original, seen, 2))
    np.testing.assert_array_equal(directions.deviation, [0.5, 0.1, 0.1, 0.2, 0.2])
    moved = directions.moved(original, np.array([0.0, 1.0, 0.0, 0.0, 2.0]))
    change = moved.mean(seen) - original.mean(seen)
    np.testing.assert_allclose(np.sqrt((change**2).mean(axis=0)), [1.0, 0.0, 2.0], atol=1e-9)
    np.testing.assert_allclose((change[:, 0] * change[:, 2]).mean(), 0.0, atol=1e-9)
    np.testing.assert_array_equal(directions.moved(original, np.array([0.3, 0, 0, 0, 0])).layers().shift, [0.0, 0.3])


def test_steps_add_up():
    """So that a search may count its steps from where its turn began."""
    rng, original = np.random.default_rng(2), policy()
    directions = Directions(Explored(np.ones(2), np.ones(1)), leading_features(original, rng.standard_normal((50, 2)), 3))
    first, second = rng.standard_normal((2, len(directions.deviation)))
    seen = rng.standard_normal((20, 2))
    twice = directions.moved(directions.moved(original, first), second)
    np.testing.assert_allclose(twice.mean(seen), directions.moved(original, first + second).mean(seen), rtol=1e-10, atol=1e-12)


def test_a_gain_is_how_large_an_entry_is_seen_or_done():
    """About the zero of the entry itself, not of the normalisation, which has a shift; and steps add up."""
    original, gains = policy(), Gains((Gain("observation", slice(1, 2), 0.4), Gain("action", slice(0, 1), 0.2)))
    np.testing.assert_array_equal(gains.deviation, [0.4, 0.2])
    seen = np.random.default_rng(1).standard_normal((20, 2))
    moved = gains.moved(original, np.log([0.5, 3.0]))
    np.testing.assert_allclose(moved.mean(seen), 3.0 * original.mean(seen * [1.0, 0.5]), rtol=1e-12, atol=1e-15)
    again = gains.moved(moved, np.log([2.0, 1 / 3]))
    np.testing.assert_allclose(again.mean(seen), original.mean(seen), rtol=1e-12, atol=1e-15)
    np.testing.assert_array_equal(original.layers().shift, [0.3, -0.2])


def test_leading_features_are_the_last_layers_fisher_directions():
    """Against torch: the Fisher matrix of the mean's last layer for unit noise is the mean of the outer product of its gradient."""
    made, seen = policy(), np.random.default_rng(3).standard_normal((300, 2))
    parameters = torch.tensor(made.parameters, requires_grad=True)
    rows = []
    for row in torch.tensor(seen):
        (gradient,) = torch.autograd.grad(made.torch_mean(row[None], parameters)[0, 0], parameters)
        rows.append(gradient[-6:-1].numpy())  # W (1, 4) and b of the last layer; the standard deviation is the last
    fisher = np.array(rows).T @ np.array(rows) / len(rows)
    found = leading_features(made, seen, 5)
    np.testing.assert_allclose(found @ fisher @ found.T, np.eye(5), atol=1e-8)
    spread = np.linalg.norm(found, axis=1)
    assert (np.diff(spread) > 0).all(), "the leading one needs the smallest weights for the same change of the action"


@pytest.mark.parametrize("observation, action", [([0.0, 0.0], [1.0]), ([1.0, -1.0], [0.0]), ([1.0, 1.0], [-1.0])])
def test_something_has_to_be_explored(observation, action):
    with pytest.raises(ToolkitError, match="declare one in the task"):
        Explored(np.array(observation), np.array(action))


@pytest.mark.parametrize("field, value", [("batch_size", 7), ("batch_size", 2), ("prior", -1.0), ("reuse", 15), ("deviation_rate", 1.5),
                                          ("narrowest", 0.0), ("polish", 0.0), ("regain", 0.9), ("features", 0), ("responses", 0),
                                          ("widest", 0.5)])
def test_settings_are_checked(field, value):
    with pytest.raises(ToolkitError, match=rf"SearchConfig\.{field} is {value}"):
        SearchConfig(**{field: value})


@pytest.mark.parametrize("actions, features", [(1, 4), (3, 4), (8, 4), (11, 2), (28, 1), (40, 1)])
def test_many_actions_respond_to_few_features(actions, features):
    assert SearchConfig().features_of(actions) == features

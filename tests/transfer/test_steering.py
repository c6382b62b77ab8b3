"""The direction of a step, on returns whose gradient is known."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from toolkit.transfer.steering import TRUST, heading, jacobian, sample_robots


def test_the_jacobian_of_a_linear_return_is_found_wherever_it_was_sampled():
    """36 pairs in 20 dimensions: more equations than unknowns, and whatever a seed is worth falls out."""
    rng = np.random.default_rng(0)
    slope, alpha = rng.standard_normal(20), np.full(20, 0.5)
    robots = sample_robots(alpha, 72, 0.03, rng)
    luck = np.repeat(rng.standard_normal(36), 2)
    np.testing.assert_allclose(jacobian(robots, robots @ slope + luck), slope, rtol=1e-9)


def test_beside_the_box_and_with_fewer_robots_than_dimensions_the_sampled_part_is_found():
    """In a corner half of every pair is clipped; what the pairs span is found, and nothing beside it."""
    rng = np.random.default_rng(1)
    slope, alpha = rng.standard_normal(200), np.zeros(200)
    robots = sample_robots(alpha, 72, 0.03, rng)
    assert robots.min() >= 0 and np.linalg.norm(robots - alpha, axis=1).max() <= 0.03
    found = jacobian(robots, robots @ slope)
    steps = robots[0::2] - robots[1::2]
    np.testing.assert_allclose(steps @ found, steps @ slope, rtol=1e-8)
    assert found @ slope > 0 and np.linalg.norm(found) <= np.linalg.norm(slope)


def test_robots_are_sampled_at_the_radius_in_pairs():
    robots = sample_robots(np.full(50, 0.5), 9, 0.1, np.random.default_rng(2))
    assert robots.shape == (9, 50)
    np.testing.assert_allclose(np.linalg.norm(robots - 0.5, axis=1), 0.1, rtol=1e-12)
    np.testing.assert_allclose(robots[0:8:2] + robots[1:8:2], 1.0, atol=1e-12)


def test_the_heading_is_the_gradient_of_the_objective():
    """Small slopes are added whole: the direction of d/dl of E[rho] - lambda / 2 |meta - alpha - l|^2 at l = 0."""
    rng = np.random.default_rng(3)
    alpha, meta, slope = rng.random(6), rng.random(6), 0.1 * rng.standard_normal(6)
    weight, step = 0.7, 1e-6
    objective = lambda l: slope @ l - weight / 2 * ((meta - alpha - l) ** 2).sum()  # noqa: E731
    gradient = np.array([(objective(step * e) - objective(-step * e)) / (2 * step) for e in np.eye(6)])
    np.testing.assert_allclose(heading(slope, alpha, meta, weight), gradient / np.linalg.norm(gradient), atol=1e-7)


@given(st.integers(0, 1000), st.floats(-6, 6), st.floats(-2, 2))
def test_every_heading_comes_nearer(seed, magnitude, weight):
    """However wrong and however large the estimate is."""
    rng = np.random.default_rng(seed)
    alpha, meta, slope = rng.random(8), rng.random(8), 10.0**magnitude * rng.standard_normal(8)
    way = heading(slope, alpha, meta, 10.0**weight)
    assert np.linalg.norm(way) == pytest.approx(1)
    assert way @ (meta - alpha) >= (np.sqrt(1 - TRUST**2) - 1e-9) * np.linalg.norm(meta - alpha)


def test_without_a_slope_the_heading_is_straight():
    alpha, meta = np.zeros(4), np.array([0.3, 0.0, 0.4, 0.0])
    np.testing.assert_allclose(heading(np.zeros(4), alpha, meta, 1.0), [0.6, 0.0, 0.8, 0.0])

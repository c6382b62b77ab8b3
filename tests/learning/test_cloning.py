"""Behaviour cloning: what is shown is fitted."""

import numpy as np
import pytest
from toy_policies import make_policy

from toolkit.errors import ToolkitError
from toolkit.learning.cloning import CloningConfig, clone
from toolkit.learning.policy import GaussianPolicy


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

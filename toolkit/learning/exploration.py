"""Exploration in a few of the policy's own parameters, held for an episode: offsets of what it believes it sees.

White noise on the actions, twenty times a second, hardly moves a grasp: the policy's own feedback takes it back. An offset
of a few entries of the observation, the same for a whole episode, moves it by just that much, and is a parameter of the policy
already: the shift of its normalisation. So the policy plays as it is, without noise on its actions, once per offset drawn from a
normal distribution, and the distribution follows the offsets that succeed.

Sources: policy gradients in parameter space and pairs of mirrored samples are Sehnke et al., "Parameter-exploring Policy
Gradients", Neural Networks 23, 2010; the natural gradient of a search distribution, also of its deviations, is Wierstra et
al., "Natural Evolution Strategies", JMLR 15, 2014 (its separable form: Schaul, Glasmachers and Schmidhuber, "High Dimensions
and Heavy Tails for Natural Evolution Strategies", GECCO 2011).
"""

import math
from dataclasses import dataclass

import numpy as np

from toolkit.errors import ToolkitError
from toolkit.learning.policy import GaussianPolicy


@dataclass(frozen=True)
class SearchConfig:
    """Hyperparameters of the search; numbers without a unit are shares.

    Raises:
        ToolkitError: a value outside its range.
    """

    batch_size: int = 24
    """Episodes of one update, in mirrored pairs."""
    prior: float = 2.0
    """Successes that count for the offset as it is: two successes alone move it half of the way to their mean."""
    deviation_rate: float = 0.5
    """How fast deviations follow: factor on the natural gradient of their logarithm (Wierstra et al.: (3 + log d) / (5 sqrt d),
    0.47 in three dimensions)."""
    narrowest: float = 1 / 4
    """Least deviation, of the one the task declares."""
    widest: float = 2.0
    """Greatest deviation, of the one the task declares."""

    def __post_init__(self) -> None:
        if self.batch_size < 4 or self.batch_size % 2:
            raise ToolkitError(f"SearchConfig.batch_size is {self.batch_size}; give an even number from 4 on: episodes come in pairs")
        for name, valid, mend in (
            ("prior", self.prior >= 0, "0 or more"),
            ("deviation_rate", 0 <= self.deviation_rate <= 1, "a number in [0, 1]"),
            ("narrowest", 0 < self.narrowest <= 1, "a number in (0, 1]"),
            ("widest", 1 <= self.widest < math.inf, "a number from 1 on"),
        ):
            if not valid:
                raise ToolkitError(f"SearchConfig.{name} is {getattr(self, name)}; give {mend}")


def mirrored(pairs: int, dimensions: int, rng: np.random.Generator) -> np.ndarray:
    """(2 pairs, dimensions) standard normal samples; each is followed by its mirror image, so that their mean is 0."""
    half = rng.standard_normal((pairs, dimensions))
    return np.stack([half, -half], axis=1).reshape(2 * pairs, dimensions)


def shifted(policy: GaussianPolicy, offset: np.ndarray) -> GaussianPolicy:
    """A copy of the policy that sees every observation less ``offset`` (n_obs,), in the unit of each entry."""
    twin = policy.copy()
    layers = twin.layers()
    twin.set_normalisation(layers.shift + offset, np.array(layers.scale))
    return twin


def natural_step(z: np.ndarray, success: np.ndarray, prior: float) -> tuple[np.ndarray, np.ndarray]:
    """Natural gradient of the logarithm of expected success, for a normal distribution with independent entries.

    Per entry, in units of the deviation: sum(y z) / (sum(y) + prior) for the mean, which without a prior is the mean of the samples
    that succeeded, and half of sum(y (z^2 - 1)) / (sum(y) + prior) for the logarithm of the deviation. Mirrored samples sum to 0,
    so no baseline changes the first; the second counts success above the batch's mean.

    Args:
        z: (N, d) standard normal samples.
        success: (N,) 0 or 1.
        prior: successes at z = 0 that are counted besides those seen.

    Returns:
        (d,) for the mean, (d,) for the logarithm of the deviation; zeros without any success.
    """
    total = success.sum()
    if total == 0:
        return np.zeros(z.shape[1]), np.zeros(z.shape[1])
    above = success - success.mean()
    return success @ z / (total + prior), 0.5 * above @ (z * z - 1.0) / (total + prior)

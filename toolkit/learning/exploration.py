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

    batch_size: int = 16
    """Episodes of one update, in mirrored pairs."""
    prior: float = 1.0
    """Successes that count for the offset as it is: a single one moves it half of the way."""
    reuse: int = 144
    """Trials on one robot, the last ones, that an update learns from, earlier batches by their importance."""
    deviation_rate: float = 0.5
    """How fast deviations follow: factor on the natural gradient of their logarithm (Wierstra et al.: (3 + log d) / (5 sqrt d),
    0.47 in three dimensions)."""
    polish: float = 0.3
    """Deviation with which the search begins where the policy holds already and is to hold more often, of the one the task declares."""
    regain: float = 1.5
    """Factor on the deviation with which one phase ends, for the next one's beginning; never more than the task declares."""
    narrowest: float = 1 / 8
    """Least deviation, of the one the task declares."""
    widest: float = 2.0
    """Greatest deviation, of the one the task declares."""

    def __post_init__(self) -> None:
        if self.batch_size < 4 or self.batch_size % 2:
            raise ToolkitError(f"SearchConfig.batch_size is {self.batch_size}; give an even number from 4 on: episodes come in pairs")
        for name, valid, mend in (
            ("prior", self.prior >= 0, "0 or more"),
            ("reuse", self.reuse >= self.batch_size, f"at least a batch, {self.batch_size}"),
            ("deviation_rate", 0 <= self.deviation_rate <= 1, "a number in [0, 1]"),
            ("narrowest", 0 < self.narrowest <= 1, "a number in (0, 1]"),
            ("polish", 0 < self.polish <= 1, "a number in (0, 1]"),
            ("regain", 1 <= self.regain < math.inf, "a number from 1 on"),
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


@dataclass
class Trials:
    """Offsets that were played on one robot: where each was drawn, and how it ended. M trials, d explored entries.

    Attributes:
        offsets: (M, d) values of the explored shifts themselves, each in its entry's unit.
        centres, deviations: (M, d) of the distribution that each was drawn from.
        success: (M,) 0 or 1.
    """

    offsets: np.ndarray
    centres: np.ndarray
    deviations: np.ndarray
    success: np.ndarray

    @classmethod
    def none(cls, dimensions: int) -> "Trials":
        """No trials yet, of d dimensions."""
        empty = np.zeros((0, dimensions))
        return cls(empty, empty, empty, np.zeros(0))

    def add(self, offsets: np.ndarray, centre: np.ndarray, deviation: np.ndarray, success: np.ndarray, most: int) -> "Trials":
        """With a batch (N, d) from one distribution added at the end; of all only the last ``most`` stay."""
        batch = (offsets, np.broadcast_to(centre, offsets.shape), np.broadcast_to(deviation, offsets.shape), success)
        old = (self.offsets, self.centres, self.deviations, self.success)
        return Trials(*(np.concatenate(pair)[-most:] for pair in zip(old, batch, strict=True)))

    def weights(self, centre: np.ndarray, deviation: np.ndarray) -> np.ndarray:
        """(M,) importance weights of the trials for the distribution with that centre (d,) and deviation (d,).

        Against the mixture of all distributions that were drawn from (the balance heuristic of Veach and Guibas, "Optimally Combining
        Sampling Techniques for Monte Carlo Rendering", SIGGRAPH 1995), so that no weight exceeds the number of batches.
        """
        places = np.unique(np.hstack([self.centres, self.deviations]), axis=0, return_counts=True)
        d = len(centre)
        mixture = [_log_density(self.offsets, row[:d], row[d:]) + math.log(count) for row, count in zip(*places, strict=True)]
        return np.exp(_log_density(self.offsets, centre, deviation) - np.logaddexp.reduce(mixture, axis=0)) * len(self.success)


def _log_density(x: np.ndarray, centre: np.ndarray, deviation: np.ndarray) -> np.ndarray:
    """(M,) of a normal distribution, but for a constant."""
    return -0.5 * (((x - centre) / deviation) ** 2).sum(axis=1) - np.log(deviation).sum()


def natural_step(
    trials: Trials, centre: np.ndarray, deviation: np.ndarray, prior: float, measured: float = 0.0, count: int = 0
) -> tuple[np.ndarray, np.ndarray]:
    """Natural gradient of the logarithm of expected success, for a normal distribution with independent entries.

    With z = (offset - centre) / deviation, y the success less its mean and w the importance weights of the trials: per entry, in units of
    the deviation, sum(w y z) / (sum(w success) + prior) for the centre, and half of sum(w y (z^2 - 1)) / (sum(w success) + prior) for the
    logarithm of the deviation. Trials of earlier distributions are used again (importance mixing: Sun et al., "Efficient Natural Evolution
    Strategies", GECCO 2009); mirrored samples of one distribution sum to 0, so that without a prior the centre goes to the mean of those
    that succeeded. What was ``measured`` at the centre counts as ``count`` trials with z = 0: where the centre succeeds more often than
    what is drawn around it, the step is short and the deviation narrows, also when nothing drawn succeeds.

    Args:
        trials: of one robot.
        centre, deviation: (d,) of the distribution.
        prior: successes at the centre that are counted besides those seen.
        measured: success rate of the centre itself.
        count: trials that it stands for.

    Returns:
        (d,) for the centre, (d,) for the logarithm of the deviation; zeros without any success.
    """
    weights = trials.weights(centre, deviation)
    total = weights @ trials.success + measured * count
    if total == 0:
        return np.zeros_like(centre), np.zeros_like(centre)
    z = (trials.offsets - centre) / deviation
    rate = total / (weights.sum() + count)
    above = weights * (trials.success - rate)
    return above @ z / (total + prior), 0.5 * (above @ (z * z - 1.0) - count * (measured - rate)) / (total + prior)

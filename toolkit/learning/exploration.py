"""Exploration in a few of the policy's own parameters, held for an episode.

White noise on the actions, twenty times a second, hardly moves a grasp: the policy's own feedback takes it back. Three things do,
when they are the same for a whole episode, and all are parameters of the policy already:

    offsets     of a few entries of the observation, the shift of its normalisation: where the object is believed to be
    gains       of a few entries, its scale or its last layer's: how far off the object is believed to be, how fast the hand goes
    responses   of a few actions to the leading features of the states it meets, its last layer: what it does while its fingers close

So the policy plays as it is, without noise on its actions, once per step drawn from a normal distribution in these directions, and the
distribution follows the steps that succeed.

Sources: policy gradients in parameter space and pairs of mirrored samples are Sehnke et al., "Parameter-exploring Policy
Gradients", Neural Networks 23, 2010; the natural gradient of a search distribution, also of its deviations, is Wierstra et
al., "Natural Evolution Strategies", JMLR 15, 2014 (its separable form: Schaul, Glasmachers and Schmidhuber, "High Dimensions
and Heavy Tails for Natural Evolution Strategies", GECCO 2011). Noise that is a linear function of the last layer's features,
held for a while, is Raffin, Kober and Stulp, "Smooth Exploration for Robotic Reinforcement Learning", CoRL 2021; here it is drawn
along the leading eigenvectors of the features' second moments, which are those of the last layer's Fisher matrix.
"""

import math
from dataclasses import dataclass
from typing import Literal

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
    """Successes that count for the policy as it is: a single one moves it half of the way."""
    features: int = 4
    """Leading features that the actions respond to in the search's second turn, if that makes no more than ``responses``."""
    responses: int = 32
    """Most responses, of all actions to all features: a hand of 28 servos responds to the leading feature alone, which hardly varies."""
    reuse: int = 144
    """Trials on one robot, the last ones, that an update learns from, earlier batches by their importance."""
    deviation_rate: float = 0.5
    """How fast deviations follow: factor on the natural gradient of their logarithm (Wierstra et al.: (3 + log d) / (5 sqrt d),
    0.47 in three dimensions)."""
    polish: float = 0.3
    """Deviation with which the search begins where the policy holds already and is to hold more often, of the one the task declares."""
    regain: float = 1.5
    """Factor on the deviation to which a phase came, once its robot is reached; never more than the task declares."""
    narrowest: float = 1 / 8
    """Least deviation, of the one the task declares."""
    widest: float = 2.0
    """Greatest deviation, of the one the task declares."""

    def __post_init__(self) -> None:
        if self.batch_size < 4 or self.batch_size % 2:
            raise ToolkitError(f"SearchConfig.batch_size is {self.batch_size}; give an even number from 4 on: episodes come in pairs")
        for name, valid, mend in (
            ("prior", self.prior >= 0, "0 or more"),
            ("features", self.features >= 1, "1 or more"),
            ("responses", self.responses >= 1, "1 or more"),
            ("reuse", self.reuse >= self.batch_size, f"at least a batch, {self.batch_size}"),
            ("deviation_rate", 0 <= self.deviation_rate <= 1, "a number in [0, 1]"),
            ("narrowest", 0 < self.narrowest <= 1, "a number in (0, 1]"),
            ("polish", 0 < self.polish <= 1, "a number in (0, 1]"),
            ("regain", 1 <= self.regain < math.inf, "a number from 1 on"),
            ("widest", 1 <= self.widest < math.inf, "a number from 1 on"),
        ):
            if not valid:
                raise ToolkitError(f"SearchConfig.{name} is {getattr(self, name)}; give {mend}")

    def features_of(self, actions: int) -> int:
        """How many features so many actions respond to; one at least."""
        return max(1, min(self.features, self.responses // actions))


def mirrored(pairs: int, dimensions: int, rng: np.random.Generator) -> np.ndarray:
    """(2 pairs, dimensions) standard normal samples; each is followed by its mirror image, so that their mean is 0."""
    half = rng.standard_normal((pairs, dimensions))
    return np.stack([half, -half], axis=1).reshape(2 * pairs, dimensions)


@dataclass(frozen=True)
class Gain:
    """One number that says how large an entry of a record is seen, or done.

    Attributes:
        record: of which the entry is.
        entry: its numbers, which share the gain.
        deviation: standard deviation of the gain's logarithm with which a search begins, positive.
    """

    record: Literal["observation", "action"]
    entry: slice
    deviation: float


@dataclass(frozen=True)
class Explored:
    """What a task lets a search explore, as standard deviations with which it begins; 0: nothing.

    Attributes:
        observation: (n_obs,) of the offset of each entry, in its unit.
        action: (n_act,) of the response of each action to a feature of root mean square 1, in its unit.
        gains: of entries.

    Raises:
        ToolkitError: nothing is to be explored, or a deviation is negative.
    """

    observation: np.ndarray
    action: np.ndarray
    gains: tuple[Gain, ...] = ()

    def __post_init__(self) -> None:
        both = np.concatenate([self.observation, self.action])
        if not (self.observation > 0).any() or (both < 0).any():
            raise ToolkitError("the search has no observation to explore, or a negative deviation; declare one in the task, or take "
                               "learner 'npg'")


@dataclass(frozen=True, eq=False)
class Directions:
    """Directions in which a policy is moved: d = offsets of o entries, then responses of m actions to K features, action by action.

    Attributes:
        explored: how far.
        features: (K, H + 1) weights of the last hidden layer's H units, and a bias, that make a feature; K = 0: offsets alone.
    """

    explored: Explored
    features: np.ndarray

    @property
    def entries(self) -> np.ndarray:
        """(o,) indices of the observations that are offset."""
        return np.flatnonzero(self.explored.observation)

    @property
    def outputs(self) -> np.ndarray:
        """(m,) indices of the actions that respond."""
        return np.flatnonzero(self.explored.action)

    @property
    def deviation(self) -> np.ndarray:
        """(d,) standard deviations as declared."""
        responses = np.repeat(self.explored.action[self.outputs], len(self.features))
        return np.concatenate([self.explored.observation[self.entries], responses])

    def moved(self, policy: GaussianPolicy, step: np.ndarray) -> GaussianPolicy:
        """A copy of the policy, moved by ``step`` (d,): it sees every entry less its offset, and its actions respond by so much more."""
        twin, layers, n = policy.copy(), policy.layers(), len(self.entries)
        shift, (W, b) = layers.shift.copy(), (array.copy() for array in layers.weights[-1])
        shift[self.entries] += step[:n]
        response = step[n:].reshape(len(self.outputs), len(self.features)) @ self.features
        W[self.outputs] += response[:, :-1]
        b[self.outputs] += response[:, -1]
        twin.set_normalisation(shift, layers.scale.copy())
        twin.set_last_layer(W, b)
        return twin


@dataclass(frozen=True, eq=False)
class Gains:
    """Directions in which a policy is moved: d = logarithms of gains, about the zero of what is seen or done.

    Attributes:
        gains: of entries.
    """

    gains: tuple[Gain, ...]

    @property
    def deviation(self) -> np.ndarray:
        """(d,) standard deviations as declared."""
        return np.array([gain.deviation for gain in self.gains])

    def moved(self, policy: GaussianPolicy, step: np.ndarray) -> GaussianPolicy:
        """A copy of the policy that sees, or does, every entry exp(step (d,)) times as large."""
        twin, layers = policy.copy(), policy.layers()
        shift, scale = layers.shift.copy(), layers.scale.copy()
        W, b = (array.copy() for array in layers.weights[-1])
        for gain, factor in zip(self.gains, np.exp(step), strict=True):
            if gain.record == "observation":
                shift[gain.entry] /= factor
                scale[gain.entry] /= factor
            else:
                W[gain.entry] *= factor
                b[gain.entry] *= factor
        twin.set_normalisation(shift, scale)
        twin.set_last_layer(W, b)
        return twin


def leading_features(policy: GaussianPolicy, observations: np.ndarray, count: int) -> np.ndarray:
    """(count, H + 1) features, each of root mean square 1 over the observations (N, n_obs), that are uncorrelated there (about 0).

    The eigenvectors of the second moments of the last hidden layer and a constant 1, the greatest first, by the root of their eigenvalue:
    a normal step in them changes the action by as much in every direction, and most where the states that the policy meets differ most.
    """
    hidden = policy.hidden_layer(observations)
    units = np.column_stack([hidden, np.ones(len(hidden))])
    moments, vectors = np.linalg.eigh(units.T @ units / len(units))
    leading = slice(None, -count - 1, -1)
    return (vectors[:, leading] / np.sqrt(moments[leading])).T


@dataclass
class Trials:
    """Steps that were played on one robot: where each was drawn, and how it ended. M trials, d directions.

    Attributes:
        offsets: (M, d) from where the turn began, each in its direction's unit.
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

    With z = (step - centre) / deviation, y the success less its mean and w the importance weights of the trials: per entry, in units of
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

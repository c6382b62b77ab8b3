"""Behaviour cloning: a policy's mean fitted to demonstrated actions."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch

from toolkit.errors import ToolkitError
from toolkit.learning.policy import GaussianPolicy, single_thread


@dataclass(frozen=True)
class CloningConfig:
    """Hyperparameters of behaviour cloning.

    Raises:
        ToolkitError: a value that is not positive.
    """

    epochs: int = 100
    """Passes over the demonstrations."""
    minibatch: int = 64
    """Steps per Adam update."""
    learning_rate: float = 2e-3
    """Adam's learning rate at the start; it falls linearly to 0, so that the last epochs only polish."""
    init_log_std: float = -1.5
    """Log standard deviation that the policy leaves with, for every action entry, in log action units."""

    def __post_init__(self) -> None:
        for name in ("epochs", "minibatch", "learning_rate"):
            if not getattr(self, name) > 0:
                raise ToolkitError(f"CloningConfig.{name} is {getattr(self, name)}; give a positive number.")


def clone(
    policy: GaussianPolicy,
    observations: np.ndarray,
    actions: np.ndarray,
    config: CloningConfig,
    rng: np.random.Generator,
    progress: Callable[[int, float], None] | None = None,
    scale_floor: np.ndarray | float = 0.01,
) -> list[float]:
    """Fit the policy in place to demonstrations: Adam on the mean squared error of its mean. Same input, same bits.

    The observation normalisation becomes the data's mean and standard deviation, the latter never below
    `scale_floor`: an entry that is constant in the demonstrations must not blow up the day it moves.

    Args:
        policy: mutated: weights, normalisation and log standard deviation.
        observations: (N, n_obs).
        actions: (N, n_act), in action units.
        config: hyperparameters.
        rng: order of the minibatches.
        progress: called after each epoch with its number, from 1, and its loss.
        scale_floor: (n_obs,) or one number, in the unit of each entry; the default is a centimetre, or 0.6 degrees.

    Returns:
        Mean squared error of each epoch, in squared action units, averaged over its minibatches as they were met.

    Raises:
        ToolkitError: shapes that do not fit the policy, no rows, numbers that are not finite, a floor not positive.
    """
    observations, actions = _checked(policy, observations, actions)
    policy.set_normalisation(observations.mean(axis=0), np.maximum(observations.std(axis=0), scale_floor))
    x, y = torch.from_numpy(observations), torch.from_numpy(actions)
    parameters = torch.tensor(policy.parameters, requires_grad=True)
    losses: list[float] = []
    with single_thread():
        adam = torch.optim.Adam([parameters], lr=config.learning_rate)
        decay = torch.optim.lr_scheduler.LinearLR(adam, 1.0, 0.0, total_iters=config.epochs)
        for epoch in range(1, config.epochs + 1):
            total = 0.0
            for rows in torch.from_numpy(rng.permutation(len(x))).split(config.minibatch):
                loss = (policy.torch_mean(x[rows], parameters) - y[rows]).square().mean()
                parameters.grad = torch.autograd.grad(loss, parameters)[0]
                adam.step()
                total += float(loss.detach()) * len(rows)
            decay.step()
            losses.append(total / len(x))
            if progress is not None:
                progress(epoch, losses[-1])
    policy.set_parameters(parameters.detach().numpy())
    policy.set_log_std(np.full(len(policy.action_names), config.init_log_std))
    return losses


def _checked(policy: GaussianPolicy, observations: np.ndarray, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    # Copies in C order: torch shares them, and a caller's array may be read-only.
    observations = np.array(observations, dtype=np.float64, order="C")
    actions = np.array(actions, dtype=np.float64, order="C")
    n = len(observations)
    for what, array, names in (
        ("observations", observations, policy.observation_names),
        ("actions", actions, policy.action_names),
    ):
        if n == 0 or array.shape != (n, len(names)):
            raise ToolkitError(f"demonstrated {what} have shape {array.shape}; give ({max(n, 1)}, {len(names)}).")
        if not np.isfinite(array).all():
            row = int(np.flatnonzero(~np.isfinite(array).all(axis=1))[0])
            raise ToolkitError(f"demonstrated {what} are not finite in row {row}; leave that episode out.")
    return observations, actions

"""Natural policy gradient, one scroll: advantages, gradient, Fisher products, conjugate gradients, step, value fit.

Sources: the natural gradient is Kakade, "A Natural Policy Gradient", NIPS 2001; the normalised step and the conjugate
gradients are Rajeswaran et al., "Towards Generalization and Simplicity in Continuous Control", NIPS 2017, equation 7;
the advantages are Schulman et al., "High-Dimensional Continuous Control Using Generalized Advantage Estimation",
ICLR 2016, equation 16; the demonstrations' term is Rajeswaran et al., "Learning Complex Dexterous Manipulation with Deep
Reinforcement Learning and Demonstrations" (DAPG), RSS 2018, equation 4. Defaults come from the hyperparameter table of the
Meta-Evolve paper where it has one.
"""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.signal
import torch

from toolkit.errors import ToolkitError
from toolkit.learning.episode import Episode
from toolkit.learning.policy import GaussianPolicy, ValueFunction, single_thread

RETURN_SCALE_FLOOR = 1e-3
"""Returns that vary by less, in units of reward, are not told apart: a batch of failures must not magnify noise."""


@dataclass(frozen=True)
class NpgConfig:
    """Hyperparameters of one natural-gradient update; "paper" marks the values of Meta-Evolve's table.

    Raises:
        ToolkitError: a value outside its range.
    """

    gamma: float = 0.995
    """Discount factor per control step (paper)."""
    gae_lambda: float = 0.97
    """Trust in rewards over the value function: 1 sums rewards, 0 looks one step ahead (paper)."""
    step_size: float = 1e-4
    """Squared length of the step in the Fisher metric; the policy moves by a KL of about half of it (paper)."""
    batch_size: int = 12
    """Episodes that the caller collects for one update (paper)."""
    cg_iterations: int = 10
    """Most conjugate-gradient iterations; each costs one Fisher-vector product."""
    cg_damping: float = 1e-4
    """Added to the Fisher matrix's diagonal, so that directions without data stay finite."""
    min_log_std: float | None = None
    """Floor of every log standard deviation, so that exploration cannot die; None: no floor."""
    demonstration_weight: float = 0.1
    """lambda_0: how much a demonstrated action counts against the best sampled one, where demonstrations are given (DAPG)."""
    demonstration_decay: float = 0.95
    """lambda_1: by how much that weight falls with every update (DAPG)."""
    value_epochs: int = 5
    """Passes over the batch when the value function is fitted."""
    value_minibatch: int = 64
    """Steps per Adam update of the value function."""
    value_learning_rate: float = 1e-3
    """Adam's learning rate for the value function, in standard units of the return."""

    def __post_init__(self) -> None:
        positive = ("step_size", "batch_size", "cg_iterations", "value_minibatch", "value_learning_rate")
        for name, valid, mend in (
            *((name, getattr(self, name) > 0, "a positive number") for name in positive),
            *((name, 0.0 <= getattr(self, name) <= 1.0, "a number in [0, 1]") for name in ("gamma", "gae_lambda", "demonstration_decay")),
            *((name, getattr(self, name) >= 0, "0 or more") for name in ("cg_damping", "value_epochs", "demonstration_weight")),
        ):
            if not valid:
                raise ToolkitError(f"NpgConfig.{name} is {getattr(self, name)}; give {mend}.")


@dataclass(frozen=True, eq=False)
class Demonstrations:
    """What somebody else did, for the demonstrations' term of `npg_step`.

    Attributes:
        observations: (M, n_obs).
        actions: (M, n_act).
        update: how many updates went before this one; the weight falls with it.
    """

    observations: np.ndarray
    actions: np.ndarray
    update: int = 0


def npg_step(
    policy: GaussianPolicy,
    value: ValueFunction,
    episodes: Sequence[Episode],
    config: NpgConfig,
    rng: np.random.Generator,
    demonstrations: Demonstrations | None = None,
) -> dict[str, Any]:
    """Improve policy and value in place by one update from on-policy episodes. Same input, same bits.

    Diverged episodes count as failures: their rewards are 0 from start to end (task rewards are taken to be 0 or
    more), and nothing is bootstrapped from where they blew up.

    Without signal (every reward of the batch is 0, or all advantages are equal) the policy keeps its parameters bit
    for bit, since all it could follow is the value function's own error; the value function is still fitted. With
    demonstrations it then follows these alone.

    Args:
        policy: the policy that played the episodes; mutated.
        value: the baseline; mutated. Fit it on the same observation names.
        episodes: at least one; N steps in all.
        config: hyperparameters.
        rng: order of the value function's minibatches.
        demonstrations: adds DAPG's term to the gradient: sum of grad log pi(a | s) over the demonstrations, weighted by
            lambda_0 lambda_1^update and the largest advantage of the batch.

    Returns:
        Statistics, all plain Python numbers:
            no_signal: True if the rewards gave no direction; without demonstrations kl, step_length and gradient_norm are 0.
            demonstration_weight: of one demonstrated action against one sampled, 0 without demonstrations.
            kl: measured mean KL(old || new) over the batch [nats]; about config.step_size / 2.
            surrogate_before: mean likelihood ratio times normalised advantage under the old policy; 0 by construction.
            surrogate_after: the same under the new policy; above 0 if the batch would now be played better.
            gradient_norm: Euclidean norm of the surrogate's gradient.
            step_length: Euclidean length of the parameter change.
            cg_residual: |F x - g| / |g| where conjugate gradients stopped.
            entropy: of the new policy [nats].
            explained_variance: share of the returns' variance that the value function predicted *before* this fit;
                1 is perfect, below 0 is worse than a constant; 0 where returns do not vary.
            value_loss: mean squared error after the fit, in standard units of the return.
            mean_reward: mean undiscounted reward per episode, diverged ones as 0.
            success_rate: share of episodes that succeeded, in [0, 1].
            diverged: number of diverged episodes.
            steps: number of usable steps, N.
            seconds: wall time of this call [s].

    Raises:
        ToolkitError: no episodes, sizes that differ from the policy's, or an update that is not finite.
    """
    start = time.perf_counter()
    _check_episodes(policy, value, episodes)
    with single_thread():
        batch = [_usable(episode) for episode in episodes]
        observations = torch.from_numpy(np.concatenate([episode.observations for episode in batch]))  # (N, n_obs)
        actions = torch.from_numpy(np.concatenate([episode.actions for episode in batch]))  # (N, n_act)
        advantages, returns, predicted = _advantages(value, batch, config)  # (N,) each
        pull = _pull(policy, demonstrations, config)
        statistics = _improve(policy, observations, actions, advantages, config, _has_signal(batch, advantages), pull)
        statistics["value_loss"] = fit_value(value, observations, torch.from_numpy(returns), config, rng)
    return statistics | {
        "entropy": policy.entropy(),
        "explained_variance": _explained_variance(returns, predicted),
        "mean_reward": float(np.mean([episode.total_reward for episode in episodes])),
        "success_rate": float(np.mean([episode.success for episode in episodes])),
        "diverged": sum(episode.diverged for episode in episodes),
        "steps": len(returns),
        "seconds": time.perf_counter() - start,
    }


# -- 1. What was it worth? -----------------------------------------------------------------------------------


def gae(
    rewards: np.ndarray, values: np.ndarray, last_value: float, gamma: float, gae_lambda: float
) -> np.ndarray:
    """Generalised advantage estimates of one episode (Schulman et al. 2016, equation 16).

        delta_t = r_t + gamma V(s_{t+1}) - V(s_t)
        A_t     = sum_k (gamma lambda)^k delta_{t+k}

    Args:
        rewards: (T,) in units of reward.
        values: (T,) V(s_t), in units of reward.
        last_value: V(s_T): 0 if s_T is terminal, the value function's answer if the horizon cut the episode there.
        gamma: discount factor.
        gae_lambda: lambda.

    Returns:
        (T,) advantages, in units of reward; add `values` for the lambda-return.
    """
    deltas = rewards + gamma * np.append(values[1:], last_value) - values
    # A_t = delta_t + gamma lambda A_{t+1} is a first-order filter that runs backwards in time.
    return scipy.signal.lfilter([1.0], [1.0, -gamma * gae_lambda], deltas[::-1])[::-1]


def _advantages(
    value: ValueFunction, batch: Sequence[Episode], config: NpgConfig
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Raw advantages, lambda-returns and predicted values of every step of the batch, (N,) each."""
    advantages, predicted = [], []
    for episode in batch:
        # One call per episode, its end included: V(s_0) ... V(s_T).
        values = _values(value, np.vstack([episode.observations, episode.last_observation]))
        last_value = 0.0 if episode.terminated else float(values[-1])
        advantages.append(gae(episode.rewards, values[:-1], last_value, config.gamma, config.gae_lambda))
        predicted.append(values[:-1])
    advantage, value_before = np.concatenate(advantages), np.concatenate(predicted)
    return advantage, advantage + value_before, value_before


def _values(value: ValueFunction, observations: np.ndarray) -> np.ndarray:
    # `value.predict` by the torch route: numpy's BLAS may use all cores, and its last bits their number.
    with torch.no_grad():
        standard = value.torch_standard(torch.from_numpy(observations), torch.from_numpy(value.parameters))
    return standard.numpy() * value.return_scale + value.return_shift


def _usable(episode: Episode) -> Episode:
    """The episode itself, or what is left of a diverged one: finite steps, reward 0, a terminal end."""
    if not episode.diverged:
        return episode
    finite = np.isfinite(episode.observations).all(axis=1) & np.isfinite(episode.actions).all(axis=1)
    steps = len(finite) if finite.all() else int(np.argmin(finite))
    return Episode(
        observations=episode.observations[:steps],
        actions=episode.actions[:steps],
        rewards=np.zeros(steps),
        success=False,
        diverged=False,
        terminated=True,
        last_observation=np.zeros_like(episode.observations[0]),  # never looked at: the end is terminal
        alpha=episode.alpha,
        seed=episode.seed,
    )


def _has_signal(batch: Sequence[Episode], advantages: np.ndarray) -> bool:
    rewarded = any(episode.rewards.any() for episode in batch)
    # Relative to their size: rounding alone must not pass for signal once it is divided by the deviation.
    return rewarded and advantages.std() > 1e-9 * (np.abs(advantages).max() + 1e-300)


def _explained_variance(returns: np.ndarray, predicted: np.ndarray) -> float:
    variance = returns.var()
    return float(1.0 - (returns - predicted).var() / variance) if variance > 0.0 else 0.0


# -- 2. Which way is up? -------------------------------------------------------------------------------------


def _improve(
    policy: GaussianPolicy,
    observations: torch.Tensor,
    actions: torch.Tensor,
    advantages: np.ndarray,
    config: NpgConfig,
    has_signal: bool,
    pull: tuple[np.ndarray, float] | None,
) -> dict[str, Any]:
    """Move the policy one normalised natural-gradient step up the surrogate and towards demonstrations, or not at all."""
    keys = ("kl", "surrogate_before", "surrogate_after", "gradient_norm", "step_length", "cg_residual")
    if not has_signal and pull is None:
        return {"no_signal": True, "demonstration_weight": 0.0} | dict.fromkeys(keys, 0.0)
    if has_signal:
        weights = torch.from_numpy((advantages - advantages.mean()) / advantages.std())
    else:
        weights = torch.zeros(len(advantages), dtype=torch.float64)
    old = torch.tensor(policy.parameters, requires_grad=True)
    old_log_prob = policy.log_prob(observations, actions, old)

    def surrogate(parameters: torch.Tensor) -> float:
        ratio = torch.exp(policy.log_prob(observations, actions, parameters) - old_log_prob)
        return float((ratio * weights).mean().detach())

    # The ratio is 1 at the old policy, so the surrogate's gradient there is that of weighted log likelihood.
    gradient = torch.autograd.grad((old_log_prob * weights).mean(), old, retain_graph=True)[0].numpy()
    weight = 0.0
    if pull is not None:
        total, share = pull
        # Both sums are divided by the number of sampled steps; normalised advantages are at most `best`.
        best = float(weights.max()) if has_signal else 1.0
        weight = share * best
        gradient = gradient + weight / len(observations) * total
    fisher = fisher_vector_product(policy, observations, old, config.cg_damping)
    direction = conjugate_gradients(fisher, gradient, config.cg_iterations)
    change = _normalised_step(gradient, direction, config.step_size)
    new = torch.from_numpy(_floor_log_std(policy, old.detach().numpy() + change, config.min_log_std))
    numbers = (
        mean_kl(policy, observations, old.detach(), new),
        surrogate(old),
        surrogate(new),
        float(np.linalg.norm(gradient)),
        float(np.linalg.norm(new.numpy() - old.detach().numpy())),
        float(np.linalg.norm(fisher(direction) - gradient) / np.linalg.norm(gradient)),
    )
    if not np.isfinite(numbers).all():
        raise ToolkitError(
            f"npg_step made an update that is not finite ({dict(zip(keys, numbers, strict=True))}); "
            "look for huge rewards or observations in the batch; the policy was left alone."
        )
    policy.set_parameters(new.numpy())
    return {"no_signal": not has_signal, "demonstration_weight": weight} | dict(zip(keys, numbers, strict=True))


def _pull(policy: GaussianPolicy, demonstrations: Demonstrations | None, config: NpgConfig) -> tuple[np.ndarray, float] | None:
    """Gradient (P,) of the demonstrations' summed log likelihood and lambda_0 lambda_1^update; None where that is 0."""
    if demonstrations is None or not len(demonstrations.observations):
        return None
    share = config.demonstration_weight * config.demonstration_decay**demonstrations.update
    if share == 0.0:
        return None
    parameters = torch.tensor(policy.parameters, requires_grad=True)
    observations, actions = (torch.from_numpy(np.array(a, np.float64)) for a in (demonstrations.observations, demonstrations.actions))
    likelihood = policy.log_prob(observations, actions, parameters).sum()
    return torch.autograd.grad(likelihood, parameters)[0].numpy(), share


def fisher_vector_product(
    policy: GaussianPolicy, observations: torch.Tensor, parameters: torch.Tensor, damping: float
) -> Callable[[np.ndarray], np.ndarray]:
    """The product `v -> (F + damping I) v` with the Fisher matrix of the policy, averaged over observations.

    For a Gaussian whose deviation does not depend on the observation,
        F = E[J^T diag(exp(-2 log_std)) J]  over the network's weights (J: Jacobian of the mean), and
        F = 2 I                             over log_std, with nothing between the two.

    Args:
        policy: gives the shape of the network.
        observations: (N, n_obs).
        parameters: (P,) where F is taken; requires grad.
        damping: added to the diagonal.

    Returns:
        A function (P,) -> (P,). It keeps the graph of one forward pass, so each product costs backward passes only.
    """
    mean = policy.torch_mean(observations, parameters)  # (N, n_act)
    log_std = policy.torch_log_std(parameters.detach())  # (n_act,)
    per_step = torch.exp(-2.0 * log_std) / len(observations)
    # J^T u is linear in u, so its derivative along u is J again: forward mode out of two backward passes.
    dummy = torch.zeros_like(mean, requires_grad=True)
    transposed = torch.autograd.grad(mean, parameters, dummy, create_graph=True)[0]  # (P,) J^T dummy

    def product(vector: np.ndarray) -> np.ndarray:
        v = torch.from_numpy(np.ascontiguousarray(vector))
        jacobian_v = torch.autograd.grad(transposed, dummy, v, retain_graph=True)[0]  # (N, n_act) J v
        result = torch.autograd.grad(mean, parameters, jacobian_v * per_step, retain_graph=True)[0].numpy()
        result[len(result) - len(log_std) :] = 2.0 * vector[len(result) - len(log_std) :]
        return result + damping * vector

    return product


def conjugate_gradients(
    product: Callable[[np.ndarray], np.ndarray], target: np.ndarray, iterations: int, tolerance: float = 1e-10
) -> np.ndarray:
    """Solve `A x = target` for a symmetric positive definite A known by its products (Hestenes & Stiefel 1952).

    Args:
        product: x -> A x, (P,) -> (P,).
        target: (P,).
        iterations: at most this many products.
        tolerance: stop once |A x - target| is this small against |target|.

    Returns:
        (P,) x. Wherever it stops, x^T A x = x^T target, so a step length derived from either is the same.
    """
    x = np.zeros_like(target)
    residual = target.copy()
    search = residual.copy()
    square = residual @ residual
    goal = tolerance**2 * square
    for _ in range(iterations):
        if square <= goal:
            break
        image = product(search)
        length = square / (search @ image)
        x += length * search
        residual -= length * image
        square, previous = residual @ residual, square
        search = residual + (square / previous) * search
    return x


# -- 3. How far? ---------------------------------------------------------------------------------------------


def _normalised_step(gradient: np.ndarray, direction: np.ndarray, step_size: float) -> np.ndarray:
    """sqrt(step_size / g^T F^-1 g) F^-1 g: squared Fisher length step_size, so KL about step_size / 2."""
    return np.sqrt(step_size / (gradient @ direction)) * direction


def _floor_log_std(policy: GaussianPolicy, parameters: np.ndarray, min_log_std: float | None) -> np.ndarray:
    if min_log_std is not None:
        log_std = parameters[len(parameters) - len(policy.action_names) :]
        np.maximum(log_std, min_log_std, out=log_std)
    return parameters


def mean_kl(policy: GaussianPolicy, observations: torch.Tensor, old: torch.Tensor, new: torch.Tensor) -> float:
    """KL(old || new) in nats between the policies of two (P,) parameter vectors, averaged over (N, n_obs)."""
    with torch.no_grad():
        old_log_std, new_log_std = policy.torch_log_std(old), policy.torch_log_std(new)
        shift = policy.torch_mean(observations, old) - policy.torch_mean(observations, new)
        spread = torch.exp(2.0 * old_log_std) + shift * shift
        kl = new_log_std - old_log_std + 0.5 * spread * torch.exp(-2.0 * new_log_std) - 0.5
        return float(kl.sum(dim=1).mean())


# -- 4. What will it be worth? -------------------------------------------------------------------------------


def fit_value(
    value: ValueFunction,
    observations: torch.Tensor,
    returns: torch.Tensor,
    config: NpgConfig,
    rng: np.random.Generator,
) -> float:
    """Fit the value function in place to (N,) returns at (N, n_obs) observations, from the weights it has.

    Adam starts afresh in every call: a run that is resumed from the saved weights then goes on bit for bit.

    Returns:
        Mean squared error after the fit, in standard units of the return.
    """
    value.set_return_scale(float(returns.mean()), max(float(returns.std(correction=0)), RETURN_SCALE_FLOOR))
    targets = (returns - value.return_shift) / value.return_scale
    parameters = torch.tensor(value.parameters, requires_grad=True)
    adam = torch.optim.Adam([parameters], lr=config.value_learning_rate)
    for _ in range(config.value_epochs):
        for rows in torch.from_numpy(rng.permutation(len(targets))).split(config.value_minibatch):
            loss = (value.torch_standard(observations[rows], parameters) - targets[rows]).square().mean()
            parameters.grad = torch.autograd.grad(loss, parameters)[0]
            adam.step()
    value.set_parameters(parameters.detach().numpy())
    with torch.no_grad():
        return float((value.torch_standard(observations, parameters) - targets).square().mean())


def _check_episodes(policy: GaussianPolicy, value: ValueFunction, episodes: Sequence[Episode]) -> None:
    if not episodes:
        raise ToolkitError("npg_step got 0 episodes; collect at least one.")
    if value.observation_names != policy.observation_names:
        raise ToolkitError(
            f"the value function sees {len(value.observation_names)} entries that are not the policy's "
            f"{len(policy.observation_names)}; build both from the same observation names."
        )
    expected = (len(policy.observation_names), len(policy.action_names))
    for episode in episodes:
        found = (episode.observations.shape[1], episode.actions.shape[1])
        if found != expected:
            raise ToolkitError(
                f"episode with seed {episode.seed} has {found} observation and action entries, the policy "
                f"{expected}; play it with this policy."
            )
        if episode.diverged and not np.isfinite(episode.observations[0]).all():
            raise ToolkitError(f"episode with seed {episode.seed} starts from NaN; check the robot's reset.")

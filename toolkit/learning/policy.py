"""The policy and its baseline: two small networks that act in numpy and train in torch.

Both hold every trainable number in one flat float64 vector. `layers()` are views into it, so a compiled rollout
reads the weights in place, and the natural gradient is a vector of the same length. Whatever else they need (names,
observation shift and scale) travels with them into one safetensors file.
"""

import contextlib
import json
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple, Self

import numpy as np
import safetensors.numpy
import torch

from tasks.sight import Sight
from toolkit.errors import ToolkitError
from toolkit.io.atomic import write_atomically
from toolkit.io.tensors import read_tensors

OBSERVATION_CLIP = 10.0
"""Normalised observations are cut to +-10: no entry can drown the others when a robot leaves the known range."""

OUTPUT_GAIN = 0.01
"""Initial last layers are this much smaller than the rest: a new policy holds still, a new baseline says 0."""

_LOG_2_PI = math.log(2.0 * math.pi)


class Layers(NamedTuple):
    """A network as plain arrays: `x = clip((obs - shift) / scale, +-OBSERVATION_CLIP)`, then `x = W x + b` per layer,
    with tanh after each but the last. Live views, C-contiguous float64: read them, do not write."""

    weights: tuple[tuple[np.ndarray, np.ndarray], ...]
    """((n_out, n_in) W, (n_out,) b) of each layer, input first."""
    shift: np.ndarray
    """(n_obs,) in the unit of each observation entry."""
    scale: np.ndarray
    """(n_obs,) in the unit of each observation entry, positive."""
    log_std: np.ndarray
    """(n_act,) log standard deviation of the action; empty for a value function."""


@contextlib.contextmanager
def single_thread() -> Iterator[None]:
    """Run torch on one thread: for networks this small it is faster, and the result cannot depend on the core count."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


class _Network:
    """A tanh network over named, normalised observations; subclasses say what its outputs mean."""

    kind: str
    """Written into files, so that a policy is never loaded as a value function."""

    def __init__(
        self,
        observation_names: Sequence[str],
        n_out: int,
        n_log_std: int,
        hidden: Sequence[int],
        rng: np.random.Generator,
    ) -> None:
        self.observation_names = _distinct(observation_names, "observation")
        self.hidden = tuple(int(size) for size in hidden)
        n_obs = len(self.observation_names)
        self._sizes = (n_obs, *self.hidden, n_out)
        n_weights = sum((n_in + 1) * n for n_in, n in pairwise(self._sizes))
        self._parameters = np.zeros(n_weights + n_log_std)
        self._weights = _unflatten(self._parameters, self._sizes)
        self._log_std = self._parameters[n_weights:]
        self._shift, self._scale = np.zeros(n_obs), np.ones(n_obs)
        # Arrays rather than scalars: numpy's ufuncs are three times faster on them for a single observation.
        self._low, self._high = np.full(n_obs, -OBSERVATION_CLIP), np.full(n_obs, OBSERVATION_CLIP)
        for W, _ in self._weights:
            # LeCun et al. 1998: variance 1 / fan-in keeps tanh units out of saturation.
            W[...] = rng.standard_normal(W.shape) / math.sqrt(W.shape[1])
        self._weights[-1][0][...] *= OUTPUT_GAIN

    # -- parameters ------------------------------------------------------------------------------------------

    @property
    def parameters(self) -> np.ndarray:
        """(P,) float64 copy of everything that is trained: W and b of each layer, then log_std if there is one."""
        return self._parameters.copy()

    def set_parameters(self, parameters: np.ndarray) -> None:
        """Overwrite all (P,) trained numbers, in the order of `parameters`; earlier `layers()` follow.

        Raises:
            ToolkitError: wrong shape, or a number that is not finite.
        """
        self._overwrite(self._parameters, parameters, "parameters")

    def set_normalisation(self, shift: np.ndarray, scale: np.ndarray) -> None:
        """Set the (n_obs,) shift and positive (n_obs,) scale, both in the unit of each observation entry.

        Raises:
            ToolkitError: wrong shape, a number that is not finite, or a scale that is not positive.
        """
        for name, low in zip(self.observation_names, np.ravel(scale), strict=False):  # its shape is checked below
            if not low > 0.0:
                raise ToolkitError(f"scale of observation {name!r} is {low}; give a positive number.")
        self._overwrite(self._shift, shift, "shift")
        self._overwrite(self._scale, scale, "scale")

    def through(self, sight: Sight) -> Self:
        """A copy that does, on an observation, what this one does on ``sight`` of it: W D^-1 A D is its first layer, with D the scale.

        The same up to what OBSERVATION_CLIP cuts, which is cut of what is there instead of what is seen.
        """
        twin, (W, _) = self.copy(), self._weights[0]
        twin.set_normalisation(np.linalg.solve(sight.matrix, self._shift - sight.constant), self._scale)
        twin._overwrite(twin._weights[0][0], W @ (sight.matrix * self._scale / self._scale[:, None]), "first W")
        return twin

    def layers(self) -> Layers:
        """The network as plain arrays, for a compiled rollout."""
        return Layers(self._weights, self._shift, self._scale, self._log_std)

    def set_last_layer(self, W: np.ndarray, b: np.ndarray) -> None:
        """Overwrite the last layer's (n_out, n_in) W and (n_out,) b.

        Raises:
            ToolkitError: wrong shape, or a number that is not finite.
        """
        for target, value, name in zip(self._weights[-1], (W, b), ("last W", "last b"), strict=True):
            self._overwrite(target, value, name)

    def hidden_layer(self, observations: np.ndarray) -> np.ndarray:
        """The last hidden layer's units: (N, n_obs) -> (N, H), each within +-1."""
        x = np.clip((observations - self._shift) / self._scale, -OBSERVATION_CLIP, OBSERVATION_CLIP)
        for W, b in self._weights[:-1]:
            x = np.tanh(x @ W.T + b)
        return x

    def _overwrite(self, target: np.ndarray, value: np.ndarray, name: str) -> None:
        value = np.asarray(value, dtype=np.float64)
        if value.shape != target.shape:
            raise ToolkitError(f"{name} of this {self.kind} has shape {value.shape}; give {target.shape}.")
        if not np.isfinite(value).all():
            where = int(np.flatnonzero(~np.isfinite(value))[0])
            raise ToolkitError(f"{name}[{where}] of this {self.kind} is {value.flat[where]}; give finite numbers.")
        target[...] = value

    # -- forward, twice: numpy to act, torch to train --------------------------------------------------------

    def _forward(self, observations: np.ndarray) -> np.ndarray:
        if observations.ndim > 1:
            W, b = self._weights[-1]
            return self.hidden_layer(observations) @ W.T + b
        x = observations - self._shift
        x /= self._scale
        np.maximum(x, self._low, out=x)
        np.minimum(x, self._high, out=x)
        return self._forward_one(x)

    def _forward_one(self, x: np.ndarray) -> np.ndarray:
        # The rollout's inner loop: `dot` and in-place sums halve the time of `@` and `+`.
        *hidden, (W, b) = self._weights
        for W_hidden, b_hidden in hidden:
            x = W_hidden.dot(x)
            x += b_hidden
            np.tanh(x, out=x)
        x = W.dot(x)
        x += b
        return x

    def _torch_forward(self, observations: torch.Tensor, parameters: torch.Tensor) -> torch.Tensor:
        x = (observations - torch.from_numpy(self._shift)) / torch.from_numpy(self._scale)
        x = x.clamp(-OBSERVATION_CLIP, OBSERVATION_CLIP)
        *hidden, (W, b) = _unflatten(parameters, self._sizes)
        for W_hidden, b_hidden in hidden:
            x = torch.tanh(torch.addmm(b_hidden, x, W_hidden.T))
        return torch.addmm(b, x, W.T)

    # -- files and copies ------------------------------------------------------------------------------------

    def _header(self) -> dict[str, Any]:
        return {"kind": self.kind, "observation_names": self.observation_names, "hidden": self.hidden}

    def _arrays(self) -> dict[str, np.ndarray]:
        """Every array that defines this object, by its name in the file; assigned to when loading."""
        arrays = {"observation_shift": self._shift, "observation_scale": self._scale}
        for i, (W, b) in enumerate(self._weights):
            arrays |= {f"layer_{i}.weight": W, f"layer_{i}.bias": b}
        return arrays

    @classmethod
    def _blank(cls, header: dict[str, Any]) -> Self:
        raise NotImplementedError

    def save(self, path: str | Path) -> None:
        """Write one safetensors file: arrays, and names and sizes as JSON in its header.

        The file appears whole or not at all: it is written beside its place and then moved there.

        Raises:
            ToolkitError: the file cannot be written.
        """
        path = Path(path)
        # One metadata key only: safetensors does not promise their order, and equal policies should be equal files.
        metadata = {"meta_evolve": json.dumps(self._header(), sort_keys=True)}
        try:
            write_atomically(path, safetensors.numpy.save(self._arrays(), metadata))
        except OSError as error:
            raise ToolkitError(f"{path} cannot be written ({error.strerror}); choose a writable place.") from error

    @classmethod
    def _load(cls, path: str | Path) -> Self:
        path = Path(path)
        header, arrays = _read_safetensors(path, cls.kind)
        try:
            # Before anything is allocated: a header must not ask for more than the file holds.
            if header["hidden"] != [len(arrays[f"layer_{i}.bias"]) for i in range(len(header["hidden"]))]:
                raise ValueError("hidden sizes differ from the arrays")
            network = cls._blank(header)
        except (KeyError, TypeError, ValueError, AttributeError, OverflowError) as error:
            raise ToolkitError(f"{path} has an incomplete header ({error!r}); save the {cls.kind} again.") from error
        network._fill(arrays, str(path))
        return network

    def _fill(self, arrays: dict[str, np.ndarray], source: str) -> None:
        """Check every array before the first is assigned; `source` names the file in the error."""
        targets = self._arrays()
        if arrays.keys() != targets.keys():
            odd = sorted(arrays.keys() ^ targets.keys())
            raise ToolkitError(f"{source} lacks or adds the arrays {odd}; save the {self.kind} again.")
        for name, target in targets.items():
            if arrays[name].shape != target.shape or arrays[name].dtype != target.dtype:
                raise ToolkitError(
                    f"{source}: {name} is {arrays[name].dtype} {arrays[name].shape}, but its header asks for "
                    f"{target.dtype} {target.shape}; save the {self.kind} again."
                )
            if not np.isfinite(arrays[name]).all():
                raise ToolkitError(f"{source}: {name} holds numbers that are not finite; use an earlier file.")
            if name.endswith("_scale") and (arrays[name] <= 0.0).any():
                raise ToolkitError(f"{source}: {name} is not positive everywhere; use an earlier file.")
        for name, target in targets.items():
            target[...] = arrays[name]

    def copy(self) -> Self:
        """An independent twin, equal bit for bit."""
        return _rebuild(type(self), self._header(), {name: array.copy() for name, array in self._arrays().items()})

    def __reduce__(self) -> tuple:
        # copy.deepcopy and process pools would otherwise cut the views loose from the flat vector.
        arrays = {name: array.copy() for name, array in self._arrays().items()}
        return _rebuild, (type(self), self._header(), arrays)


class GaussianPolicy(_Network):
    """Actions are normal about a tanh network's output, with one standard deviation per action entry, whatever the
    observation: `action ~ N(mean(obs), diag(exp(log_std))^2)`.

    Args:
        observation_names: what each of the n_obs entries is, in order.
        action_names: what each of the n_act entries is, in order.
        rng: source of the initial weights.
        hidden: units of each hidden layer.
        init_log_std: initial log standard deviation of every action entry, in log action units.

    Raises:
        ToolkitError: names that are empty or repeat.
    """

    kind = "policy"

    def __init__(
        self,
        observation_names: Sequence[str],
        action_names: Sequence[str],
        rng: np.random.Generator,
        hidden: Sequence[int] = (32, 32),
        init_log_std: float = -1.0,
    ) -> None:
        self.action_names = _distinct(action_names, "action")
        n_act = len(self.action_names)
        super().__init__(observation_names, n_act, n_act, hidden, rng)
        self._log_std[...] = init_log_std

    @property
    def log_std(self) -> np.ndarray:
        """(n_act,) copy of the log standard deviations, in log action units."""
        return self._log_std.copy()

    def set_log_std(self, log_std: np.ndarray) -> None:
        """Overwrite the (n_act,) log standard deviations, in log action units. Raises ToolkitError on a wrong shape."""
        self._overwrite(self._log_std, log_std, "log_std")

    def mean(self, observations: np.ndarray) -> np.ndarray:
        """Most likely action: (n_obs,) -> (n_act,), or (N, n_obs) -> (N, n_act)."""
        return self._forward(observations)

    def act(self, observation: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """One (n_act,) sample for an (n_obs,) observation; draws exactly n_act standard normals from rng."""
        action = self._forward(observation)
        action += np.exp(self._log_std) * rng.standard_normal(len(action))
        return action

    def torch_mean(self, observations: torch.Tensor, parameters: torch.Tensor) -> torch.Tensor:
        """`mean` as a differentiable function of (P,) parameters: (N, n_obs) -> (N, n_act), float64."""
        return self._torch_forward(observations, parameters)

    def torch_log_std(self, parameters: torch.Tensor) -> torch.Tensor:
        """The (n_act,) part of (P,) parameters that holds the log standard deviations."""
        return parameters[len(parameters) - len(self._log_std) :]

    def log_prob(
        self, observations: torch.Tensor, actions: torch.Tensor, parameters: torch.Tensor
    ) -> torch.Tensor:
        """(N,) log density of (N, n_act) actions at (N, n_obs) observations, differentiable in (P,) parameters."""
        log_std = self.torch_log_std(parameters)
        z = (actions - self.torch_mean(observations, parameters)) * torch.exp(-log_std)
        return -0.5 * (z * z + _LOG_2_PI).sum(dim=1) - log_std.sum()

    def entropy(self) -> float:
        """Entropy of the action distribution in nats; it does not depend on the observation."""
        return float(self._log_std.sum() + 0.5 * len(self._log_std) * (1.0 + _LOG_2_PI))

    @classmethod
    def load(
        cls,
        path: str | Path,
        observation_names: Sequence[str] | None = None,
        action_names: Sequence[str] | None = None,
    ) -> Self:
        """Read a file that `save` wrote, bit for bit; names, where given, must be the file's own, in order.

        Raises:
            ToolkitError: missing, truncated or foreign file, other names, wrong shapes, or numbers not finite.
        """
        policy = cls._load(path)
        _same_names(path, "observation", observation_names, policy.observation_names)
        _same_names(path, "action", action_names, policy.action_names)
        return policy

    def _header(self) -> dict[str, Any]:
        return super()._header() | {"action_names": self.action_names}

    def _arrays(self) -> dict[str, np.ndarray]:
        return super()._arrays() | {"log_std": self._log_std}

    @classmethod
    def _blank(cls, header: dict[str, Any]) -> Self:
        rng = np.random.default_rng(0)
        return cls(header["observation_names"], header["action_names"], rng, header["hidden"])


@dataclass(frozen=True)
class MeanActor:
    """A policy that plays its most likely action and draws nothing; may be sent to another process.

    Attributes:
        policy: whose mean it plays.
    """

    policy: GaussianPolicy

    def __call__(self, observation: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """Action (n_act,) for an observation (n_obs,)."""
        return self.policy.mean(observation)


class ValueFunction(_Network):
    """Expected discounted return of an observation, the baseline of the policy gradient; in units of reward.

    The network answers in standard units; `return_shift` and `return_scale` turn them into reward. The network then
    learns how states differ; how large returns are as a whole it never has to chase, which would saturate it.

    Args:
        observation_names: what each of the n_obs entries is, in order.
        rng: source of the initial weights.
        hidden: units of each hidden layer.

    Raises:
        ToolkitError: names that are empty or repeat.
    """

    kind = "value function"

    def __init__(
        self, observation_names: Sequence[str], rng: np.random.Generator, hidden: Sequence[int] = (32, 32)
    ) -> None:
        super().__init__(observation_names, 1, 0, hidden, rng)
        self._return_shift, self._return_scale = np.zeros(1), np.ones(1)

    @property
    def return_shift(self) -> float:
        """Return that the network calls 0, in units of reward."""
        return float(self._return_shift[0])

    @property
    def return_scale(self) -> float:
        """Return above `return_shift` that the network calls 1, in units of reward."""
        return float(self._return_scale[0])

    def set_return_scale(self, shift: float, scale: float) -> None:
        """Set the return that the network calls 0, and how far above it 1 lies, in units of reward.

        The network stays as it is, so every prediction follows: the baseline's mean and spread are right at once.

        Raises:
            ToolkitError: a shift that is not finite, or a scale that is not positive and finite.
        """
        if not (math.isfinite(shift) and 0.0 < scale < math.inf):
            raise ToolkitError(f"return shift {shift} and scale {scale}; give finite numbers and a positive scale.")
        self._return_shift[0], self._return_scale[0] = shift, scale

    def predict(self, observations: np.ndarray) -> np.ndarray:
        """(N, n_obs) observations -> (N,) expected discounted return, in units of reward."""
        return self._forward(observations)[:, 0] * self.return_scale + self.return_shift

    def torch_standard(self, observations: torch.Tensor, parameters: torch.Tensor) -> torch.Tensor:
        """(N, n_obs) -> (N,) return in standard units, differentiable in (P,) parameters, float64."""
        return self._torch_forward(observations, parameters)[:, 0]

    @classmethod
    def load(cls, path: str | Path, observation_names: Sequence[str] | None = None) -> Self:
        """Read a file that `save` wrote, bit for bit; names, where given, must be the file's own, in order.

        Raises:
            ToolkitError: missing, truncated or foreign file, other names, wrong shapes, or numbers not finite.
        """
        value = cls._load(path)
        _same_names(path, "observation", observation_names, value.observation_names)
        return value

    def _arrays(self) -> dict[str, np.ndarray]:
        return super()._arrays() | {"return_shift": self._return_shift, "return_scale": self._return_scale}

    @classmethod
    def _blank(cls, header: dict[str, Any]) -> Self:
        return cls(header["observation_names"], np.random.default_rng(0), header["hidden"])


def _unflatten(flat: Any, sizes: Sequence[int]) -> tuple[tuple[Any, Any], ...]:
    """Views ((n_out, n_in) W, (n_out,) b) into a flat vector, numpy or torch alike."""
    layers, start = [], 0
    for n_in, n_out in pairwise(sizes):
        middle = start + n_in * n_out
        layers.append((flat[start:middle].reshape(n_out, n_in), flat[middle : middle + n_out]))
        start = middle + n_out
    return tuple(layers)


def _distinct(names: Sequence[str], what: str) -> tuple[str, ...]:
    names = tuple(names)
    if not names or len(set(names)) < len(names) or not all(isinstance(name, str) for name in names):
        raise ToolkitError(f"{what} names are {names}; give at least one, all strings, all different.")
    return names


def _same_names(path: str | Path, what: str, expected: Sequence[str] | None, found: tuple[str, ...]) -> None:
    if expected is None or tuple(expected) == found:
        return
    if len(expected) != len(found):
        raise ToolkitError(
            f"{path} has {len(found)} {what} entries, not {len(expected)}; use a file made for this task."
        )
    i = next(i for i, (a, b) in enumerate(zip(expected, found, strict=True)) if a != b)
    raise ToolkitError(
        f"{path}: {what} entry {i} is {found[i]!r}, not {expected[i]!r}; use a file made for this task."
    )


def _read_safetensors(path: Path, kind: str) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    if not path.is_file():
        raise ToolkitError(f"{path} does not exist; give the path of a saved {kind}.")
    header, arrays = read_tensors(path, f"saved {kind}", "meta_evolve", "use another file.")
    found = header.get("kind")
    if found != kind:
        raise ToolkitError(f"{path} holds a {str(found)[:40]}, not a {kind}; give the path of a saved {kind}.")
    return header, arrays


def _rebuild(cls: type[_Network], header: dict[str, Any], arrays: dict[str, np.ndarray]) -> Any:
    network = cls._blank(header)
    network._fill(arrays, "copy")
    return network


# -- checkpoints ---------------------------------------------------------------------------------------------


def network_tensors(prefix: str, network: GaussianPolicy | ValueFunction) -> dict[str, np.ndarray]:
    """All that is trained of a network and its normalisation, for a checkpoint; keys begin with the prefix."""
    layers = network.layers()
    return {f"{prefix}.parameters": network.parameters, f"{prefix}.shift": np.array(layers.shift),
            f"{prefix}.scale": np.array(layers.scale)}


def learner_tensors(prefix: str, policy: GaussianPolicy, value: ValueFunction) -> dict[str, np.ndarray]:
    """Policy and value function, for a checkpoint; keys begin with the prefix."""
    returns = np.array([value.return_shift, value.return_scale])
    return network_tensors(f"{prefix}.policy", policy) | network_tensors(f"{prefix}.value", value) | {
        f"{prefix}.returns": returns
    }


def load_network(tensors: dict[str, np.ndarray], prefix: str, network: GaussianPolicy | ValueFunction) -> None:
    """What `network_tensors` stored, into a network of the same sizes."""
    network.set_parameters(tensors[f"{prefix}.parameters"])
    network.set_normalisation(tensors[f"{prefix}.shift"], tensors[f"{prefix}.scale"])


def load_learner(tensors: dict[str, np.ndarray], prefix: str, policy: GaussianPolicy, value: ValueFunction) -> None:
    """What `learner_tensors` stored, into networks of the same sizes."""
    load_network(tensors, f"{prefix}.policy", policy)
    load_network(tensors, f"{prefix}.value", value)
    value.set_return_scale(*map(float, tensors[f"{prefix}.returns"]))

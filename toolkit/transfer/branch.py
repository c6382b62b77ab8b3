"""A policy on its way to the targets that share it, and what the way has cost."""

import math
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from toolkit.learning.exploration import Trials
from toolkit.learning.policy import (
    GaussianPolicy,
    ValueFunction,
    learner_tensors,
    load_learner,
    load_network,
    network_tensors,
)
from toolkit.runs.generators import generator_from_state, generator_state
from toolkit.runs.seeds import TRAINING_SEEDS

Turn = Literal["offset", "gain", "response", "weights"]
TURNS: tuple[Turn, ...] = ("offset", "gain", "response", "weights")
"""What is learned in a phase, in this order and over again."""


@dataclass
class Cost:
    """What a path has cost so far (paper's counting).

    Attributes:
        train_iterations: policy updates.
        sim_epochs: training episodes.
        check_episodes: episodes that only measured success; listed apart.
        diverged: episodes whose simulation blew up.
    """

    train_iterations: int = 0
    sim_epochs: int = 0
    check_episodes: int = 0
    diverged: int = 0


def path_numbers(path: str) -> tuple[int, ...]:
    """(1, 2) of "path 1.2": what orders paths, each before those into which it splits."""
    return tuple(int(number) for number in path.removeprefix("path ").split("."))


def path_generator(seed: int, path: str) -> np.random.Generator:
    """The random numbers of a path: they depend on the transfer's seed and on the path's name, not on what else has been played.

    The numbers of its name are the spawn key, so that the streams of two paths are independent (NumPy's SeedSequence).
    """
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=path_numbers(path)))


@dataclass
class Ledger:
    """What is known of a path, also when it has ended.

    Attributes:
        route: names of the robots at its ends.
        cost: what it has cost.
        records: lines of metrics.jsonl that tell of it.
        play_s, learn_s: wall time of playing its episodes and of learning from them [s].
    """

    route: list[str]
    cost: Cost = field(default_factory=Cost)
    records: int = 0
    play_s: float = 0.0
    learn_s: float = 0.0


@dataclass(eq=False)
class Branch:
    """A policy on its way to the targets that share it.

    Attributes:
        path: "path 1" sets out from the source, and those into which it splits are "path 1.1", "path 1.2", ... in the order of their
            targets: a name says where a path comes from, and not when it was played.
        alpha: (D,) where it is.
        targets: names still to be reached.
        policy, value: the learner's state.
        ledger: what the path has cost, and where it has been.
        rng: all its random numbers, those of the seeds of its training episodes included.
        next_alpha: (D,) robot being trained for, None between phases.
        window: share of the segment [alpha, next_alpha] from which training robots are drawn; it closes to 0.
        stride: length of the last step that worked; the adaptive step starts from twice of it.
        noise: share of the exploration's standard deviation that the policy bears.
        updates: updates in this phase.
        stage: "evolve" on the tree, "settle" on the native robot.
        looked: whether this policy has looked along the way from here, and not moved by training since.
        hopes: (D,) robots ahead that are still to be trained for, on which it succeeded sometimes when it looked; the farthest first.
        began: what was left of its way [alpha] when a tree that asks chose it; None: it waits.
        allowance: training episodes of its path from which on it is compared with others.
        strayed: whether it left from another robot than its tree's.
        turn: what is learned in this phase: "offset", "gain" or "response" (by the search), or "weights" (by NPG).
        turns: that have ended in this phase.
        idle: measurements of this turn since a better success was seen, of the policy or of what was drawn around it.
        numb: whether hardly an episode succeeded under noise in the weights' last update: by the search, under the least; by NPG alone,
            under any, though the mean action holds.
        width: share of the declared deviation with which the search begins its next turn.
        features: (K, H + 1) that the search's responses are to; None: it has offsets alone.
        deviation: (d,) of the search's steps, each in its unit; None before a turn's first.
        centre: (d,) steps that the policy was moved by in this turn.
        trials: of the search in this turn, on the robot that it trains for.
        best_drawn: the best success of a batch of the search in this turn.
        best_success: the best that was measured in this phase on the robot it trains for.
        best: the policy that had it.
    """

    path: str
    alpha: np.ndarray
    targets: list[str]
    policy: GaussianPolicy
    value: ValueFunction
    ledger: Ledger
    rng: np.random.Generator
    next_alpha: np.ndarray | None = None
    window: float = 1.0
    stride: float = math.inf
    noise: float = 1.0
    updates: int = 0
    stage: Literal["evolve", "settle"] = "evolve"
    looked: bool = False
    hopes: list[np.ndarray] = field(default_factory=list)
    began: float | None = None
    allowance: int = 0
    strayed: bool = False
    turn: Turn = "offset"
    turns: int = 0
    idle: int = 0
    numb: bool = False
    width: float = 1.0
    features: np.ndarray | None = None
    deviation: np.ndarray | None = None
    centre: np.ndarray | None = None
    trials: Trials | None = None
    best_drawn: float = 0.0
    best_success: float = 0.0
    best: GaussianPolicy | None = None

    @property
    def alone(self) -> bool:
        """Whether it leads to one target only."""
        return len(self.targets) == 1

    def split(self, parts: Iterable[frozenset[str]], seed: int) -> list["Branch"]:
        """One branch per set of targets, in their order, each with its own copy of the policy, of a transfer with that ``seed``."""
        ordered = sorted(parts, key=lambda part: min(self.targets.index(name) for name in part))
        return [
            Branch(path := f"{self.path}.{number}", self.alpha, [name for name in self.targets if name in part], self.policy.copy(),
                   self.value.copy(), Ledger([*self.ledger.route, "meta"]), path_generator(seed, path), noise=self.noise)
            for number, part in enumerate(ordered, start=1)
        ]

    def begin_phase(self, next_alpha: np.ndarray | None = None) -> None:
        """Forget the last phase; train for ``next_alpha`` (D,), which is then a hope no longer, or for nothing yet."""
        self.hopes = [hope for hope in self.hopes if hope is not next_alpha]
        self.next_alpha, self.window, self.updates = next_alpha, 1.0, 0
        self.turns, self.numb, self.best_success, self.best = 0, False, 0.0, None
        self.begin_turn(TURNS[0])

    def begin_turn(self, turn: Turn) -> None:
        """Learn something else on the same robot."""
        self.turn, self.idle, self.best_drawn = turn, 0, 0.0
        self.features = self.deviation = self.centre = self.trials = None

    def training_seeds(self, count: int) -> list[int]:
        """Seeds of its next training episodes."""
        return [int(seed) for seed in self.rng.integers(TRAINING_SEEDS, size=count)]

    def can_halve(self, shortest: float) -> bool:
        """Whether a robot half as far as the next one is not nearer than ``shortest``, L2 [alpha]."""
        return self.next_alpha is not None and bool(np.linalg.norm(self.next_alpha - self.alpha) >= 2 * shortest)

    def return_to_best(self) -> None:
        """Take the policy that was measured best in this phase, where one was kept."""
        if self.best is not None:
            self.policy = self.best.copy()

    def tensors(self) -> dict[str, np.ndarray]:
        """Its arrays, for a checkpoint; keys begin with the path."""
        prefix = self.path
        found = {f"{prefix}.alpha": self.alpha} | learner_tensors(prefix, self.policy, self.value)
        for name in _ARRAYS:
            if getattr(self, name) is not None:
                found[f"{prefix}.{name}"] = getattr(self, name)
        if self.hopes:
            found[f"{prefix}.hopes"] = np.array(self.hopes)
        if self.trials is not None:
            found |= {f"{prefix}.trials.{name}": array for name, array in vars(self.trials).items()}
        return found if self.best is None else found | network_tensors(f"{prefix}.best", self.best)

    def state(self) -> dict[str, Any]:
        """All else, as JSON values."""
        stride = None if math.isinf(self.stride) else self.stride
        return {key: getattr(self, key) for key in _PLAIN} | {"stride": stride, "rng": generator_state(self.rng)}


_ARRAYS = ("next_alpha", "features", "deviation", "centre")
_PLAIN = (
    "path", "targets", "window", "noise", "updates", "stage", "looked", "began", "allowance", "strayed",
    "turn", "turns", "idle", "numb", "width", "best_drawn", "best_success",
)


def stored_branch(
    tensors: dict[str, np.ndarray], state: dict[str, Any], policy: GaussianPolicy, value: ValueFunction, ledger: Ledger
) -> Branch:
    """The branch that ``tensors`` and ``state`` of a Branch describe.

    Args:
        tensors: as given out by `Branch.tensors`.
        state: as given out by `Branch.state`.
        policy, value: networks of the same sizes, left as they are.
        ledger: of its path.

    Raises:
        ToolkitError: they are of other sizes.
    """
    prefix, policy, value = state["path"], policy.copy(), value.copy()
    load_learner(tensors, prefix, policy, value)
    best = None
    if f"{prefix}.best.parameters" in tensors:
        best = policy.copy()
        load_network(tensors, f"{prefix}.best", best)
    trials = None
    if f"{prefix}.trials.success" in tensors:
        trials = Trials(**{name: tensors[f"{prefix}.trials.{name}"] for name in ("offsets", "centres", "deviations", "success")})
    rest: dict[str, Any] = {name: tensors.get(f"{prefix}.{name}") for name in _ARRAYS} | {key: state[key] for key in _PLAIN if key in state}
    return Branch(
        alpha=tensors[f"{prefix}.alpha"], policy=policy, value=value, ledger=ledger, rng=generator_from_state(state["rng"]), best=best,
        hopes=list(tensors.get(f"{prefix}.hopes", ())), trials=trials, stride=math.inf if state["stride"] is None else state["stride"],
        **rest,
    )

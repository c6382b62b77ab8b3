"""Meta-Evolve: a policy follows the evolution tree from the source robot to every target (Liu et al. 2024, Algorithm 1).

    meta_evolve     Algorithm 1: the loop over phases, the split at meta robots, the recursion as a list of branches
    evolve          lines 4 and 5: choose the next robot on the way, train until the policy holds on it, go there
    steer           line 4: which way, straight to the meta robot or where the policy also earns more
    settle          the last hop: from F(beta) to the unmodified robosuite robot

The state between two updates is everything: it is written to one checkpoint, and a killed run continues from it to the
same result.
"""

import math
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field, replace
from typing import Any, Literal, Protocol

import numpy as np

from toolkit.errors import ToolkitError
from toolkit.evolution import KINDS, METRICS, Kind, MetaStep, Metric, Terminal, next_meta_robot
from toolkit.learning.episode import Episode
from toolkit.learning.npg import Demonstrations, NpgConfig, npg_step
from toolkit.learning.policy import (
    GaussianPolicy,
    ValueFunction,
    learner_tensors,
    load_learner,
    load_network,
    network_tensors,
)
from toolkit.runs import Run, generator_from_state, generator_state
from toolkit.steering import heading, jacobian, sample_robots

Method = Kind | Literal["direct"]
METHODS: tuple[Method, ...] = (*KINDS, "direct")
PATHS = ("straight", "optimised")

TRAINING_SEEDS = 10**6
"""Training episodes take their seeds below this number."""
CHECKING_SEEDS = 2 * 10**6
"""The schedule measures success on seeds from here on: the same for every robot (common random numbers), none trained."""

DEMONSTRATION_SEEDS = 6 * 10**6
"""What the expert shows on the source is played on seeds from here on."""


@dataclass(frozen=True)
class TransferConfig:
    """What determines a transfer; "paper" marks values of its hyperparameter table."""

    kind: Method = "steiner"
    """Evolution tree: "steiner", "geometric-median" (one meta robot) or "independent" (one path per target: HERD, REvolveR).
    "direct" has no evolution: the expert is trained on every target itself from the start, pulled by what it did on the
    source (DAPG)."""
    metric: Metric = "l1"
    """Distance between robots."""
    seed: int = 0
    """Of everything random."""
    step: Literal["adaptive", "fixed"] = "adaptive"
    """"fixed": steps of length xi (paper). "adaptive": the farthest robot on which the policy still holds."""
    xi: float = 0.03
    """Evolution step, L2 (paper); adaptive: the shortest step tried."""
    path: Literal["straight", "optimised"] = "straight"
    """"straight": to the meta robot (REvolveR). "optimised": also where the expected return grows (HERD; Algorithm 1, line 4)."""
    pull: float = 1.0
    """Weight lambda of the meta robot in the direction of an optimised path (paper)."""
    demonstrations: int = 12
    """Episodes of the expert on the source whose successes pull the updates of "direct"; 0: none. Not counted, as given data."""
    jacobian_episodes: int = 72
    """Robots sampled, at distance xi, for the Jacobian of the expected return; one training episode each (paper)."""
    exploration: float | None = None
    """Standard deviation of every action's noise when the transfer begins, which training then changes; None: the expert's own."""
    threshold: float = 2 / 3
    """Success rate of the mean action for moving on (paper: 66.7 %)."""
    noisy_threshold: float = 1 / 2
    """Success rate under the noise of training for moving on: what trains next learns from such successes."""
    signal: float = 1 / 8
    """Success rate under the noise of training from which there is enough to learn from; adaptive: where training begins. The window's
    other robots are nearer, and succeed more often."""
    calm: float = 0.8
    """Adaptive: factor on the noise where the mean action holds and the exploring policy does not; 1: the noise is left to training."""
    least_noise: float = 1 / 4
    """Adaptive: share of its first standard deviation below which the noise is not calmed."""
    goal: float = 0.85
    """Success rate at which a target counts as learned; a little above the 80 % of the paper, which is judged apart."""
    shrink: float = 0.995
    """Factor by which the sampling window closes in on the next robot, per update (paper)."""
    check_episodes: int = 24
    """Episodes of one measurement of success on the way (upstream: 24)."""
    goal_episodes: int = 40
    """Episodes of one measurement of success at a target."""
    check_every: int = 4
    """Updates between two measurements in a phase."""
    path_budget: int = 20_000
    """Simulation epochs after which a path goes on to its end untrained; what it then reaches is measured, not assumed."""
    native: bool = True
    """Whether each path ends with the last hop to the unmodified robosuite robot."""
    npg: NpgConfig = field(default_factory=NpgConfig)
    """The learner."""

    def __post_init__(self) -> None:
        for name, low, high in (("threshold", 0, 1), ("noisy_threshold", 0, 1), ("signal", 0, 1), ("goal", 0, 1), ("shrink", 0, 1),
                                ("calm", 0, 1), ("least_noise", 0, 1), ("xi", 0, math.inf)):  # fmt: skip
            value = getattr(self, name)
            if not low < value <= high:
                raise ToolkitError(f"transfer's {name} is {value}; give a number in ({low}, {high}]")
        if self.exploration is not None and not 0 < self.exploration < math.inf:
            raise ToolkitError(f"transfer's exploration is {self.exploration}; give a positive number, or none for the expert's own")
        if not 0 < self.pull < math.inf:
            raise ToolkitError(f"transfer's pull is {self.pull}; give a positive number")
        for name, low in (("check_episodes", 1), ("goal_episodes", 1), ("check_every", 1), ("path_budget", 0), ("seed", 0),
                          ("jacobian_episodes", 2), ("demonstrations", 0)):  # fmt: skip
            if getattr(self, name) < low:
                raise ToolkitError(f"transfer's {name} is {getattr(self, name)}; give at least {low}")
        for name, known in (("step", ("fixed", "adaptive")), ("path", PATHS), ("kind", METHODS), ("metric", METRICS)):
            if getattr(self, name) not in known:
                raise ToolkitError(f"transfer's {name} is {getattr(self, name)!r}; there are: {', '.join(known)}")

    @property
    def tree_kind(self) -> Kind:
        """The evolution tree that the method follows; without evolution the targets share nothing."""
        return "independent" if self.kind == "direct" else self.kind


Outcome = Literal["held", "spent", "training"]


class Player(Protocol):
    """Plays a batch of episodes: RolloutEngine on F(alpha), NativeEngine on a robosuite robot."""

    def play(self, actor: Callable, alphas: list[np.ndarray], seeds: list[int]) -> list[Episode]: ...


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


@dataclass
class Branch:
    """A policy on its way to the targets that share it.

    Attributes:
        path: "path 1", "path 2", ...: a new one after every split, as the paper counts.
        alpha: (D,) where it is.
        targets: names still to be reached.
        policy, value: the learner's state.
        next_alpha: (D,) robot being trained for, None between phases.
        window: share of the segment [alpha, next_alpha] from which training robots are drawn; it closes to 0.
        stride: length of the last step that worked; the adaptive step starts from twice of it.
        noise: share of the exploration's standard deviation that the policy bears.
        updates: updates in this phase.
        stage: "evolve" on the tree, "settle" on the native robot.
    """

    path: str
    alpha: np.ndarray
    targets: list[str]
    policy: GaussianPolicy
    value: ValueFunction
    next_alpha: np.ndarray | None = None
    window: float = 1.0
    stride: float = math.inf
    noise: float = 1.0
    updates: int = 0
    stage: str = "evolve"


class Transfer:
    """One run of Meta-Evolve.

    Args:
        config: see TransferConfig.
        source: name and alpha of the source.
        targets: the targets.
        policy, value: the source expert.
        engine: plays on F(alpha).
        native: target name -> makes the player of the unmodified robot (made when a path gets there).
        run: folder for metrics and checkpoints.
        report: called with one flat record per event, for progress and pictures.
        witness: called with every batch that is played, before anything is learned from it: branch, episodes, and whether
            the policy explored.

    Attributes:
        spent: wall time [s] of the transfer, and its parts that went into playing episodes and into learning.
    """

    def __init__(
        self,
        config: TransferConfig,
        source: Terminal,
        targets: list[Terminal],
        policy: GaussianPolicy,
        value: ValueFunction,
        engine: Player,
        native: Mapping[str, Callable[[], Player]],
        run: Run,
        report: Callable[[dict[str, Any], Branch], None] = lambda record, branch: None,
        witness: Callable[[Branch, list[Episode], bool], None] = lambda branch, episodes, noise: None,
    ) -> None:
        self.config, self.engine, self.native, self.run, self.report = config, engine, native, run, report
        self.witness = witness
        self.goals = {target.name: target.alpha for target in targets}
        self.source, self._expert = source, policy.copy()
        if config.exploration is not None:
            policy = policy.copy()
            policy.set_log_std(np.full(len(policy.action_names), math.log(config.exploration)))
        self._shown: Demonstrations | None = None
        self.rng = np.random.default_rng(config.seed)
        self.costs: dict[str, Cost] = {"path 1": Cost()}
        self.arrived: dict[str, GaussianPolicy] = {}
        self.pending = [Branch("path 1", source.alpha, list(self.goals), policy, value)]
        self.routes = {"path 1": [source.name]}
        self._players: dict[str, Player] = {}
        self._records = 0
        self._started = time.perf_counter()
        self._earlier_seconds = 0.0
        self.spent = {"play_s": 0.0, "learn_s": 0.0, "wall_s": 0.0}

    # ---- Algorithm 1 -------------------------------------------------------------------------------------------

    def meta_evolve(self) -> dict[str, GaussianPolicy]:
        """Transfer the policy to every target; returns target name -> policy."""
        while self.pending:
            branch = self.pending[-1]
            if branch.stage == "settle":
                self.settle(branch)
            else:
                step = self.evolution_tree(branch)
                alone = len(branch.targets) == 1
                if not self.at(branch, step) and (alone or not step.reached):
                    self.evolve(branch, step)
                elif alone:
                    self.reach(branch)
                else:
                    self.split(branch, step)
            self.spent["wall_s"] = self.seconds
            self.checkpoint()
        return self.arrived

    def evolution_tree(self, branch: Branch) -> MetaStep:
        """Algorithm 2 from the current robot."""
        targets = [Terminal(name, self.goals[name]) for name in branch.targets]
        return next_meta_robot(Terminal("current", branch.alpha), targets, self.config.metric, self.config.tree_kind)

    def at(self, branch: Branch, step: MetaStep) -> bool:
        """Whether the branch stands at its meta robot (the loop's condition)."""
        return bool(np.linalg.norm(step.meta_alpha - branch.alpha) < 1e-9)

    def split(self, branch: Branch, step: MetaStep) -> None:
        """Lines 10 to 12: one branch per subtree, each with its own copy of the policy; targets reached get their own."""
        self.pending.pop()
        parts = [*step.partition, *(frozenset([name]) for name in step.reached)]
        branches = []
        for part in sorted(parts, key=lambda p: min(branch.targets.index(name) for name in p)):
            path = f"path {len(self.costs) + 1}"
            self.costs[path] = Cost()
            names = [name for name in branch.targets if name in part]
            self.routes[path] = [*self.routes[branch.path], "meta"]
            branches.append(Branch(path, branch.alpha, names, branch.policy.copy(), branch.value.copy(), noise=branch.noise))
            self.say("split", branches[-1], parent=branch.path, targets=" ".join(names))
        self.pending += reversed(branches)  # the last one is played first

    def reach(self, branch: Branch) -> None:
        """Line 8: F(beta) is reached. Train there to the goal, then hop to the native robot."""
        name = branch.targets[0]
        if self.train_to(branch, self.engine, self.goals[name], self.config.goal, self.config.goal_episodes) != "training":
            branch.next_alpha, branch.window, branch.updates = None, 1.0, 0
            if self.config.native and name in self.native:
                branch.stage = "settle"
            else:
                self.finish(branch)

    def settle(self, branch: Branch) -> None:
        """The last hop: from F(beta) to the unmodified robosuite robot, trained and counted like any other phase."""
        name = branch.targets[0]
        if name not in self._players:
            self._players[name] = self.native[name]()
        player, goal = self._players[name], self.goals[name]
        if self.train_to(branch, player, goal, self.config.goal, self.config.goal_episodes) != "training":
            self.finish(branch)

    def finish(self, branch: Branch) -> None:
        """The branch's policy is the answer for its target."""
        self.pending.pop()
        self.arrived[branch.targets[0]] = branch.policy
        self.routes[branch.path].append(branch.targets[0])
        self.say("arrived", branch, target=branch.targets[0])

    # ---- lines 4 and 5: one phase ------------------------------------------------------------------------------

    def evolve(self, branch: Branch, step: MetaStep) -> None:
        """Advance towards the meta robot: choose the next robot, then train until the policy holds on it.

        A path whose budget is spent leaps to its end, where what it has reached is measured.
        """
        distance = float(np.linalg.norm(step.meta_alpha - branch.alpha))
        spent = self.costs[branch.path].sim_epochs >= self.config.path_budget
        if spent and self.config.kind != "direct":
            self.say("budget", branch, reach=distance)
        if spent or self.config.kind == "direct":
            self.move(branch, step.meta_alpha, distance if self.config.kind == "direct" else branch.stride, trained=False)
            return
        if branch.next_alpha is None:
            self.choose_next(branch, step.meta_alpha)
            return
        wanted, episodes = self.config.threshold, self.config.check_episodes
        outcome = self.train_to(branch, self.engine, branch.next_alpha, wanted, episodes, exploring=True)
        if outcome == "held":
            length = float(np.linalg.norm(branch.next_alpha - branch.alpha))
            self.move(branch, branch.next_alpha, length, trained=True)

    def choose_next(self, branch: Branch, meta: np.ndarray) -> None:
        """Pick the next robot on the way to ``meta`` (D,).

        Fixed steps go xi far. Adaptive steps try twice the last stride and halve it until the policy holds, and what holds is
        taken at once; or until it succeeds often enough under noise to learn there, or xi is reached, and training begins. Where
        only noise stands in the way, there is less of it. The way has one direction per choice; an optimised one is estimated only
        once the meta robot itself is out of reach.
        """
        distance = float(np.linalg.norm(meta - branch.alpha))
        shortest = min(self.config.xi, distance)
        stride = shortest if self.config.step == "fixed" else min(max(2 * branch.stride, shortest), distance)
        way: np.ndarray | None = None
        while True:
            # A remainder shorter than xi would cost a phase of its own.
            last = stride >= distance - (self.config.xi if self.config.step == "adaptive" and stride > shortest else 1e-12)
            if not last and way is None:
                way = self.steer(branch, meta)
            candidate = meta if last else np.clip(branch.alpha + stride * way, 0.0, 1.0)
            branch.next_alpha, branch.window, branch.updates = candidate, 1.0, 0
            if self.config.step == "fixed" or stride <= shortest:
                return
            wanted, enough, episodes = self.config.threshold, self.config.noisy_threshold, self.config.check_episodes
            mean = self.success(branch, self.engine, candidate, wanted, episodes)
            noisy = self.success(branch, self.engine, candidate, enough, episodes, exploring=True)
            while mean >= wanted and self.config.signal <= noisy < enough and self.calm(branch):
                noisy = self.success(branch, self.engine, candidate, enough, episodes, exploring=True)
            if mean >= wanted and noisy >= enough:
                self.move(branch, candidate, stride, trained=False)
                return
            if noisy >= self.config.signal:
                self.improve(branch, self.engine, candidate)  # it was measured just now
                return
            stride = max(stride / 2, shortest)

    def steer(self, branch: Branch, meta: np.ndarray) -> np.ndarray:
        """Unit vector (D,) of the way on: straight to ``meta``, or bent to where the policy earns more.

        The episodes that this takes train nothing but cost the same, and are counted as simulation epochs.
        """
        if self.config.path == "straight":
            return (meta - branch.alpha) / np.linalg.norm(meta - branch.alpha)
        robots = sample_robots(branch.alpha, self.config.jacobian_episodes, self.config.xi, self.rng)
        seeds = np.repeat(self.rng.integers(TRAINING_SEEDS, size=-(-len(robots) // 2)), 2)[: len(robots)]
        batch = self.played(self.engine, branch.policy.act, list(robots), [int(seed) for seed in seeds])
        cost = self.costs[branch.path]
        cost.sim_epochs += len(batch)
        cost.diverged += sum(episode.diverged for episode in batch)
        returns = np.array([episode.discounted_return(self.config.npg.gamma) for episode in batch])
        slope = jacobian(robots, returns)
        way = heading(slope, branch.alpha, meta, self.config.pull)
        straight = (meta - branch.alpha) / np.linalg.norm(meta - branch.alpha)
        self.say("steered", branch, mean_return=float(returns.mean()), slope=float(np.linalg.norm(slope)),
                 straight_share=float(way @ straight))  # fmt: skip
        return way

    def move(self, branch: Branch, alpha: np.ndarray, stride: float, trained: bool) -> None:
        """Line 5: the robot evolves."""
        branch.alpha, branch.stride = np.clip(alpha, 0.0, 1.0), stride
        branch.next_alpha, branch.window, branch.updates = None, 1.0, 0
        distance = float(np.linalg.norm(self.evolution_tree(branch).meta_alpha - branch.alpha))
        self.say("moved", branch, stride=stride, distance=distance, trained=trained)

    def train_to(
        self, branch: Branch, player: Player, alpha: np.ndarray, wanted: float, episodes: int, exploring: bool = False
    ) -> Outcome:
        """One update towards ``wanted`` success of the mean action on the robot ``alpha`` (D,), and that which ``exploring`` needs.

        Returns:
            "held" if the policy has that success already, "spent" if the path's budget is, else "training".

        Success is measured before the first update and after every check_every-th.
        """
        if branch.updates % self.config.check_every == 0:
            holds = self.success(branch, player, alpha, wanted, episodes) >= wanted
            enough = self.config.noisy_threshold
            if holds and (not exploring or self.success(branch, player, alpha, enough, episodes, exploring=True) >= enough):
                return "held"
            if holds:
                self.calm(branch)
            else:
                self.rouse(branch)
        cost = self.costs[branch.path]
        if cost.sim_epochs >= self.config.path_budget:
            self.say("budget", branch, sim_epochs=cost.sim_epochs)
            return "spent"
        self.improve(branch, player, alpha)
        return "training"

    def calm(self, branch: Branch) -> bool:
        """Less exploration, if there is any to spare: where the mean action holds, more noise than it bears teaches it to bear noise.

        With ``rouse`` a success rule, as evolution strategies have for the length of their steps (Rechenberg 1973).
        """
        return self.explore(branch, max(self.config.calm * branch.noise, self.config.least_noise))

    def rouse(self, branch: Branch) -> bool:
        """More exploration, never beyond the first: where the mean action fails there is to learn, and steps are as long as the noise."""
        return self.explore(branch, min(branch.noise / self.config.calm, 1.0))

    def explore(self, branch: Branch, noise: float) -> bool:
        """Give the exploration the share ``noise`` of its standard deviation; returns whether it had another one."""
        if self.config.step == "fixed" or noise == branch.noise:
            return False
        branch.policy.set_log_std(branch.policy.log_std + math.log(noise / branch.noise))
        branch.noise = noise
        return True

    def improve(self, branch: Branch, player: Player, alpha: np.ndarray) -> None:
        """One update, on robots drawn from the part of the segment from branch.alpha to ``alpha`` (D,) that the window leaves open."""
        cost = self.costs[branch.path]
        size = self.config.npg.batch_size
        shares = 1.0 - branch.window * self.rng.uniform(size=size)
        alphas = [branch.alpha + share * (alpha - branch.alpha) for share in shares]
        seeds = [int(seed) for seed in self.rng.integers(TRAINING_SEEDS, size=size)]
        before = self.spent["play_s"]
        batch = self.played(player, branch.policy.act, alphas, seeds)
        play_seconds = self.spent["play_s"] - before
        self.witness(branch, batch, True)
        shown = self.demonstrations(cost.train_iterations) if self.config.kind == "direct" else None
        statistics = npg_step(branch.policy, branch.value, batch, self.config.npg, self.rng, shown)
        self.spent["learn_s"] += statistics["seconds"]
        cost.train_iterations += 1
        cost.sim_epochs += size
        cost.diverged += sum(episode.diverged for episode in batch)
        branch.window *= self.config.shrink
        branch.updates += 1
        self.say(
            "update", branch, train_success=float(np.mean([e.success for e in batch])), window=branch.window,
            mean_return=float(np.mean([e.discounted_return(self.config.npg.gamma) for e in batch])),
            kl=statistics["kl"], episodes_per_s=size / play_seconds, play_s=play_seconds,
            learn_s=statistics["seconds"],
        )  # fmt: skip

    def played(self, player: Player, actor: Callable, alphas: list[np.ndarray], seeds: list[int]) -> list[Episode]:
        """``player.play``, timed."""
        began = time.perf_counter()
        batch = player.play(actor, alphas, seeds)
        self.spent["play_s"] += time.perf_counter() - began
        return batch

    def demonstrations(self, update: int) -> Demonstrations | None:
        """What the expert did on the source where it succeeded; a resumed run plays the same again."""
        if self._shown is None and self.config.demonstrations:
            actor = lambda observation, rng: self._expert.mean(observation)  # noqa: E731
            seeds = [DEMONSTRATION_SEEDS + i for i in range(self.config.demonstrations)]
            good = [e for e in self.engine.play(actor, [self.source.alpha] * len(seeds), seeds) if e.success]
            if not good:
                raise ToolkitError(f"the expert fails {len(seeds)} times of {len(seeds)} on {self.source.name}; train it again")
            observations = np.concatenate([episode.observations for episode in good])
            self._shown = Demonstrations(observations, np.concatenate([episode.actions for episode in good]))
        return None if self._shown is None else replace(self._shown, update=update)

    def success(
        self, branch: Branch, player: Player, alpha: np.ndarray, wanted: float, episodes: int, exploring: bool = False
    ) -> float:
        """Success rate of the policy on the robot ``alpha`` (D,), stopped as soon as it is sure to be at least ``wanted`` or below.

        Judged by the mean action, or ``exploring``, as it trains: where only the mean action succeeds there is nothing to learn from,
        and a policy that goes on from there soon loses what it had.
        """
        needed = math.ceil(wanted * episodes)
        successes = played = 0
        actor = branch.policy.act if exploring else lambda observation, rng: branch.policy.mean(observation)
        while played < episodes and successes < needed and successes + episodes - played >= needed:
            size = min(8, episodes - played)
            batch = self.played(player, actor, [alpha] * size, [CHECKING_SEEDS + played + i for i in range(size)])
            played += size
            successes += sum(episode.success for episode in batch)
            self.costs[branch.path].diverged += sum(episode.diverged for episode in batch)
            self.witness(branch, batch, exploring)
        self.costs[branch.path].check_episodes += played
        reach = float(np.linalg.norm(alpha - branch.alpha))
        event = "explore" if exploring else "check"
        self.say(event, branch, success=successes / played, checked=played, reach=reach, held=successes >= needed, noise=branch.noise)
        return successes / played

    # ---- what a run leaves -------------------------------------------------------------------------------------

    def say(self, event: str, branch: Branch, **values: Any) -> None:
        """One line of metrics.jsonl, passed on to whoever watches."""
        cost = self.costs[branch.path]
        record = {"event": event, "path": branch.path, "stage": branch.stage, **values, **asdict(cost), "seconds": self.seconds}
        self._records += 1
        self.run.append_metrics(record)
        self.report(record, branch)

    @property
    def seconds(self) -> float:
        """Wall time of the run, over all its sittings [s]."""
        return self._earlier_seconds + time.perf_counter() - self._started

    def checkpoint(self) -> None:
        """Everything the run needs to go on, in one atomic file."""
        tensors: dict[str, np.ndarray] = {}
        branches = []
        for i, branch in enumerate(self.pending):
            tensors |= {f"pending.{i}.alpha": branch.alpha} | learner_tensors(f"pending.{i}", branch.policy, branch.value)
            if branch.next_alpha is not None:
                tensors[f"pending.{i}.next_alpha"] = branch.next_alpha
            state = {key: getattr(branch, key) for key in ("path", "targets", "window", "noise", "updates", "stage")}
            branches.append(state | {"stride": None if math.isinf(branch.stride) else branch.stride})
        for name, policy in self.arrived.items():
            tensors |= network_tensors(f"arrived.{name}", policy)
        state = {
            "pending": branches, "arrived": list(self.arrived), "routes": self.routes, "records": self._records,
            "costs": {path: asdict(cost) for path, cost in self.costs.items()}, "rng": generator_state(self.rng),
            "seconds": self.seconds, "spent": self.spent,
        }  # fmt: skip
        self.run.save_checkpoint("transfer", tensors, state)

    def restore(self) -> None:
        """Continue from the run's checkpoint, if it has one; metrics written after it are dropped.

        Raises:
            ToolkitError: the checkpoint is broken, or was made for networks or spaces of other dimensions.
        """
        if "transfer" not in self.run.checkpoints():
            self.run.truncate_metrics(0)
            return
        tensors, state = self.run.load_checkpoint("transfer")
        model, critic = self.pending[0].policy, self.pending[0].value
        size = self.pending[0].alpha.size
        self.pending, self.arrived = [], {}
        for i, saved in enumerate(state["pending"]):
            alpha = tensors[f"pending.{i}.alpha"]
            if alpha.size != size:
                raise ToolkitError(
                    f"{self.run.path}: its checkpoint has {alpha.size} evolution dimensions, this space {size}; "
                    "the robots have changed since; start a new run"
                )
            policy, value = model.copy(), critic.copy()
            load_learner(tensors, f"pending.{i}", policy, value)
            stride = math.inf if saved["stride"] is None else saved["stride"]
            fields = {key: saved[key] for key in ("path", "targets", "window", "noise", "updates", "stage") if key in saved}
            self.pending.append(
                Branch(alpha=alpha, policy=policy, value=value, stride=stride,
                       next_alpha=tensors.get(f"pending.{i}.next_alpha"), **fields)
            )  # fmt: skip
        for name in state["arrived"]:
            self.arrived[name] = model.copy()
            load_network(tensors, f"arrived.{name}", self.arrived[name])
        self.costs = {path: Cost(**cost) for path, cost in state["costs"].items()}
        self.routes, self._records = state["routes"], state["records"]
        self.rng = generator_from_state(state["rng"])
        self._earlier_seconds, self.spent = state["seconds"], state.get("spent", self.spent)
        self.run.truncate_metrics(self._records)

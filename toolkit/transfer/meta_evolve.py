"""Meta-Evolve: a policy follows the evolution tree from the source robot to every target (Liu et al. 2024, Algorithm 1).

    meta_evolve     Algorithm 1: the loop over phases, the split at meta robots, the recursion as a list of branches
    evolve          lines 4 and 5: choose the next robot on the way, train until the policy holds on it, go there
    choose          of a tree that asks: which target is next, and from which robot
    look_ahead      whether the policy already holds farther on: at the end of its way, at the targets behind, in between
    steer           line 4: which way, straight to the meta robot or where the policy also earns more
    settle          the last hop: from F(beta) to the unmodified robosuite robot

The state between two updates is everything: it is written to one checkpoint, and a killed run continues from it to the
same result.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from typing import Any, Literal

import numpy as np

from toolkit.errors import ToolkitError
from toolkit.evolution import MetaStep, Terminal, next_meta_robot
from toolkit.evolution.bend import Bend
from toolkit.learning.episode import Episode
from toolkit.learning.exploration import Explored
from toolkit.learning.policy import GaussianPolicy, ValueFunction, load_network, network_tensors
from toolkit.runs.generators import generator_from_state, generator_state
from toolkit.runs.run import Run
from toolkit.transfer.asking import Asking
from toolkit.transfer.branch import Branch, Cost, stored_branch
from toolkit.transfer.learners import SearchLearner, WeightLearner
from toolkit.transfer.sampling import Player, Sampler
from toolkit.transfer.settings import TransferConfig
from toolkit.transfer.steering import heading, jacobian, sample_robots

LOOKS = (1.0, 0.75, 0.5, 0.25, 0.125)
"""Shares of the way ahead at which a phase begins by looking, the farthest first: success is not monotone along a way, so a failure
says nothing of the robots behind it."""

NUMBED = 1 / 2
"""Factor on the noise in the weights' turn of a search where hardly an episode succeeds under it."""

Outcome = Literal["held", "spent", "training", "stalled"]


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
        report, witness: as for Sampler.
        explored: what the learner "search" explores, and how far.
        bends: targets behind an edge -> how it turns; the other edges are straight.

    Attributes:
        arrived: target -> its policy.
        pending: branches under way; the last is played.
        routes: path -> names of the robots at its ends.
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
        witness: Callable[[Branch, list[Episode], bool, list[GaussianPolicy]], None] = lambda branch, episodes, noise, policies: None,
        explored: Explored | None = None,
        bends: Mapping[frozenset[str], Bend] | None = None,
    ) -> None:
        self.config, self.engine, self.native, self.run = config, engine, native, run
        self.bends = bends or {}
        self.goals = {target.name: target.alpha for target in targets}
        self.sampler = Sampler(run, config.seed, report, witness)
        self.weights = WeightLearner(config, self.sampler, engine, source, policy.copy())
        self.search = None
        if config.learner == "search":
            self.search = SearchLearner(config, self.sampler, explored or Explored(np.zeros(0), np.zeros(0)))
        if config.exploration is not None:
            policy = policy.copy()
            policy.set_log_std(np.full(len(policy.action_names), math.log(config.exploration)))
        self.costs["path 1"] = Cost()
        self.arrived: dict[str, GaussianPolicy] = {}
        self.pending = [Branch("path 1", source.alpha, list(self.goals), policy, value)]
        self.routes = {"path 1": [source.name]}
        self._players: dict[str, Player] = {}
        self.asking = None
        if config.kind == "asking":
            self.asking = Asking(config.metric, LOOKS, config.xi)
            self.asking.offer(self.pending[0], [source.name])

    @property
    def costs(self) -> dict[str, Cost]:
        """Path -> what it has cost."""
        return self.sampler.costs

    # ---- Algorithm 1 -------------------------------------------------------------------------------------------

    def meta_evolve(self) -> dict[str, GaussianPolicy]:
        """Transfer the policy to every target; returns target name -> policy."""
        while self.pending:
            if self.asking is not None and self.may_change(self.pending[-1]):
                self.choose(self.asking)
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
            self.sampler.spent["wall_s"] = self.sampler.seconds
            self.checkpoint()
        return self.arrived

    def evolution_tree(self, branch: Branch) -> MetaStep:
        """Algorithm 2 from the current robot."""
        targets = [Terminal(name, self.goals[name]) for name in branch.targets]
        return next_meta_robot(Terminal("current", branch.alpha), targets, self.config.metric, self.config.tree_kind)

    def ahead(self, branch: Branch, step: MetaStep) -> np.ndarray:
        """Where the way to the meta robot goes straight from here (D,): to its corner, or to the meta robot."""
        bend = None if branch.strayed else self.bends.get(frozenset(branch.targets))
        turn = None if bend is None else bend.ahead(branch.alpha, step.meta_alpha)
        return step.meta_alpha if turn is None else turn

    def at(self, branch: Branch, step: MetaStep) -> bool:
        """Whether the branch stands at its meta robot (the loop's condition)."""
        return bool(np.linalg.norm(step.meta_alpha - branch.alpha) < 1e-9)

    def split(self, branch: Branch, step: MetaStep) -> None:
        """Lines 10 to 12: one branch per subtree; targets reached get their own."""
        if self.asking is not None:
            self.asking.offer(branch, [*self.routes[branch.path], "meta"])
        self.part(branch, [*step.partition, *(frozenset([name]) for name in step.reached)])

    def part(self, branch: Branch, parts: Sequence[frozenset[str]]) -> list[Branch]:
        """One branch per set of targets, each with its own copy of the policy."""
        self.pending.pop()
        branches = []
        for part in sorted(parts, key=lambda p: min(branch.targets.index(name) for name in p)):
            path = self.new_path([*self.routes[branch.path], "meta"])
            names = [name for name in branch.targets if name in part]
            branches.append(Branch(path, branch.alpha, names, branch.policy.copy(), branch.value.copy(), noise=branch.noise))
            self.sampler.say("split", branches[-1], parent=branch.path, targets=" ".join(names))
        self.pending += reversed(branches)  # the last one is played first
        return branches

    def new_path(self, route: Sequence[str]) -> str:
        """Name of one more path, which sets out by that ``route`` and has cost nothing."""
        path = f"path {len(self.costs) + 1}"
        self.costs[path], self.routes[path] = Cost(), list(route)
        return path

    def reach(self, branch: Branch) -> None:
        """Line 8: F(beta) is reached. Train there to the goal, then hop to the native robot.

        The search trains on the native robot at once: that is where success is claimed.
        """
        name = branch.targets[0]
        hops = self.config.native and name in self.native
        if (hops and self.search is not None) or self.train_to_goal(branch, self.engine) != "training":
            branch.begin_phase()
            if hops:
                branch.stage = "settle"
            else:
                self.finish(branch)

    def settle(self, branch: Branch) -> None:
        """The last hop: from F(beta) to the unmodified robosuite robot, trained and counted like any other phase."""
        if self.train_to_goal(branch, self.native_player(branch)) != "training":
            self.finish(branch)

    def train_to_goal(self, branch: Branch, player: Player) -> Outcome:
        """One update towards the goal at the branch's only target."""
        return self.train_to(branch, player, self.goals[branch.targets[0]], self.config.goal, self.config.goal_episodes)

    def native_player(self, branch: Branch) -> Player:
        """Plays on the unmodified robot of the branch's only target."""
        name = branch.targets[0]
        if name not in self._players:
            self._players[name] = self.native[name]()
        return self._players[name]

    def finish(self, branch: Branch) -> None:
        """The branch's policy is the answer for its target."""
        self.pending.pop()
        self.arrived[branch.targets[0]] = branch.policy
        self.routes[branch.path].append(branch.targets[0])
        if self.asking is not None:
            self.asking.offer(branch, self.routes[branch.path])
            for rival in [other for other in self.pending if other.targets == branch.targets]:
                self.pending.remove(rival)
                self.sampler.say("overtaken", rival, by=branch.path)
        self.sampler.say("arrived", branch, target=branch.targets[0])

    def may_change(self, branch: Branch) -> bool:
        """Whether a tree that asks may play another branch now: this one is new, or has used its allowance on its way to a target."""
        alone = len(branch.targets) == 1 and branch.stage == "evolve"
        return branch.began is None or (alone and self.costs[branch.path].sim_epochs >= branch.allowance)

    def choose(self, asking: Asking) -> None:
        """Put the branch that is to be played last: one that waits if there is any, else a rival of the last, or the most promising."""
        if any(branch.began is None for branch in self.pending):
            self.choose_waiting(asking)
            return
        branch = self.pending[-1]
        name = branch.targets[0]
        if name not in asking.raced and self.routes[branch.path] != asking.routes[0]:
            self.race(branch, asking)
            return
        promises = {
            index: asking.promise(other, self.goals[other.targets[0]], self.costs[other.path].sim_epochs)
            for index, other in enumerate(self.pending) if len(other.targets) == 1
        }  # fmt: skip
        branch = self.pending.pop(min(promises, key=lambda index: promises[index]))
        branch.allowance = 2 * max(self.costs[branch.path].sim_epochs, self.config.allowance)
        self.pending.append(branch)

    def choose_waiting(self, asking: Asking) -> None:
        """Of those that wait the branch with the least left to its meta robot; a target to which some policy leaves less goes first, from
        there."""
        choices = []

        def holds(branch: Branch, robot: np.ndarray) -> bool:
            return self.look(branch, self.engine, robot)[0]

        for index, branch in enumerate(self.pending):
            if branch.began is not None:
                continue
            step = self.evolution_tree(branch)
            end = self.ahead(branch, step)
            own = asking.left(branch, None if end is step.meta_alpha else end, step.meta_alpha, holds)
            choices.append((own, index, None))
            for name in branch.targets if own > 0 else ():
                leap = asking.best(name, self.goals[name], branch.path, holds)
                choices.append((leap.left, index, name))
        _, index, name = min(choices, key=lambda choice: choice[0])
        branch = self.pending.pop(index)
        self.pending.append(branch)
        if name is not None:
            if len(branch.targets) > 1:
                branch = next(b for b in self.part(branch, [frozenset(branch.targets) - {name}, {name}]) if b.targets == [name])
                self.pending.append(self.pending.pop(self.pending.index(branch)))
            self.leave_from(branch, asking)
        self.begin(branch, asking)

    def begin(self, branch: Branch, asking: Asking) -> None:
        """A branch has its first turn."""
        branch.began = asking.distance(branch.alpha, self.evolution_tree(branch).meta_alpha)
        branch.allowance = self.costs[branch.path].sim_epochs + self.config.allowance

    def race(self, branch: Branch, asking: Asking) -> None:
        """Beside a path to a target that costs much another sets out, straight from the source."""
        source, name = asking.origins[0], branch.targets[0]
        path = self.new_path(asking.routes[0])
        rival = Branch(path, source.alpha, [name], source.policy.copy(), source.value.copy(), noise=source.noise, strayed=True)
        self.pending.append(rival)
        asking.raced.append(name)
        self.sampler.say("split", rival, parent="path 1", targets=name, rival=branch.path)
        self.begin(rival, asking)

    def leave_from(self, branch: Branch, asking: Asking) -> None:
        """Take the branch's only target up from the robot that answered best, at where its policy holds."""
        name = branch.targets[0]
        leap = asking.leaps[name]
        origin, goal = asking.origins[leap.origin], self.goals[name]
        branch.strayed = bool(np.linalg.norm(origin.alpha - branch.alpha) > 1e-9)
        branch.alpha, branch.policy, branch.value = origin.alpha, origin.policy.copy(), origin.value.copy()
        branch.noise, branch.width = origin.noise, 1.0
        self.routes[branch.path] = list(asking.routes[leap.origin])
        self.sampler.say("left", branch, origin=self.routes[branch.path][-1], target=name, share=leap.share, left=leap.left)
        robot = goal if leap.share == 1.0 else origin.alpha + leap.share * (goal - origin.alpha)
        self.move(branch, robot, float(np.linalg.norm(robot - origin.alpha)), trained=False)

    # ---- lines 4 and 5: one phase ------------------------------------------------------------------------------

    def evolve(self, branch: Branch, step: MetaStep) -> None:
        """Advance towards the meta robot: choose the next robot, then train until the policy holds on it.

        A path whose budget is spent leaps to its end, where what it has reached is measured.
        """
        goal = step.meta_alpha if self.config.kind == "direct" else self.ahead(branch, step)
        distance = float(np.linalg.norm(goal - branch.alpha))
        spent = self.costs[branch.path].sim_epochs >= self.config.path_budget
        if spent and self.config.kind != "direct":
            self.return_to_best(branch)
            self.sampler.say("budget", branch, reach=distance)
        if spent or self.config.kind == "direct":
            self.move(branch, goal, distance if self.config.kind == "direct" else branch.stride, trained=False)
            return
        if branch.next_alpha is None:
            if self.config.step == "adaptive" and not branch.looked:
                self.look_ahead(branch, step)
            else:
                self.choose_next(branch, goal)
            return
        outcome = self.train_to(branch, self.engine, branch.next_alpha, self.config.threshold, self.config.check_episodes,
                                exploring=self.asks_noise(branch, branch.next_alpha))  # fmt: skip
        length = float(np.linalg.norm(branch.next_alpha - branch.alpha))
        if outcome == "held":
            self.move(branch, branch.next_alpha, length, trained=True)
        elif outcome == "stalled":
            self.try_nearer(branch)

    def try_nearer(self, branch: Branch) -> None:
        """After a phase without success train for the next hope, else for a robot half as far, and at the nearest look ahead anew."""
        assert branch.next_alpha is not None
        if branch.hopes:
            branch.begin_phase(branch.hopes.pop(0))
        elif self.can_halve(branch):
            branch.begin_phase(branch.alpha + 0.5 * (branch.next_alpha - branch.alpha))
        else:
            branch.looked = False  # the policy has changed since
            branch.begin_phase()

    def look_ahead(self, branch: Branch, step: MetaStep) -> None:
        """Go at once to the farthest robot on which the policy holds already, if there is any.

        First the unmodified robot of an only target, then the end of the way, its corner, the targets behind it, and robots in between.
        For plain NPG these are only robots beyond the stride that `choose_next` tries anyway. The search remembers where the policy
        succeeds at least sometimes: training there is cheaper than anywhere nearer.
        """
        end, alone = self.ahead(branch, step), len(branch.targets) == 1
        way = end - branch.alpha
        distance = float(np.linalg.norm(way))
        branch.looked, branch.hopes = True, []
        if alone and self.config.native and branch.targets[0] in self.native:
            branch.stage = "settle"
            goal = self.goals[branch.targets[0]]
            held, _ = self.look(branch, self.native_player(branch), goal)
            branch.stage = "evolve"
            if held:
                self.move(branch, goal, distance, trained=False)
                branch.stage = "settle"
                return
        tried = 0.0 if self.search is not None else 2 * branch.stride
        if end is not step.meta_alpha and self.leap(branch, step.meta_alpha):
            return
        for share in LOOKS:
            if share == 1.0 or share * distance >= self.config.xi:
                robot = branch.alpha + share * way if share < 1.0 else end
                if share * distance > tried and self.leap(branch, robot):
                    branch.looked = share < 1.0  # farther on it has just failed
                    return
            if share == 1.0 and not alone and self.leave(branch):
                return

    def leave(self, branch: Branch) -> bool:
        """Targets on which the policy holds already leave the tree: each gets its own branch, there; returns whether there are any."""
        held = [name for name in branch.targets if self.look(branch, self.engine, self.goals[name])[0]]
        if not held:
            return False
        others = frozenset(branch.targets) - frozenset(held)
        for child in self.part(branch, [*(frozenset([name]) for name in held), *([others] if others else [])]):
            if child.targets[0] in held:
                goal = self.goals[child.targets[0]]
                self.move(child, goal, float(np.linalg.norm(goal - child.alpha)), trained=False)
        return True

    def leap(self, branch: Branch, robot: np.ndarray) -> bool:
        """Go to the robot (D,) at once if the policy holds there; remember it as a hope of the search if it succeeds sometimes."""
        held, success = self.look(branch, self.engine, robot)
        if held:
            self.move(branch, robot, float(np.linalg.norm(robot - branch.alpha)), trained=False)
        elif self.search is not None and success > self.config.signal:
            branch.hopes.append(robot)
        return held

    def look(self, branch: Branch, player: Player, robot: np.ndarray) -> tuple[bool, float]:
        """Whether the policy has the success on the robot (D,) that moving on there takes, and the success of its mean action."""
        wanted, enough, episodes = self.config.threshold, self.config.noisy_threshold, self.config.check_episodes
        success = self.sampler.success(branch, player, robot, wanted, episodes, look=True)
        held = success >= wanted and (
            not self.asks_noise(branch, robot)
            or self.sampler.success(branch, player, robot, enough, episodes, exploring=True) >= enough
        )
        return held, success

    def asks_noise(self, branch: Branch, robot: np.ndarray) -> bool:
        """Whether the exploring policy has to succeed on the robot (D,) as well: NPG learns from such successes in what follows."""
        last = any(np.linalg.norm(robot - self.goals[name]) < 1e-9 for name in branch.targets)
        return self.search is None and not (last and self.config.step == "adaptive")

    def choose_next(self, branch: Branch, meta: np.ndarray) -> None:
        """Pick the next robot on the way to ``meta`` (D,).

        Fixed steps go xi far. The search trains for the farthest hope, without one for the robot twice the last stride ahead, and halves
        that where it finds no success.
        Adaptive steps of plain NPG try twice the last stride and halve it until the policy holds, and what holds is taken at once; or until
        it succeeds often enough under noise to learn there, or xi is reached, and training begins. Where only noise stands in the way,
        there is less of it. The way has one direction per choice; an optimised one is estimated only once the meta robot itself is out of
        reach.
        """
        if branch.hopes:
            branch.begin_phase(branch.hopes.pop(0))
            return
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
            branch.begin_phase(candidate)
            if self.config.step == "fixed" or stride <= shortest or self.search is not None:
                return
            wanted, enough, episodes = self.config.threshold, self.config.noisy_threshold, self.config.check_episodes
            mean = self.sampler.success(branch, self.engine, candidate, wanted, episodes)
            if mean >= wanted and not self.asks_noise(branch, candidate):
                self.move(branch, candidate, stride, trained=False)
                return
            noisy = self.sampler.success(branch, self.engine, candidate, enough, episodes, exploring=True)
            while mean >= wanted and self.config.signal <= noisy < enough and self.weights.calm(branch):
                noisy = self.sampler.success(branch, self.engine, candidate, enough, episodes, exploring=True)
            if mean >= wanted and noisy >= enough:
                self.move(branch, candidate, stride, trained=False)
                return
            if noisy >= self.config.signal:
                self.weights.improve(branch, self.engine, candidate)  # it was measured just now
                return
            stride = max(stride / 2, shortest)

    def steer(self, branch: Branch, meta: np.ndarray) -> np.ndarray:
        """Unit vector (D,) of the way on: straight to ``meta``, or bent to where the policy earns more.

        The episodes that this takes train nothing but cost the same, and are counted as simulation epochs.
        """
        if self.config.path != "optimised":
            return (meta - branch.alpha) / np.linalg.norm(meta - branch.alpha)
        robots = sample_robots(branch.alpha, self.config.jacobian_episodes, self.config.xi, self.sampler.rng)
        seeds = np.repeat(self.sampler.training_seeds(-(-len(robots) // 2)), 2)[: len(robots)].tolist()
        policies = None if self.search is None else [branch.policy] * len(robots)
        batch = self.sampler.train(branch, self.engine, list(robots), seeds, policies)
        returns = np.array([episode.discounted_return(self.config.npg.gamma) for episode in batch])
        slope = jacobian(robots, returns)
        way = heading(slope, branch.alpha, meta, self.config.pull)
        straight = (meta - branch.alpha) / np.linalg.norm(meta - branch.alpha)
        self.sampler.say("steered", branch, mean_return=float(returns.mean()), slope=float(np.linalg.norm(slope)),
                         straight_share=float(way @ straight))  # fmt: skip
        return way

    def move(self, branch: Branch, alpha: np.ndarray, stride: float, trained: bool) -> None:
        """Line 5: the robot evolves."""
        branch.alpha, branch.stride, branch.looked, branch.hopes = np.clip(alpha, 0.0, 1.0), stride, False, []
        branch.width = min(self.config.search.regain * branch.width, 1.0)
        branch.begin_phase()
        distance = float(np.linalg.norm(self.evolution_tree(branch).meta_alpha - branch.alpha))
        self.sampler.say("moved", branch, stride=stride, distance=distance, trained=trained)

    def train_to(
        self, branch: Branch, player: Player, alpha: np.ndarray, wanted: float, episodes: int, exploring: bool = False
    ) -> Outcome:
        """One update towards ``wanted`` success of the mean action on the robot ``alpha`` (D,), and that which ``exploring`` needs.

        Returns:
            "held" if the policy has that success already, "spent" if the path's budget is, "stalled" if the search is to try a nearer
            robot, else "training".

        Success is measured before the first update, after every one of the search and after every check_every-th of NPG.
        """
        searching = self.search is not None and branch.turn != "weights"
        success = 0.0
        if searching or branch.updates % self.config.check_every == 0:
            hasty = self.search is not None and branch.next_alpha is not None
            floor = None if self.search is None or hasty else self.config.threshold  # at a target the better one is to be found
            success = self.sampler.success(branch, player, alpha, wanted, episodes, hasty=hasty, floor=floor)
            enough = self.config.noisy_threshold
            if success >= wanted and (
                not exploring or self.sampler.success(branch, player, alpha, enough, episodes, exploring=True) >= enough
            ):
                return "held"
            if self.search is None:
                _ = self.weights.calm(branch) if success >= wanted else self.weights.rouse(branch)
            else:
                outcome = self.keep_best(branch, success)
                if outcome != "training":
                    return outcome
        cost = self.costs[branch.path]
        if cost.sim_epochs >= self.config.path_budget:
            self.return_to_best(branch)
            self.sampler.say("budget", branch, sim_epochs=cost.sim_epochs)
            return "spent"
        if self.search is None or branch.turn == "weights":
            learned_from = self.weights.improve(branch, player, alpha)
            if self.search is not None and learned_from < self.config.signal and not self.weights.calm(branch, NUMBED):
                branch.idle = self.config.patience  # nothing to learn from, however little noise: the next measurement ends the turn
            return "training"
        first = branch.updates == 0
        learned = self.search.improve(branch, player, alpha, success, branch.best_success >= self.config.threshold)
        return "stalled" if first and not learned and self.nearer(branch) else "training"

    def keep_best(self, branch: Branch, success: float) -> Outcome:
        """Of the search: remember the policy if it is the phase's best; return to it and end a turn that brought no better one for long.

        Offsets come first, then responses and the weights, if the best succeeds often enough to learn from. On the way another robot is
        tried after that; a target where nothing brought more is left with the best, if that would do on the way.
        """
        better = branch.best is None or success > branch.best_success
        branch.idle = 0 if better else branch.idle + 1
        if better or success == branch.best_success:  # of equals the later one: it has learned from more
            branch.best, branch.best_success = branch.policy.copy(), success
        if branch.idle < self.config.patience:
            return "training"
        self.return_to_best(branch)
        branch.turns += 1
        turns = self.search.turns
        on_the_way, over = branch.next_alpha is not None, branch.turns >= len(turns)
        if on_the_way and (over or (self.nearer(branch) and branch.best_success < self.config.noisy_threshold)):
            return "stalled"
        branch.begin_turn(turns[branch.turns % len(turns)])
        if over and not on_the_way and branch.best_success >= self.config.threshold:
            self.sampler.say("kept", branch, success=branch.best_success)
            return "spent"
        return "training"

    def return_to_best(self, branch: Branch) -> None:
        """Take the policy that was measured best in this phase, where one was kept."""
        if branch.best is not None:
            branch.policy = branch.best.copy()

    def nearer(self, branch: Branch) -> bool:
        """Whether the search has a nearer robot to train for."""
        return bool(branch.hopes) or self.can_halve(branch)

    def can_halve(self, branch: Branch) -> bool:
        """Whether the search may train for a robot half as far."""
        return branch.next_alpha is not None and np.linalg.norm(branch.next_alpha - branch.alpha) >= 2 * self.config.xi

    # ---- what a run leaves -------------------------------------------------------------------------------------

    def checkpoint(self) -> None:
        """Everything the run needs to go on, in one atomic file."""
        tensors: dict[str, np.ndarray] = {}
        for i, branch in enumerate(self.pending):
            tensors |= branch.tensors(f"pending.{i}")
        for name, policy in self.arrived.items():
            tensors |= network_tensors(f"arrived.{name}", policy)
        sampler = self.sampler
        asking = {}
        if self.asking is not None:
            tensors |= self.asking.tensors()
            asking = {"asking": self.asking.state()}
        state = {
            "pending": [branch.state() for branch in self.pending], "arrived": list(self.arrived), "routes": self.routes,
            "records": sampler.records, "costs": {path: asdict(cost) for path, cost in self.costs.items()},
            "rng": generator_state(sampler.rng), "seconds": sampler.seconds, "spent": sampler.spent, **asking,
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
            found = tensors[f"pending.{i}.alpha"].size
            if found != size:
                raise ToolkitError(
                    f"{self.run.path}: its checkpoint has {found} evolution dimensions, this space {size}; "
                    "the robots have changed since; start a new run"
                )
            self.pending.append(stored_branch(tensors, f"pending.{i}", saved, model, critic))
        for name in state["arrived"]:
            self.arrived[name] = model.copy()
            load_network(tensors, f"arrived.{name}", self.arrived[name])
        if self.asking is not None:
            self.asking.restore(tensors, state["asking"], model, critic)
        sampler = self.sampler
        sampler.costs = {path: Cost(**cost) for path, cost in state["costs"].items()}
        self.routes, sampler.records = state["routes"], state["records"]
        sampler.rng = generator_from_state(state["rng"])
        sampler.earlier_seconds, sampler.spent = state["seconds"], state.get("spent", sampler.spent)
        self.run.truncate_metrics(sampler.records)

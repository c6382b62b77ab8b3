"""Meta-Evolve: a policy follows the evolution tree from the source robot to every target (Liu et al. 2024, Algorithm 1).

    meta_evolve     Algorithm 1: the loop over phases; the recursion is a list of branches
    evolve          lines 4 and 5: choose the next robot on the way, train until the policy holds on it, go there
    reach, settle   line 8: at F(beta) train to the goal, then hop to the unmodified robosuite robot
    split           lines 10 to 12: one branch per subtree

What it is made of: `way` (where paths lead), `look_ahead` and `stride` (the next robot), `training` (the policy), `race` (a tree that
asks), `frontier` (how far it all has come: a killed run continues from its checkpoint to the same result).
"""

import math
from collections.abc import Callable, Mapping
from concurrent.futures import FIRST_COMPLETED, ThreadPoolExecutor, wait
from threading import Event

import numpy as np

from tasks.sight import Sight
from toolkit.evolution import MetaStep, Terminal
from toolkit.evolution.bend import Bend
from toolkit.learning.episode import Episode
from toolkit.learning.exploration import Explored
from toolkit.learning.policy import GaussianPolicy, ValueFunction
from toolkit.runs.run import Run
from toolkit.transfer.asking import Asking
from toolkit.transfer.branch import Branch, Cost, Ledger, path_generator
from toolkit.transfer.events import Arrived, Entry, Spent
from toolkit.transfer.frontier import Frontier
from toolkit.transfer.learners import SearchLearner, WeightLearner
from toolkit.transfer.look_ahead import LOOKS, LookAhead
from toolkit.transfer.race import Race
from toolkit.transfer.sampling import Player, Players, Sampler
from toolkit.transfer.settings import TransferConfig
from toolkit.transfer.stride import Stride
from toolkit.transfer.training import Outcome, Training
from toolkit.transfer.way import Way


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
        report, on_batch: as for Sampler.
        explored: what the learner "search" explores, and how far.
        bends: targets behind an edge -> how it turns; the other edges are straight.
        sight: as for Sampler; None: all robots are seen as they are.
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
        report: Callable[[Entry, Branch], None] = lambda entry, branch: None,
        on_batch: Callable[[Branch, list[Episode], bool, list[GaussianPolicy]], None] = lambda branch, episodes, noise, policies: None,
        explored: Explored | None = None,
        bends: Mapping[frozenset[str], Bend] | None = None,
        sight: Callable[[np.ndarray], Sight] | None = None,
    ) -> None:
        self.config, self.run = config, run
        self.players = Players(engine, native)
        self.sampler = Sampler(run, report, on_batch, sight or (lambda alpha: Sight.plain(len(policy.observation_names))))
        self.way = Way(config, self.sampler, targets, bends or {})
        weights = WeightLearner(config, self.sampler, engine, source, policy.copy())
        search = None
        if config.learner == "search":
            search = SearchLearner(config, self.sampler, explored or Explored(np.zeros(0), np.zeros(0)))
        self.training = Training(config, self.sampler, weights, search)
        self.look_ahead = LookAhead(config, self.sampler, self.players, self.way)
        self.stride = Stride(config, self.sampler, engine, self.way, self.look_ahead, weights)
        if config.exploration is not None:
            policy = policy.copy()
            policy.set_log_std(np.full(len(policy.action_names), math.log(config.exploration)))
        root = Branch("path 1", source.alpha, [target.name for target in targets], policy, value, Ledger([source.name]),
                      path_generator(config.seed, "path 1"))
        self.race = None
        if config.kind == "asking":
            self.race = Race(config, Asking(config.metric, LOOKS, config.xi), self.sampler, self.way, self.look_ahead)
            self.race.asking.offer(root, root.ledger.route)
        self.frontier = Frontier(run, self.sampler, root, None if self.race is None else self.race.asking)

    # ---- Algorithm 1 -------------------------------------------------------------------------------------------

    def meta_evolve(self, at_once: int = 1) -> dict[str, GaussianPolicy]:
        """Transfer the policy to every target; returns target name -> policy.

        Args:
            at_once: how many paths are played side by side. The result is the same, bit for bit, as that of one after the other: a path
                has random numbers, counts and training seeds of its own. A tree that asks ignores it; see `race`.
        """
        if at_once > 1 and self.race is None:
            self._side_by_side(at_once)
        while self.frontier.pending:
            if self.race is not None and self.race.may_change(self.frontier.turn()):
                self.race.choose(self.frontier.pending)
            branch = self.frontier.turn()
            self.frontier.replace(branch, self.advance(branch))
        return {name: self.arrived[name] for name in self.way.goals}

    def _side_by_side(self, at_once: int) -> None:
        stop = Event()

        def follow(branch: Branch) -> list[Branch]:
            """Until it splits or arrives; where another has failed it stops between two turns, from which a resumed run goes on."""
            after = [branch]
            while after == [branch] and not stop.is_set():
                after = self.advance(branch)
                self.frontier.replace(branch, after)
            return after

        with ThreadPoolExecutor(at_once) as pool:
            running = {pool.submit(follow, branch) for branch in self.frontier.pending}
            try:
                while running:
                    ended, running = wait(running, return_when=FIRST_COMPLETED)
                    running |= {pool.submit(follow, branch) for future in ended for branch in future.result()}
            finally:
                stop.set()
                if running:
                    self.players.stop()  # what is under way is begun again by a resumed run

    def advance(self, branch: Branch) -> list[Branch]:
        """One turn of the loop; returns the branches that go on from here: itself, those into which it has split, or none at a target."""
        if branch.stage == "settle":
            return self.settle(branch)
        step = self.way.evolution_tree(branch)
        if not self.way.at(branch, step) and (branch.alone or not step.reached):
            return self.evolve(branch, step)
        if branch.alone:
            return self.reach(branch)
        # A target from which others go on is trained to its goal first (line 8): all behind it have the use of that.
        training = bool(step.reached) and self.train_to_goal(branch, self.players.engine) == "training"
        return [branch] if training else self.split(branch, step)

    def evolve(self, branch: Branch, step: MetaStep) -> list[Branch]:
        """Lines 4 and 5, towards the meta robot: choose the next robot, then train until the policy holds on it, and go there.

        A path whose budget is spent leaps to its end, where what it has reached is measured.
        """
        direct = self.config.kind == "direct"
        goal = step.meta_alpha if direct else self.way.ahead(branch, step)
        distance = float(np.linalg.norm(goal - branch.alpha))
        if direct:
            self.way.move(branch, goal, distance, trained=False)
        elif branch.ledger.cost.sim_epochs >= self.config.path_budget:
            branch.return_to_best()
            self.sampler.say(Spent(reach=distance), branch)
            self.way.move(branch, goal, branch.stride, trained=False)
        elif branch.next_alpha is not None:
            self.train_for_next(branch, branch.next_alpha, step)
        elif self.config.step == "adaptive" and not branch.looked:
            return self.look_ahead.look_ahead(branch, step)
        else:
            self.stride.choose(branch, goal)
        return [branch]

    def train_for_next(self, branch: Branch, robot: np.ndarray, step: MetaStep) -> None:
        """One update for the next robot (D,); go there once the policy holds on it, or farther on once it holds there before."""
        trained = self.training.search is not None and branch.updates > 0
        wanted = max(self.config.threshold, self.config.firm) if trained else self.config.threshold
        outcome = self.training.train_to(branch, self.players.engine, robot, wanted, self.config.check_episodes,
                                         exploring=self.look_ahead.asks_noise(branch, robot))
        if outcome == "held":
            self.way.move(branch, robot, float(np.linalg.norm(robot - branch.alpha)), trained=True)
            return
        ended = outcome == "turned" or (outcome == "stalled" and branch.turns > 0)
        if ended and self.look_ahead.look_farther(branch, robot, step):
            return
        if outcome == "turned":
            outcome = self.training.learn(branch, self.players.engine, robot, branch.best_success)
        if outcome == "stalled":
            self.stride.try_nearer(branch, self.way.ahead(branch, step))

    def split(self, branch: Branch, step: MetaStep) -> list[Branch]:
        """Lines 10 to 12: one branch per subtree; targets reached get their own."""
        if self.race is not None:
            self.race.asking.offer(branch, [*branch.ledger.route, "meta"])
        return self.way.part(branch, [*step.partition, *(frozenset([name]) for name in step.reached)])

    def reach(self, branch: Branch) -> list[Branch]:
        """Line 8: F(beta) is reached. Train there to the goal, then hop to the native robot.

        The search trains on the native robot at once: that is where success is claimed.
        """
        hops = self.config.native and self.players.hops(branch)
        if not (hops and self.config.learner == "search") and self.train_to_goal(branch, self.players.engine) == "training":
            return [branch]
        branch.begin_phase()
        if not hops:
            return self.finish(branch)
        branch.stage = "settle"
        return [branch]

    def settle(self, branch: Branch) -> list[Branch]:
        """The last hop: from F(beta) to the unmodified robosuite robot, trained and counted like any other phase."""
        return [branch] if self.train_to_goal(branch, self.players.native(branch)) == "training" else self.finish(branch)

    def train_to_goal(self, branch: Branch, player: Player) -> Outcome:
        """One update towards the goal at the target that the branch has reached."""
        return self.training.train_to(branch, player, self.way.goal(branch), self.config.goal, self.config.goal_episodes)

    def finish(self, branch: Branch) -> list[Branch]:
        """The branch's policy is the answer for its target; nothing goes on from here."""
        name = branch.targets[0]
        self.frontier.arrive(name, self.sampler.own(branch.policy, self.way.goal(branch)))
        branch.ledger.route.append(name)
        if self.race is not None:
            self.race.overtake(branch, self.frontier.pending)
        self.sampler.say(Arrived(target=name), branch)
        return []

    # ---- what others ask of it ---------------------------------------------------------------------------------

    def restore(self) -> None:
        """Continue from the run's checkpoint, if it has one; see Frontier."""
        self.frontier.restore()

    @property
    def pending(self) -> list[Branch]:
        """Branches under way; the last is played."""
        return self.frontier.pending

    @property
    def arrived(self) -> dict[str, GaussianPolicy]:
        """Target -> its policy."""
        return self.frontier.arrived

    @property
    def costs(self) -> dict[str, Cost]:
        """Path -> what it has cost."""
        return {path: ledger.cost for path, ledger in self.frontier.ledgers.items()}

    @property
    def routes(self) -> dict[str, list[str]]:
        """Path -> names of the robots at its ends."""
        return {path: ledger.route for path, ledger in self.frontier.ledgers.items()}

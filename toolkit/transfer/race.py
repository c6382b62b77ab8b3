"""Of a tree that asks: which path is played next, and from where; costly ones race another that sets out from the source.

Such a transfer is one path after the other by its nature: where the next one leaves from depends on what all the others have reached,
and at what cost. What it decides is a function of that alone, so that the same seed makes the same run.
"""

import numpy as np

from toolkit.transfer.asking import Asking
from toolkit.transfer.branch import Branch, Ledger, path_generator
from toolkit.transfer.events import Left, Overtaken, Split
from toolkit.transfer.look_ahead import LookAhead
from toolkit.transfer.sampling import Sampler
from toolkit.transfer.settings import TransferConfig
from toolkit.transfer.way import Way


class Race:
    """Orders the branches of a tree that asks.

    Args:
        config: see TransferConfig.
        asking: what the robots reached have answered.
        sampler: tells.
        way: where paths lead.
        look_ahead: looks for the answers.
    """

    def __init__(self, config: TransferConfig, asking: Asking, sampler: Sampler, way: Way, look_ahead: LookAhead) -> None:
        self.config, self.asking, self.sampler, self.way, self._look_ahead = config, asking, sampler, way, look_ahead

    def may_change(self, branch: Branch) -> bool:
        """Whether another branch may be played now: this one is new, or has used its allowance on its way to a target."""
        alone = branch.alone and branch.stage == "evolve"
        return branch.began is None or (alone and branch.ledger.cost.sim_epochs >= branch.allowance)

    def choose(self, pending: list[Branch]) -> None:
        """Put the branch that is to be played last: one that waits if there is any, else a rival of the last, or the most promising."""
        if any(branch.began is None for branch in pending):
            self._choose_waiting(pending)
            return
        branch = pending[-1]
        if branch.targets[0] not in self.asking.raced and branch.ledger.route != self.asking.origins[0].route:
            pending.append(self._rival(branch))
            return
        promises = {
            index: self.asking.promise(other, self.way.goal(other), other.ledger.cost.sim_epochs)
            for index, other in enumerate(pending) if other.alone
        }
        branch = pending.pop(min(promises, key=lambda index: promises[index]))
        branch.allowance = 2 * max(branch.ledger.cost.sim_epochs, self.config.allowance)
        pending.append(branch)

    def begin(self, branch: Branch) -> None:
        """A branch has its first turn."""
        branch.began = self.asking.distance(branch.alpha, self.way.evolution_tree(branch).meta_alpha)
        branch.allowance = branch.ledger.cost.sim_epochs + self.config.allowance

    def overtake(self, winner: Branch, pending: list[Branch]) -> None:
        """A target is reached, which can be left from now; others on their way to it are given up."""
        self.asking.offer(winner, winner.ledger.route)
        for rival in [other for other in pending if other.targets == winner.targets and other is not winner]:
            pending.remove(rival)
            self.sampler.say(Overtaken(by=winner.path), rival)

    def _choose_waiting(self, pending: list[Branch]) -> None:
        """Of those that wait the branch with the least left to its meta robot; a target to which some policy leaves less goes first, from
        there."""
        choices: list[tuple[float, int, str | None]] = []
        for index, branch in enumerate(pending):
            if branch.began is not None:
                continue
            step = self.way.evolution_tree(branch)
            end = self.way.ahead(branch, step)
            own = self.asking.left(branch, None if end is step.meta_alpha else end, step.meta_alpha, self._look_ahead.holds)
            choices.append((own, index, None))
            for name in branch.targets if own > 0 else ():
                leap = self.asking.best(branch, name, self.way.goals[name], self._look_ahead.holds)
                choices.append((leap.left, index, name))
        _, index, apart = min(choices, key=lambda choice: choice[0])
        branch = pending.pop(index)
        if apart is not None and not branch.alone:
            parted = self.way.part(branch, [frozenset(branch.targets) - {apart}, frozenset([apart])])
            branch = next(child for child in parted if child.targets == [apart])
            pending += [child for child in parted if child is not branch]
        pending.append(branch)
        if apart is not None:
            self._leave_from(branch)
        self.begin(branch)

    def _rival(self, branch: Branch) -> Branch:
        """Beside a path to a target that costs much another sets out, straight from the source."""
        source = self.asking.origins[0]
        path = f"{branch.path}.0"
        rival = Branch(path, source.alpha, list(branch.targets), source.policy.copy(), source.value.copy(), Ledger(list(source.route)),
                       path_generator(self.config.seed, path), noise=source.noise, strayed=True)
        self.asking.raced.append(branch.targets[0])
        self.sampler.say(Split(parent="path 1", targets=branch.targets[0], rival=branch.path), rival)
        self.begin(rival)
        return rival

    def _leave_from(self, branch: Branch) -> None:
        """Take the branch's only target up from the robot that answered best, at where its policy holds."""
        name, goal = branch.targets[0], self.way.goal(branch)
        leap = self.asking.leaps[name]
        origin = self.asking.origins[leap.origin]
        branch.strayed = bool(np.linalg.norm(origin.alpha - branch.alpha) > 1e-9)
        branch.alpha, branch.policy, branch.value = origin.alpha, origin.policy.copy(), origin.value.copy()
        branch.noise, branch.width = origin.noise, 1.0
        branch.ledger.route = list(origin.route)
        self.sampler.say(Left(origin=origin.route[-1], target=name, share=leap.share, left=leap.left), branch)
        robot = goal if leap.share == 1.0 else origin.alpha + leap.share * (goal - origin.alpha)
        self.way.move(branch, robot, float(np.linalg.norm(robot - origin.alpha)), trained=False)

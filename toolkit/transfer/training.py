"""One phase of training: measure, learn, and say when the policy holds, when its budget is spent, when another robot should be tried.

    Training.train_to   one update towards a success on one robot, by whichever learner has its turn
    Training.learn      the update itself
    Training.keep_best  the search's turns: offsets, gains, responses, the weights, and back to the best policy after each
    Training.measure_anew  what was chosen by its success on starts by which it was not chosen
    Training.leave      a target where all turns are over, or not yet
"""

from typing import Literal

import numpy as np

from toolkit.transfer.branch import Branch
from toolkit.transfer.events import Kept, Spent
from toolkit.transfer.learners import SearchLearner, WeightLearner
from toolkit.transfer.sampling import Player, Sampler
from toolkit.transfer.settings import TransferConfig

NUMBED = 1 / 2
"""Factor on the noise where hardly an episode succeeds under it, in the weights' turn of a search or where the mean action holds."""

FIRMER = 2
"""Measurements without a better success after which a robot on the way is left, where the policy holds, if not as firmly as asked."""

Outcome = Literal["held", "kept", "spent", "training", "turned", "over", "stalled"]
"""Of an update: the policy has the success asked for; nothing brings more and it is enough; the path's budget is spent; none yet, nor
when on the way a turn has ended before anything was learned, nor when all turns on a target are over; a nearer robot should be tried."""


class Training:
    """Trains branches.

    Args:
        config: see TransferConfig.
        sampler: plays and counts.
        weights: learns by NPG.
        search: learns by the search; None: it is not used.
    """

    def __init__(self, config: TransferConfig, sampler: Sampler, weights: WeightLearner, search: SearchLearner | None) -> None:
        self.config, self.sampler, self.weights, self.search = config, sampler, weights, search
        self._turns = () if search is None else search.turns

    def train_to(
        self, branch: Branch, player: Player, alpha: np.ndarray, wanted: float, episodes: int, exploring: bool = False
    ) -> Outcome:
        """One update towards ``wanted`` success of the mean action on the robot ``alpha`` (D,), and that which ``exploring`` needs.

        Success is measured before the first update, after every one of the search and after every check_every-th of NPG; a policy that
        was trained until it reached what is wanted of a target has to show enough of it anew.
        """
        searching = self.search is not None and branch.turn != "weights"
        success = 0.0
        if searching or branch.updates % self.config.check_every == 0:
            hasty = self.search is not None and branch.next_alpha is not None
            # At a target the better one is to be found, and on the way whether it is enough to go on.
            floor = None if self.search is None or (hasty and wanted <= self.config.threshold) else self.config.threshold
            success = self.sampler.success(branch, player, alpha, wanted, episodes, hasty=hasty, floor=floor)
            held = success >= wanted
            asked = held and branch.next_alpha is None and branch.updates > 0
            if asked:
                success = self.measure_anew(branch, player, alpha, wanted, episodes)
                held = success >= self.config.enough
            enough = self.config.noisy_threshold
            if held and (not exploring or self.sampler.success(branch, player, alpha, enough, episodes, exploring=True) >= enough):
                return "held"
            if self.search is None:
                if success >= wanted:
                    self.weights.calm(branch)
                elif not branch.numb:
                    self.weights.rouse(branch)
                branch.best_success = success
                if self._in_vain(branch):
                    return "turned"
            else:
                outcome = self.keep_best(branch, success)
                if outcome == "over":
                    outcome = self.leave(branch, self.measure_anew(branch, player, alpha, wanted, episodes, again=asked))
                if outcome != "training":
                    return outcome
        return self.learn(branch, player, alpha, success)

    def learn(self, branch: Branch, player: Player, alpha: np.ndarray, success: float) -> Outcome:
        """One update on the robot ``alpha`` (D,), where the policy was measured to have that ``success``."""
        if branch.ledger.cost.sim_epochs >= self.config.path_budget:
            branch.return_to_best()
            self.sampler.say(Spent(), branch)
            return "spent"
        # The search's last turn may have begun just now.
        if self.search is None or branch.turn == "weights":
            starved = self.weights.improve(branch, player, alpha) < self.config.signal
            if self.search is None:
                # Where the mean action fails as well, more noise is what may bring a first success.
                branch.numb = starved and branch.best_success >= self.config.noisy_threshold
                if branch.numb:
                    self.weights.calm(branch, NUMBED)
            else:
                branch.numb = starved and not self.weights.calm(branch, NUMBED)
                if branch.numb:
                    branch.idle = self.config.patience  # nothing to learn from, however little noise: the next measurement ends the turn
            return "training"
        first = branch.updates == 0
        learned = self.search.improve(branch, player, alpha, success, branch.best_success >= self.config.threshold)
        return "stalled" if first and not learned and self._nearer(branch) else "training"

    def _in_vain(self, branch: Branch) -> bool:
        """Of NPG on the way by adaptive steps: whether so many measurements were in vain that it should be asked elsewhere, too."""
        if branch.next_alpha is None or self.config.step == "fixed" or branch.updates == 0:
            return False
        branch.idle = (branch.idle + 1) % self.config.patience
        return branch.idle == 0

    def keep_best(self, branch: Branch, success: float) -> Outcome:
        """Of the search: remember the policy if it is the phase's best; return to it and end a turn that brought no better one for long.

        Offsets come first, then gains, responses and the weights, if the best succeeds often enough to learn from. On the way other
        robots are asked after every turn, and another one is tried after the last; a target is measured anew.
        """
        better = branch.best is None or success > branch.best_success
        branch.idle = 0 if better else branch.idle + 1
        # Of equals the later one: it has learned from more. The search has not where it fails, NPG has on the window's nearer robots.
        if better or (success == branch.best_success and (success > 0 or branch.turn == "weights")):
            branch.best, branch.best_success = branch.policy.copy(), success
        on_the_way = branch.next_alpha is not None
        enough = on_the_way and self.config.firm > self.config.threshold <= branch.best_success
        if branch.idle < (FIRMER if enough else self.config.patience):
            return "training"
        branch.return_to_best()
        if enough:
            return "held"
        branch.turns += 1
        over = branch.turns >= len(self._turns)
        if on_the_way and (over or (self._nearer(branch) and branch.best_success < self.config.noisy_threshold)):
            return "stalled"
        branch.begin_turn(self._turns[branch.turns % len(self._turns)])
        return "turned" if on_the_way else "over" if over else "training"

    def measure_anew(
        self, branch: Branch, player: Player, alpha: np.ndarray, wanted: float, episodes: int, again: bool = False
    ) -> float:
        """Success of the policy on a target, on ``episodes`` starts of their own; ``again``: for the second time after the same update.

        The best of many measurements on the same starts is partly luck, the more of them the more; so starts that were asked once have
        taken part in the choice.
        """
        return self.sampler.success(branch, player, alpha, wanted, episodes, floor=0.0, choice=-branch.updates if again else branch.updates)

    def leave(self, branch: Branch, success: float) -> Outcome:
        """After all turns on a target, where its best policy was measured anew to have that ``success``.

        If that is enough, the target is left with it. If not, the weights go on for as long as the budget lasts, where there is enough to
        learn from, also under noise; else the turns begin again.
        """
        branch.best_success = success
        if success >= self.config.enough:
            self.sampler.say(Kept(success=success), branch)
            return "kept"
        if success >= self.config.noisy_threshold and not branch.numb:
            branch.begin_turn("weights")
        return "training"

    def _nearer(self, branch: Branch) -> bool:
        """Whether the search has a nearer robot to train for."""
        return bool(branch.hopes) or branch.can_halve(self.config.xi)

"""Whether a policy already holds farther on: at the end of its way, at the targets behind, at robots in between."""

import numpy as np

from toolkit.evolution import MetaStep
from toolkit.transfer.branch import Branch
from toolkit.transfer.sampling import Player, Players, Sampler
from toolkit.transfer.settings import TransferConfig
from toolkit.transfer.way import Way

LOOKS = (1.0, 0.75, 0.5, 0.25, 0.125)
"""Shares of the way ahead at which is looked when a phase begins, and when a turn of it was in vain, the farthest first: success is not
monotone along a way, so a failure says nothing of the robots behind it."""


class LookAhead:
    """Looks along the ways of a transfer, and leaps to where its policies hold.

    Args:
        config: see TransferConfig.
        sampler: plays and counts.
        players: who plays.
        way: where paths lead.
    """

    def __init__(self, config: TransferConfig, sampler: Sampler, players: Players, way: Way) -> None:
        self.config, self.sampler, self.players, self.way = config, sampler, players, way
        self._searching = config.learner == "search"

    def look_ahead(self, branch: Branch, step: MetaStep) -> list[Branch]:
        """Go at once to the farthest robot on which the policy holds already, if there is any.

        First the unmodified robot of an only target, then the end of the way, its corner, the targets behind it, and robots in between.
        For plain NPG these are only robots beyond the stride that `Stride.choose` tries anyway. The search begins at once where the policy
        succeeds in half of a look; else at the end of the way, whatever it did there, and remembers where it succeeds at least sometimes,
        for when it finds nothing at the end.

        Returns:
            the branch, or the branches into which it parts where some of its targets hold already.
        """
        end = self.way.ahead(branch, step)
        way = end - branch.alpha
        distance = float(np.linalg.norm(way))
        branch.looked, branch.hopes = True, []
        if self.config.native and self.players.hops(branch):
            branch.stage = "settle"
            goal = self.way.goal(branch)
            held, _ = self.look(branch, self.players.native(branch), goal)
            branch.stage = "evolve"
            if held:
                self.way.move(branch, goal, distance, trained=False)
                branch.stage = "settle"
                return [branch]
        tried = 0.0 if self._searching else 2 * branch.stride
        if end is not step.meta_alpha and self._leap(branch, step.meta_alpha)[0]:
            return [branch]
        for share in LOOKS:
            robot, success = branch.alpha + share * way if share < 1.0 else end, 0.0
            if share == 1.0 or share * distance >= self.config.xi:
                held, success = self._leap(branch, robot) if share * distance > tried else (False, 0.0)
                if held:
                    branch.looked = share < 1.0  # farther on it has just failed
                    return [branch]
            if share == 1.0 and not branch.alone:
                parted = self._leave(branch, step)
                if parted:
                    return parted
            if self._searching and success >= self.config.noisy_threshold:
                branch.begin_phase(robot)
                return [branch]
        if self._searching:
            # One batch of it costs less than the rest of the way from any nearer robot, and finds what no mean action shows.
            branch.begin_phase(end)
        return [branch]

    def look_farther(self, branch: Branch, robot: np.ndarray, step: MetaStep) -> bool:
        """Go to the farthest robot beyond ``robot`` (D,), for which it is being trained, on which the policy holds; if there is none,
        train for the one on which it succeeds most often, if that is more often than on ``robot``.

        What was learned for a robot that cannot do much may do on better ones behind it, and where the way turns a corner, on the straight
        way as well.

        Returns:
            whether it goes elsewhere now.
        """
        reach, end = float(np.linalg.norm(robot - branch.alpha)), self.way.ahead(branch, step)
        most, better = max(branch.best_success, self.config.noisy_threshold), None
        for last in (end,) if end is step.meta_alpha else (step.meta_alpha, end):
            distance = float(np.linalg.norm(last - branch.alpha))
            for share in LOOKS:
                if share * distance > reach + self.config.xi:
                    candidate = branch.alpha + share * (last - branch.alpha) if share < 1.0 else last
                    held, success = self.look(branch, self.players.engine, candidate)
                    if held:
                        self.way.move(branch, candidate, share * distance, trained=True)
                        return True
                    if success > most:
                        most, better = success, candidate
        if better is None:
            return False
        branch.begin_phase(better)
        return True

    def holds(self, branch: Branch, robot: np.ndarray) -> bool:
        """Whether the policy has the success on F(alpha) at the robot (D,) that moving on there takes."""
        return self.look(branch, self.players.engine, robot)[0]

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
        last = any(np.linalg.norm(robot - self.way.goals[name]) < 1e-9 for name in branch.targets)
        return not self._searching and not (last and self.config.step == "adaptive")

    def _leave(self, branch: Branch, step: MetaStep) -> list[Branch]:
        """Targets on which the policy holds already leave the tree: each gets its own branch, there; none: there are no such targets.

        One through which the others' way leads stays: what is learned there serves them all.
        """
        apart = [name for name in branch.targets if np.linalg.norm(self.way.goals[name] - step.meta_alpha) >= 1e-9]
        held = [name for name in apart if self.holds(branch, self.way.goals[name])]
        if not held:
            return []
        others = frozenset(branch.targets) - frozenset(held)
        children = self.way.part(branch, [*(frozenset([name]) for name in held), *([others] if others else [])])
        for child in children:
            if child.targets[0] in held:
                goal = self.way.goal(child)
                self.way.move(child, goal, float(np.linalg.norm(goal - child.alpha)), trained=False)
        return children

    def _leap(self, branch: Branch, robot: np.ndarray) -> tuple[bool, float]:
        """Go to the robot (D,) at once if the policy holds there; remember it as a hope of the search if it succeeds sometimes.

        Returns:
            whether it went there, and the success of its mean action.
        """
        held, success = self.look(branch, self.players.engine, robot)
        if held:
            self.way.move(branch, robot, float(np.linalg.norm(robot - branch.alpha)), trained=False)
        elif self._searching and success > self.config.signal:
            branch.hopes.append(robot)
        return held, success

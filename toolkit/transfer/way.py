"""Where a path leads, how it gets on, and where it parts: the evolution tree from where a branch stands."""

from collections.abc import Mapping, Sequence

import numpy as np

from toolkit.evolution import MetaStep, Terminal, next_meta_robot
from toolkit.evolution.bend import Bend
from toolkit.transfer.branch import Branch
from toolkit.transfer.events import Moved, Split
from toolkit.transfer.sampling import Sampler
from toolkit.transfer.settings import TransferConfig


class Way:
    """The ways of a transfer.

    Args:
        config: see TransferConfig.
        sampler: tells of moves and splits.
        targets: where all paths lead.
        bends: targets behind an edge -> how it turns; the other edges are straight.

    Attributes:
        goals: target -> its alpha (D,).
    """

    def __init__(
        self, config: TransferConfig, sampler: Sampler, targets: Sequence[Terminal], bends: Mapping[frozenset[str], Bend]
    ) -> None:
        self.config, self._sampler, self._bends = config, sampler, bends
        self.goals = {target.name: target.alpha for target in targets}

    def goal(self, branch: Branch) -> np.ndarray:
        """The branch's only target (D,); of a branch to several, the one on which it stands."""
        return self.goals[branch.targets[0]] if branch.alone else branch.alpha

    def evolution_tree(self, branch: Branch) -> MetaStep:
        """Algorithm 2 from the current robot."""
        targets = [Terminal(name, self.goals[name]) for name in branch.targets]
        return next_meta_robot(Terminal("current", branch.alpha), targets, self.config.metric, self.config.tree_kind)

    def ahead(self, branch: Branch, step: MetaStep) -> np.ndarray:
        """Where the way to the meta robot goes straight from here (D,): to its corner, or to the meta robot."""
        bend = None if branch.strayed else self._bends.get(frozenset(branch.targets))
        turn = None if bend is None else bend.ahead(branch.alpha, step.meta_alpha)
        return step.meta_alpha if turn is None else turn

    def at(self, branch: Branch, step: MetaStep) -> bool:
        """Whether the branch stands at its meta robot (the loop's condition)."""
        return bool(np.linalg.norm(step.meta_alpha - branch.alpha) < 1e-9)

    def move(self, branch: Branch, alpha: np.ndarray, stride: float, trained: bool) -> None:
        """Line 5: the robot evolves to ``alpha`` (D,), by a step of that length; ``trained``: the policy was, for that robot."""
        branch.alpha, branch.stride, branch.looked, branch.hopes = np.clip(alpha, 0.0, 1.0), stride, False, []
        branch.width = min(self.config.search.regain * branch.width, 1.0)
        branch.begin_phase()
        distance = float(np.linalg.norm(self.evolution_tree(branch).meta_alpha - branch.alpha))
        self._sampler.say(Moved(stride=stride, distance=distance, trained=trained), branch)

    def part(self, branch: Branch, parts: Sequence[frozenset[str]]) -> list[Branch]:
        """The branches into which one parts, one per set of targets."""
        children = branch.split(parts, self.config.seed)
        for child in children:
            self._sampler.say(Split(parent=branch.path, targets=" ".join(child.targets)), child)
        return children

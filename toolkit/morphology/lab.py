"""Source and targets merged in one evolution space: what matching, trees, audits and transfers begin with."""

from collections.abc import Sequence

from robots.robot import Robot
from tasks.pick import PickTask
from toolkit.errors import ToolkitError
from toolkit.evolution import EvolutionTree, Kind, Metric, Terminal, evolution_tree
from toolkit.morphology.build import MergedRobot
from toolkit.morphology.matching import match
from toolkit.morphology.space import EvolutionSpace


def check_roles(source: Robot, targets: Sequence[Robot]) -> None:
    """Refuse a source among the targets, a target named twice, and no targets."""
    names = [robot.name for robot in targets]
    if source.name in names:
        raise ToolkitError(f"{source.name!r} is both source and target; leave it out of the targets")
    if not names or len(set(names)) != len(names):
        raise ToolkitError(f"targets are {', '.join(names) or 'none'}; name each once, and at least one")


class Lab:
    """The merged robot of a job's robots, in its task, with its evolution space.

    Args:
        source, targets, task: as in Job.

    Raises:
        ToolkitError: the source is among the targets, a robot is named twice, or the merged robot does not compile.
    """

    def __init__(self, source: Robot, targets: Sequence[Robot], task: PickTask) -> None:
        check_roles(source, targets)
        self.source, self.targets, self.task = source, tuple(targets), task
        self.space = EvolutionSpace(match([source, *targets]))
        self.merged = MergedRobot(self.space, task)

    def terminals(self) -> tuple[Terminal, list[Terminal]]:
        """Source and targets as points of the evolution space."""
        points = [Terminal(name, self.space.beta(name)) for name in self.space.matching.names]
        return points[0], points[1:]

    def tree(self, metric: Metric, kind: Kind) -> EvolutionTree:
        """The evolution tree from the source to the targets."""
        source, targets = self.terminals()
        return evolution_tree(source, targets, metric, kind)

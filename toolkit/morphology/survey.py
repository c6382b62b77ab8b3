"""Which robots go together: the cost of the evolution tree for other arms under the source's hand, and for more and more targets.

All robots of a survey lie in one evolution space, so that their trees are measured with one yardstick.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

from robots.model_robot import ModelRobot
from robots.robot import Robot
from tasks.task import ModelTask, Task
from toolkit.errors import ToolkitError
from toolkit.evolution import EvolutionTree, Metric, Terminal, evolution_tree
from toolkit.morphology.family import FamilySpace
from toolkit.morphology.lab import System, check_players
from toolkit.morphology.matching import match
from toolkit.morphology.space import EvolutionSpace


@dataclass(frozen=True)
class Cost:
    """What a tree costs.

    Attributes:
        source: name of the source.
        arm: robosuite's name of the source's arm; empty where the source is a point of a file.
        targets: names of the targets.
        length: of the shortest tree [alpha].
        independent_length: of one path per target [alpha].
        ratio: independent_length / length, the saving that the tree promises.
        optimal: the tree is proven shortest.
    """

    source: str
    arm: str
    targets: tuple[str, ...]
    length: float
    independent_length: float
    ratio: float
    optimal: bool

    @classmethod
    def of(cls, tree: EvolutionTree, arm: str = "") -> "Cost":
        """The cost of a tree."""
        targets = tuple(node.name for node in tree.nodes if node.kind == "target")
        return cls(tree.nodes[0].name, arm, targets, tree.length, tree.independent_length, tree.ratio, tree.optimal)


def as_points(robots: Sequence[System], task: Task | None = None) -> list[Terminal]:
    """Robots as points of the one evolution space that they span, a family's in its task; the first is the source."""
    if task is not None:
        check_players(robots, task)
    space: FamilySpace | EvolutionSpace
    if isinstance(task, ModelTask):
        space = FamilySpace([robot for robot in robots if isinstance(robot, ModelRobot)], task)
    else:
        space = EvolutionSpace(match([robot for robot in robots if isinstance(robot, Robot)]))
    return [Terminal(name, space.beta(name)) for name in space.names]


def hand_on_arms(source: Robot, targets: Sequence[Robot]) -> list[Robot]:
    """The source, and its hand on every other arm among the targets, standing and posed as the target that brings the arm."""
    found = {source.arm: source}
    for robot in targets:
        if robot.arm not in found:
            name = f"{source.gripper.name}_on_{robot.name}"
            found[robot.arm] = replace(
                source, name=name, arm=robot.arm, base_position=robot.base_position, posture_seed=robot.posture_seed,
                datasheet=robot.datasheet,
            )
    return list(found.values())


def compare_arms(source: Robot, targets: Sequence[Robot], metric: Metric) -> list[Cost]:
    """Cost of the tree for the source's hand on each arm, cheapest first: which arm the expert should be trained on."""
    choices = hand_on_arms(source, targets)
    points = {point.name: point for point in as_points([*choices, *targets])}
    goals = [points[robot.name] for robot in targets]
    costs = [Cost.of(evolution_tree(points[robot.name], goals, metric), robot.arm) for robot in choices]
    return sorted(costs, key=lambda cost: cost.length)


def growth(source: Terminal, targets: Sequence[Terminal], metric: Metric) -> list[Cost]:
    """Cost of the tree as the targets join one by one, in the order given."""
    if not targets:
        raise ToolkitError("there are no targets to add one by one; name at least one")
    return [Cost.of(evolution_tree(source, targets[:count], metric)) for count in range(1, len(targets) + 1)]

"""Source and targets merged in one evolution space: what matching, trees, audits and transfers begin with."""

from collections.abc import Sequence
from functools import cached_property

import numpy as np

from grippers.gripper import COMMANDED_ROLES
from robots.model_robot import ModelRobot
from robots.robot import Robot
from tasks.pick import START_ROTATION, PickTask
from tasks.sight import Sight
from tasks.task import ModelTask, Task
from toolkit.errors import ToolkitError
from toolkit.evolution import EvolutionTree, Kind, Metric, Terminal, evolution_tree
from toolkit.io.quoting import told
from toolkit.morphology.build import MergedRobot
from toolkit.morphology.family import FamilySpace, MergedModel
from toolkit.morphology.matching import match
from toolkit.morphology.space import EvolutionSpace

System = Robot | ModelRobot
"""An arm with a gripper, or a change of a family's model."""
Merged = MergedRobot | MergedModel
"""Any robot between source and targets, in its task."""


def check_roles(source: System, targets: Sequence[System]) -> None:
    """Refuse a source among the targets, a target named twice, and no targets."""
    names = [robot.name for robot in targets]
    if source.name in names:
        raise ToolkitError(f"{source.name!r} is both source and target; leave it out of the targets")
    if not names or len(set(names)) != len(names):
        raise ToolkitError(f"targets are {', '.join(names) or 'none'}; name each once, and at least one")


def check_players(robots: Sequence[System], task: Task) -> None:
    """Refuse a robot that cannot play a task: an arm where a family plays, another family, a hand without an arm at the table."""
    for robot in robots:
        if isinstance(task, ModelTask):
            plays, players = isinstance(robot, ModelRobot) and robot.family.name == task.family, f"robots of the family {task.family}"
        else:
            plays, players = isinstance(robot, Robot), "arms with grippers"
        if not plays:
            raise ToolkitError(f"robot {robot.name!r} cannot play task {task.name!r}, which is for {players}; see who plays what: "
                               f"{told('robots')}")


class Lab:
    """The merged robot of a job's robots, in its task, with its evolution space.

    Args:
        source, targets, task: as in Job.

    Raises:
        ToolkitError: the source is among the targets, a robot is named twice, or the merged robot does not compile.
    """

    space: EvolutionSpace | FamilySpace
    merged: Merged

    def __init__(self, source: System, targets: Sequence[System], task: Task) -> None:
        check_roles(source, targets)
        robots = [source, *targets]
        check_players(robots, task)
        self.source, self.targets, self.task = source, tuple(targets), task
        if isinstance(task, ModelTask):
            self.space = FamilySpace([robot for robot in robots if isinstance(robot, ModelRobot)], task)
            self.merged = MergedModel(self.space, task)
        elif isinstance(task, PickTask):
            self.space = EvolutionSpace(match([robot for robot in robots if isinstance(robot, Robot)]))
            self.merged = MergedRobot(self.space, task)
        else:
            raise ToolkitError(f"task {task.name!r} is neither a pick nor a task on one model (tasks/task.py), and F knows no other")

    def terminals(self) -> tuple[Terminal, list[Terminal]]:
        """Source and targets as points of the evolution space."""
        points = [Terminal(name, self.space.beta(name)) for name in self.space.names]
        return points[0], points[1:]

    def sight(self, alpha: np.ndarray, retargeted: bool = True) -> Sight:
        """How a policy of the source sees the robot ``alpha`` (D,); an arm with a gripper is not seen as it is.

        Fingers need not hold an object where the grasp frame's origin is, so that the object is seen from as much farther along the closing
        axis as the source's fingers hold it (world axes at the start rotation): a policy grasps it where these fingers do. ``retargeted``,
        finger joints are seen where the source's would be. A policy knows by them how far its hand has closed, and a gripper has few of a
        hand's: each is seen as much farther as the source's goes farther when it closes on the reference box, in proportion to the
        progress of closing. What an object, or a slip, does to the joints that are there is added to that and seen as it is.
        """
        record, sight = self.task.observation, Sight.plain(self.task.observation.size)
        if not isinstance(self.merged, MergedRobot) or not isinstance(self.source, Robot):
            return sight
        farther = self.merged.space.theta(alpha)["grasp_offset"][0, 0] - self.source.gripper.grasp_offset
        sight.constant[record.slice("object_from_grasp")] = -farther * START_ROTATION[:, 0]
        if retargeted:
            progress, there = record.slice("closing_progress"), self._posture(alpha)
            for role in COMMANDED_ROLES:
                joint, farther = record.slice(f"finger/{role}"), self._own_posture.get(role, 0.0) - there.get(role, 0.0)
                sight.matrix[joint, progress] = sight.constant[joint] = 0.5 * farther  # progress goes from -1 to +1
        return sight

    def _posture(self, alpha: np.ndarray) -> dict[str, float]:
        """As GraspLaw's."""
        assert isinstance(self.merged, MergedRobot) and self.merged.law is not None, "a merged arm has its law once it is made"
        return self.merged.law.posture(alpha)

    @cached_property
    def _own_posture(self) -> dict[str, float]:
        """The source's."""
        return self._posture(self.space.beta(self.source.name))

    def tree(self, metric: Metric, kind: Kind) -> EvolutionTree:
        """The evolution tree from the source to the targets."""
        source, targets = self.terminals()
        return evolution_tree(source, targets, metric, kind)

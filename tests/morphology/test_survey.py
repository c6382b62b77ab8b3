"""What a set of robots costs: one yardstick for every arm under the hand, and trees that grow with their targets."""

import numpy as np
import pytest

from robots import ROBOTS
from toolkit.errors import ToolkitError
from toolkit.evolution import Terminal, evolution_tree
from toolkit.morphology.survey import as_points, compare_arms, growth, hand_on_arms

ADROIT, JACO, KINOVA3 = ROBOTS["adroit"], ROBOTS["jaco"], ROBOTS["kinova3"]


def test_the_hand_goes_on_every_other_arm_once():
    hands = hand_on_arms(ADROIT, [robot for name, robot in ROBOTS.items() if robot is not ADROIT])
    assert hands[0] is ADROIT
    arms = [robot.arm for robot in hands]
    assert len(set(arms)) == len(arms) and set(arms) == {robot.arm for robot in ROBOTS.values()}
    assert all(robot.gripper is ADROIT.gripper and robot.source_of_policy for robot in hands)
    assert len({robot.name for robot in hands}) == len(hands) and all(robot.name.isidentifier() for robot in hands)


@pytest.mark.slow
def test_arms_are_compared_in_one_space():
    """The hand on the Kinova, and on the Jaco, to both of them: what each costs is a tree in the space of all four."""
    costs = compare_arms(ADROIT, [JACO, KINOVA3], "l1")
    assert {cost.arm for cost in costs} == {"Kinova3", "Jaco"} and costs[0].length <= costs[1].length
    points = {point.name: point for point in as_points([*hand_on_arms(ADROIT, [JACO, KINOVA3]), JACO, KINOVA3])}
    for cost in costs:
        tree = evolution_tree(points[cost.source], [points["jaco"], points["kinova3"]])
        assert cost.length == pytest.approx(tree.length) and cost.ratio == pytest.approx(tree.ratio) and cost.optimal


def test_a_tree_grows_with_its_targets():
    points = np.random.default_rng(0).random((6, 12))
    source, *targets = [Terminal(f"r{i}", p) for i, p in enumerate(points)]
    costs = growth(source, targets, "l1")
    assert [cost.targets for cost in costs] == [tuple(t.name for t in targets[:k]) for k in range(1, 6)]
    lengths = [cost.length for cost in costs]
    assert lengths == sorted(lengths), "a target more cannot make the shortest tree shorter"
    assert costs[0].ratio == pytest.approx(1) and costs[-1].independent_length > costs[-1].length
    with pytest.raises(ToolkitError, match="no targets"):
        growth(source, [], "l1")

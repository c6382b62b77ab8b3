"""The proposal: chains aligned by geometry against brute force, and what it says of the robots that are registered."""

from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from robots import ROBOTS
from toolkit.errors import ToolkitError
from toolkit.morphology.matching import match
from toolkit.morphology.proposal import ALONE, align, pair_cost
from toolkit.morphology.tree import Screw

unit = st.tuples(*[st.floats(-1, 1)] * 3).map(np.array).filter(lambda v: np.linalg.norm(v) > 0.1)


def screw(anchor, axis, sliding=False):
    axis = np.array(axis, float)
    return Screw(np.array(anchor, float), axis / np.linalg.norm(axis), 1.0, np.array(anchor, float), np.eye(3), sliding)


# -- alignment -----------------------------------------------------------------------------------------------


def cheapest(costs):
    """The least cost over all pairings that never cross, by trying every one."""
    n, m = costs.shape
    best = np.inf
    for size in range(min(n, m) + 1):
        for rows in combinations(range(n), size):
            for columns in combinations(range(m), size):
                pairs = sum(costs[i, j] for i, j in zip(rows, columns, strict=True))
                best = min(best, pairs + ALONE * (n + m - 2 * size))
    return best


@settings(max_examples=60)
@given(seed=st.integers(0, 2**32 - 1), n=st.integers(0, 4), m=st.integers(0, 4), forbidden=st.booleans())
def test_alignment_is_the_cheapest_that_keeps_the_order(seed, n, m, forbidden):
    rng = np.random.default_rng(seed)
    costs = rng.uniform(0, 2.5 * ALONE, (n, m))
    if forbidden:
        costs[rng.random((n, m)) < 0.3] = np.inf
    pairs = align(costs)
    for side, size in ((0, n), (1, m)):
        assert [pair[side] for pair in pairs if pair[side] is not None] == list(range(size)), "a joint is lost or out of order"
    total = sum(ALONE if None in pair else costs[pair] for pair in pairs)
    assert total == pytest.approx(cheapest(costs))


@given(anchor=unit, axis=unit, shift=st.floats(-1, 1))
def test_a_joint_is_its_own_partner_wherever_its_anchor_slides_and_whichever_way_it_points(anchor, axis, shift):
    one = screw(anchor, axis)
    assert pair_cost(one, screw(anchor + shift * one.axis, -axis)) == pytest.approx(0.0, abs=1e-6)


def test_a_pair_costs_its_angle_and_its_distance():
    one = screw([0, 0, 0], [0, 0, 1])
    assert pair_cost(one, screw([0, 0.3, 7], [0, 0, 1])) == pytest.approx(0.3)
    assert pair_cost(one, screw([5, 0.3, 7], [1, 0, 0])) == pytest.approx(1.3)
    assert pair_cost(one, screw([0, 0, 0], [0, 0, 1], sliding=True)) == np.inf


# -- on the registered robots --------------------------------------------------------------------------------


@pytest.mark.parametrize("name", [name for name, robot in ROBOTS.items() if not robot.source_of_policy])
def test_the_geometry_alone_pairs_the_arms_as_intended(matching, name):
    pairs = [pair for pair in matching.pairs if pair.robot == name and pair.slot.startswith("arm")]
    wanted = ["arm1", "arm2", "arm4", "arm5", "arm6", "arm7"] if len(pairs) == 6 else [f"arm{i + 1}" for i in range(7)]
    assert [pair.proposed for pair in pairs] == wanted
    assert not any(pair.by_card for pair in pairs), f"{name}'s card has to overrule the geometry"


@pytest.mark.parametrize("name", ["kinova3", "iiwa", "panda", "sawyer", "jaco"])
def test_the_geometry_tells_thumb_from_fingers_and_finds_knuckles_and_slides(matching, name):
    pairs = [pair for pair in matching.pairs if pair.robot == name and not pair.slot.startswith("arm")]
    assert pairs and all(pair.by_card for pair in pairs)
    for pair in pairs:
        kinds = [slot[2] for slot in (pair.slot, pair.proposed)]
        assert kinds[0] == kinds[1], f"{pair.joint} plays {pair.slot}, proposed is {pair.proposed}"
        assert (pair.slot[:2] == "TH") == (pair.proposed[:2] == "TH"), f"{pair.joint}: {pair.proposed} for {pair.slot}"


def test_where_the_card_overrules_is_known(matching):
    """What docs/add-a-robot.md explains; a new entry here wants a line there."""
    overruled = {(pair.robot, pair.joint): (pair.proposed, pair.slot) for pair in matching.pairs if pair.overridden}
    assert {key: value for key, value in overruled.items() if key[0] != "ur5e"} == {
        ("jaco", "joint_thumb"): ("THJ3", "THJ4"), ("jaco", "joint_thumb_distal"): ("THJ2", "THJ1"),
        ("jaco", "joint_index_distal"): ("FFJ0", "FFJ1"),
        ("jaco", "joint_pinky"): ("MFJ2", "RFJ2"), ("jaco", "joint_pinky_distal"): ("MFJ0", "RFJ1"),
        ("kinova3", "left_inner_finger_joint"): ("THJ2", "THJ1"),
        ("iiwa", "left_inner_finger_joint"): ("THJ2", "THJ1"), ("iiwa", "right_inner_finger_joint"): ("FFJ0", "FFJ1"),
    }


# -- and overruled -------------------------------------------------------------------------------------------


def test_a_card_can_overrule_the_arm():
    card = replace(ROBOTS["ur5e"], arm_roles={"elbow_joint": "arm3"})
    matching = match([ROBOTS["adroit"], card])
    elbow = next(pair for pair in matching.pairs if pair.joint == "elbow_joint")
    assert (elbow.slot, elbow.proposed, elbow.overridden) == ("arm3", "arm4", True)
    assert [slot.name for slot in matching.slots[:7]] == [f"arm{i + 1}" for i in range(7)]


@pytest.mark.parametrize(
    "roles, sentence",
    [
        ({"elbow": "arm3"}, "robot ur5e: arm_roles names joint 'elbow', which its arm lacks; it has shoulder_pan_joint, "),
        ({"elbow_joint": "arm9"}, "robot ur5e: arm_roles pairs 'elbow_joint' with 'arm9'; there are arm1, arm2, "),
    ],
)
def test_an_impossible_pair_is_named(roles, sentence):
    with pytest.raises(ToolkitError, match=sentence):
        match([ROBOTS["adroit"], replace(ROBOTS["ur5e"], arm_roles=roles)])


def test_a_joint_without_a_role_is_named_with_the_proposed_one():
    card = ROBOTS["panda"]
    gripper = replace(card.gripper, joints={"FFS": "finger_joint1"}, targets={"FFS": (0.04, 0.0)})
    with pytest.raises(ToolkitError, match="joint 'finger_joint2' has no role; by its geometry it is THS: add it"):
        match([ROBOTS["adroit"], replace(card, gripper=gripper)])

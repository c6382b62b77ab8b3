"""Algorithm 2's manners: where to go next, one split at each meta robot, and no flapping in between."""

import time

import numpy as np
import pytest
from toy_trees import robots

from toolkit.evolution import KINDS, METRICS, Terminal, evolution_tree, next_meta_robot


def walk(points, metric, kind, goal=None, steps=60):
    """Partitions on the straight way to the first meta robot (or to `goal`), both ends included."""
    source, targets = robots(points)
    first = next_meta_robot(source, targets, metric, kind)
    targets = [target for target in targets if target.name not in first.reached]
    goal = first.meta_alpha if goal is None else goal
    way = [source.alpha + t * (goal - source.alpha) for t in np.linspace(0, 1, steps)]
    return [next_meta_robot(Terminal("now", alpha), targets, metric, kind) for alpha in way]


@pytest.mark.parametrize("seed", range(3))
def test_no_flapping_on_the_way_to_the_clamp_point(seed):
    points = np.random.default_rng(seed).random((5, 30))
    points[1:] = 0.3 + 0.4 * points[1:]
    goal = np.clip(points[0], points[1:].min(axis=0), points[1:].max(axis=0))
    steps = walk(points, "l1", "steiner", goal)
    partitions = [step.partition for step in steps]
    assert sum(a != b for a, b in zip(partitions, partitions[1:], strict=False)) == 0
    assert len(partitions[0]) == 1 and partitions[0][0] == {"t1", "t2", "t3", "t4"}
    assert np.ptp([step.meta_alpha for step in steps], axis=0).max() < 1e-12


@pytest.mark.parametrize("metric", METRICS)
@pytest.mark.parametrize("kind", ["steiner", "geometric-median"])
def test_one_split_at_the_meta_robot_and_none_before(metric, kind):
    points = np.random.default_rng(3).random((5, 30))
    steps = walk(points, metric, kind, steps=30)
    assert all(len(step.partition) == 1 for step in steps[:-1])
    arrived = next_meta_robot(Terminal("now", steps[0].meta_alpha), robots(points)[1], metric, kind, arrived=1e-4)
    assert arrived.splits and arrived.meta_name == "now"
    assert frozenset().union(*arrived.partition) == {"t1", "t2", "t3", "t4"}


def test_ties_do_not_flap_on_a_lattice():
    rng = np.random.default_rng(4)
    for _ in range(15):
        steps = walk(rng.integers(0, 3, (5, 4)) / 2, "l1", "steiner", steps=8)
        partitions = [step.partition for step in steps[:-1]]
        assert len(set(partitions)) == 1
        spread = np.ptp([step.meta_alpha for step in steps[:-1]], axis=0).max()
        assert spread < 1e-9 or steps[0].splits


@pytest.mark.parametrize("metric, count, dimensions", [("l1", 9, 40), ("l1", 5, 4), ("l2", 6, 20)])
def test_tiny_moves_beside_the_way_do_not_flap(metric, count, dimensions):
    """A walk to the first meta robot that strays by up to 1e-6 at every step: one partition, one meta robot, no change."""
    rng = np.random.default_rng(19)
    source, targets = robots(rng.random((count, dimensions)))
    meta = next_meta_robot(source, targets, metric).meta_alpha
    partitions, metas_seen = [], []
    for share in np.linspace(0, 0.999, 25):
        alpha = source.alpha + share * (meta - source.alpha) + 1e-6 * rng.uniform(-1, 1, dimensions)
        step = next_meta_robot(Terminal("now", alpha), targets, metric)
        partitions.append(step.partition)
        metas_seen.append(step.meta_alpha)
    changes = sum(a != b for a, b in zip(partitions, partitions[1:], strict=False))
    assert changes == 0 and len(partitions[0]) == 1, f"{changes} changes of partition in 25 steps"
    assert np.ptp(metas_seen, axis=0).max() < 1e-4, "the meta robot jumped"


def test_a_whole_transfer_of_small_steps_splits_once_per_meta_robot():
    """Algorithm 1's loop with replans at every step of xi, from the source to all of eight targets: partitions only get finer."""
    rng = np.random.default_rng(20)
    source, targets = robots(rng.random((9, 20)))
    xi, splits, replans = 0.15, 0, 0
    pending = [(source.alpha, targets)]
    while pending:
        alpha, left = pending.pop()
        while True:
            step, replans = next_meta_robot(Terminal("now", alpha), left), replans + 1
            left = [t for t in left if t.name not in step.reached]
            if not left:
                break
            if step.splits:
                splits += 1
                pending += [(alpha, [t for t in left if t.name in part]) for part in step.partition]
                break
            way = step.meta_alpha - alpha
            distance = np.linalg.norm(way)
            alpha = step.meta_alpha if distance <= xi else alpha + way * (xi / distance)
    assert splits <= 7, f"{splits} splits for eight targets in {replans} replans"
    assert replans > 60


def test_following_the_steps_to_the_end_costs_the_length_of_the_tree():
    points = np.random.default_rng(5).random((6, 40))
    source, targets = robots(points)

    def follow(alpha, left):
        step = next_meta_robot(Terminal("now", alpha), left)
        left = [t for t in left if t.name not in step.reached]
        if step.splits:
            return sum(follow(alpha, [t for t in left if t.name in part]) for part in step.partition)
        return np.abs(step.meta_alpha - alpha).sum() + follow(step.meta_alpha, left) if left else 0.0

    assert follow(source.alpha, targets) == pytest.approx(evolution_tree(source, targets).length)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("metric", METRICS)
def test_one_target_is_its_own_meta_robot(metric, kind):
    step = next_meta_robot(*robots([[0, 0], [1, 0.5]]), metric, kind)
    assert step.meta_name == "t1" and step.partition == (frozenset({"t1"}),) and not step.reached


def test_standing_on_a_target_is_reported():
    source, targets = robots([[0.5, 0.5], [0.5, 0.5], [1, 1], [0.9, 1]])
    step = next_meta_robot(source, targets)
    assert step.reached == {"t1"} and step.partition == ({"t2", "t3"},)
    assert evolution_tree(source, targets).next_meta().reached == {"t1"}
    done = next_meta_robot(source, targets[:1])
    assert done.reached == {"t1"} and done.partition == () and not done.splits


def test_a_coarse_arrival_distance_splits_early():
    points = np.random.default_rng(6).random((4, 20))
    source, targets = robots(points)
    meta = next_meta_robot(source, targets).meta_alpha
    near = Terminal("now", meta + 0.01 * (source.alpha - meta) / np.linalg.norm(source.alpha - meta))
    assert not next_meta_robot(near, targets).splits
    assert next_meta_robot(near, targets, arrived=0.02).splits


def test_independent_splits_at_once():
    step = next_meta_robot(*robots([[0, 0], [1, 1], [1, 0.9]]), kind="independent")
    assert step.splits and set(step.partition) == {frozenset({"t1"}), frozenset({"t2"})}


@pytest.mark.parametrize("metric, n, d, limit", [("l1", 4, 300, 0.010), ("l2", 4, 300, 0.010), ("l1", 9, 105, 0.100)])
def test_a_replan_with_three_and_with_eight_targets_is_quick(metric, n, d, limit):
    """CPU time of the one thread, since other processes may use the machine."""
    source, targets = robots(np.random.default_rng(14).random((n, d)))
    times = []
    for _ in range(6):  # the first one may compile
        start = time.thread_time()
        next_meta_robot(source, targets, metric)
        times.append(time.thread_time() - start)
    assert min(times) < 3 * limit, f"best of six: {min(times) * 1e3:.1f} ms (three times the goal, for a busy machine)"

"""The shortest tree, checked against every topology solved by other means, and Algorithm 2's manners."""

import time

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import minimize
from scipy.sparse.csgraph import minimum_spanning_tree
from scipy.spatial.distance import cdist
from toy_trees import hanan_length, robots, tree_of

from toolkit.errors import ToolkitError
from toolkit.evolution import (
    KINDS,
    METRICS,
    Terminal,
    evolution_tree,
    l1,
    l2,
    next_meta_robot,
)
from toolkit.evolution.bounds import tour_bound
from toolkit.evolution.parsimony import search

SCIPY = {"l1": "cityblock", "l2": "euclidean"}


def metas(tree):
    return [node for node in tree.nodes if node.kind == "meta"]


def degrees(tree):
    ends = [end for edge in tree.edges for end in (edge.start, edge.end)]
    return np.bincount(ends, minlength=len(tree.nodes))


def mst(points, metric):
    points = np.unique(points, axis=0)  # scipy takes a distance of zero for no edge
    return minimum_spanning_tree(cdist(points, points, SCIPY[metric])).sum()


def check_tree(tree):
    """It is a tree over all nodes, directed from the source, and its numbers agree with each other."""
    above = {edge.end: edge.start for edge in tree.edges}
    assert len(above) == len(tree.edges) == len(tree.nodes) - 1 and 0 not in above
    seen = {0}
    for edge in tree.edges:
        assert edge.start in seen, "edges are not ordered from the source"
        seen.add(edge.end)
        gap = tree.nodes[edge.start].alpha - tree.nodes[edge.end].alpha
        assert edge.length == pytest.approx(np.linalg.norm(gap, 1 if tree.metric == "l1" else 2), abs=1e-12)
    assert tree.lower_bound <= tree.length
    assert all(degrees(tree)[i] >= 3 for i, n in enumerate(tree.nodes) if n.kind == "meta") or tree.kind != "steiner"


# ------------------------------------------------------------------------- every topology, by other means


def topologies(n):
    """All (2n-5)!! unrooted binary trees over leaves 0 .. n-1, as edge lists."""
    trees = [[(0, n), (1, n), (2, n)]]
    for leaf in range(3, n):
        hub = n + leaf - 2
        trees = [
            [*tree[:i], *tree[i + 1 :], (tree[i][0], hub), (hub, tree[i][1]), (leaf, hub)]
            for tree in trees
            for i in range(len(tree))
        ]
    return trees


def euclidean_length(edges, points, rng):
    n, d = points.shape
    ends = np.array(edges)

    def length(flat):
        nodes = np.vstack([points, flat.reshape(-1, d)])
        return np.sqrt((np.diff(nodes[ends], axis=1)[:, 0] ** 2).sum(axis=1) + 1e-12).sum()

    start = points.mean(axis=0) + 0.1 * rng.standard_normal((n - 2, d))
    return minimize(length, start.ravel(), method="BFGS").fun


@pytest.mark.parametrize("n, d, seed", [(3, 2, 0), (4, 1, 1), (4, 3, 2), (5, 2, 3), (5, 4, 4), (6, 2, 5), (6, 3, 6)])
def test_l1_is_the_shortest_of_all_topologies(n, d, seed):
    points = np.random.default_rng(seed).random((n, d))
    tree = tree_of(points)
    check_tree(tree)
    brute = min(hanan_length(edges, points) for edges in topologies(n))
    assert tree.length == pytest.approx(brute, abs=1e-12)
    assert tree.optimal and tree.lower_bound == pytest.approx(brute, abs=1e-12)


def test_l1_on_a_lattice_with_many_ties():
    rng = np.random.default_rng(7)
    for _ in range(10):
        points = rng.integers(0, 3, (5, 3)).astype(float)
        tree = tree_of(points)
        check_tree(tree)
        assert tree.length == pytest.approx(min(hanan_length(edges, points) for edges in topologies(5)), abs=1e-12)


@pytest.mark.parametrize("n, d, seed", [(3, 2, 0), (4, 2, 1), (4, 5, 2), (5, 2, 3), (5, 3, 4)])
def test_l2_is_the_shortest_of_all_topologies(n, d, seed):
    rng = np.random.default_rng(seed)
    points = rng.random((n, d))
    tree = tree_of(points, "l2")
    check_tree(tree)
    brute = min(euclidean_length(edges, points, rng) for edges in topologies(n))
    assert tree.length == pytest.approx(brute, abs=1e-5) and tree.length <= brute + 1e-9
    assert tree.optimal and tree.length - tree.lower_bound <= 1e-8


def test_l1_optimum_does_not_depend_on_who_is_the_source():
    points = np.random.default_rng(8).random((8, 40))
    lengths = [tree_of(np.roll(points, shift, axis=0)).length for shift in range(4)]
    assert np.ptp(lengths) < 1e-10


@pytest.mark.parametrize("metric", METRICS)
@pytest.mark.parametrize("count", [11, 14, 20])
def test_beyond_the_exact_limit_the_answer_is_honest(metric, count):
    points = np.random.default_rng(9).random((count, 6))
    tree = tree_of(points, metric)
    check_tree(tree)
    assert tree.length <= mst(points, metric) + 1e-9
    assert mst(points, metric) / 2 <= tree.lower_bound <= tree.length
    assert tree.optimal == (tree.length - tree.lower_bound <= 1e-8 * tree.length)
    assert not tree.optimal or (metric == "l1" and count == 11)


def test_the_local_search_alone_finds_what_the_proof_finds():
    """Ten random instances of nine robots, each proven; the search knows nothing of the proof, nor the proof's order of it."""
    for seed in range(10):
        points = np.random.default_rng(seed).random((9, 30))
        proven = tree_of(points)
        assert proven.optimal
        _, _, found = search(points, 2000, seed)
        assert found == pytest.approx(proven.length, rel=1e-10), f"seed {seed}: {found / proven.length - 1:.2%} too long"


def test_the_l2_search_alone_finds_what_the_proof_finds(monkeypatch):
    for seed in range(4):
        points = np.random.default_rng(seed).random((7, 10))
        proven = tree_of(points, "l2")
        monkeypatch.setattr(l2, "EXACT_UP_TO", 3)
        found = tree_of(points, "l2")
        monkeypatch.undo()
        assert proven.optimal and not found.optimal
        assert found.length == pytest.approx(proven.length, rel=1e-7), f"seed {seed}"


def test_a_search_that_works_longer_finds_no_longer_tree():
    points = np.random.default_rng(17).random((14, 20))
    source, targets = robots(points)
    short, long = (evolution_tree(source, targets, effort=effort).length for effort in (0.02, 0.2))
    assert long <= short
    for effort in (0.0, -1.0, np.nan, np.inf):
        with pytest.raises(ToolkitError, match="effort"):
            evolution_tree(source, targets, effort=effort)


def test_a_proof_that_ran_out_of_budget_claims_nothing(monkeypatch):
    points = np.random.default_rng(18).random((9, 30))
    proven = tree_of(points)
    monkeypatch.setattr(l1, "PROOF_WORK", 4_000)
    stopped = tree_of(points)
    assert proven.optimal and not stopped.optimal and stopped.lower_bound < proven.length <= stopped.length


@pytest.mark.parametrize("metric", METRICS)
def test_the_tour_bound_is_a_bound_and_beats_half_a_spanning_tree(metric):
    for seed in range(5):
        points = np.random.default_rng(seed).random((7, 8))
        bound, best = tour_bound(points, metric), tree_of(points, metric).length
        assert mst(points, metric) / 2 < bound <= best
    chain = np.linspace(0, 1, 6)[:, None] * np.ones(3)
    short = 1 - tour_bound(chain, metric) / tree_of(chain, metric).length
    assert 0 <= short + 1e-12 < 0.01, f"a chain's tour is its double, but the bound is {short:.2%} short of it"


# ------------------------------------------------------------------------------------- cases known by hand


def test_three_terminals_meet_at_the_coordinate_wise_median():
    points = np.random.default_rng(10).random((3, 105))
    tree = tree_of(points)
    (meta,) = metas(tree)
    np.testing.assert_allclose(meta.alpha, np.median(points, axis=0), atol=1e-15)
    assert tree.length == pytest.approx(np.ptp(points, axis=0).sum())


def test_targets_in_opposite_directions_make_a_star():
    tree = tree_of([[0.5, 0.5], [0, 0.5], [1, 0.5], [0.5, 0], [0.5, 1]])
    assert not metas(tree) and degrees(tree)[0] == 4 and tree.ratio == 1 and tree.length == 2
    turns = np.deg2rad([[0], [120], [240]])
    rays = 0.5 + 0.4 * np.hstack([np.cos(turns), np.sin(turns)])
    euclid = tree_of([[0.5, 0.5], *rays], "l2")
    assert not metas(euclid) and degrees(euclid)[0] == 3 and euclid.length == pytest.approx(1.2, rel=1e-9)


@pytest.mark.parametrize("metric", METRICS)
def test_collinear_targets_make_a_chain(metric):
    tree = tree_of([[0, 0, 0], [1, 1, 1], [0.25, 0.25, 0.25], [0.5, 0.5, 0.5]], metric)
    names = [(tree.nodes[e.start].name, tree.nodes[e.end].name) for e in tree.edges]
    assert names == [("source", "t2"), ("t2", "t3"), ("t3", "t1")]


def test_fermat_point_of_an_equilateral_triangle():
    corners = np.array([[0, 0], [1, 0], [0.5, np.sqrt(3) / 2]])
    tree = tree_of(corners, "l2")
    assert tree.length == pytest.approx(np.sqrt(3), rel=1e-9)
    np.testing.assert_allclose(metas(tree)[0].alpha, corners.mean(axis=0), atol=1e-7)


def test_an_angle_above_120_degrees_needs_no_meta_robot():
    turn = np.deg2rad(125)
    tree = tree_of([[0, 0], [1, 0], [np.cos(turn), np.sin(turn)]], "l2")
    assert not metas(tree) and tree.length == pytest.approx(2, rel=1e-9)


def test_unit_square_has_length_one_plus_root_three():
    tree = tree_of([[0, 0], [1, 0], [1, 1], [0, 1]], "l2")
    assert tree.length == pytest.approx(1 + np.sqrt(3), rel=1e-9) and tree.optimal and len(metas(tree)) == 2


def test_unit_cube_has_length_one_plus_three_root_three():
    """Eight terminals: found by the beam, not proven."""
    corners = np.array(np.meshgrid([0, 1], [0, 1], [0, 1])).reshape(3, -1).T
    tree = tree_of(corners, "l2")
    assert tree.length == pytest.approx(1 + 3 * np.sqrt(3), rel=1e-9) and not tree.optimal


def test_l2_edges_meet_at_120_degrees():
    tree = tree_of(np.random.default_rng(11).random((6, 8)), "l2")
    assert metas(tree)
    for index, node in enumerate(tree.nodes):
        ends = [(e.end if e.start == index else e.start) for e in tree.edges if index in (e.start, e.end)]
        away = np.array([tree.nodes[end].alpha - node.alpha for end in ends])
        away /= np.linalg.norm(away, axis=1, keepdims=True)
        cosines = (away @ away.T)[np.triu_indices(len(ends), 1)]
        if node.kind == "meta":
            assert len(ends) == 3 and np.allclose(cosines, -0.5, atol=1e-4)
        else:
            assert len(ends) <= 3 and (cosines <= -0.5 + 1e-4).all()


@pytest.mark.parametrize("metric, p", [("l1", 1), ("l2", 2)])
def test_geometric_median_is_a_minimum(metric, p):
    rng = np.random.default_rng(12)
    for count in (3, 4, 5):
        points = rng.random((count, 4))
        tree = tree_of(points, metric, "geometric-median")
        (meta,) = metas(tree)
        here = np.linalg.norm(points - meta.alpha, p, axis=1).sum()
        assert tree.length == pytest.approx(here)
        for step in 1e-4 * rng.standard_normal((50, 4)):
            assert np.linalg.norm(points - meta.alpha - step, p, axis=1).sum() >= here - 1e-12


def test_geometric_median_at_a_terminal_needs_no_meta_robot():
    tree = tree_of([[0.5, 0.5], [0, 0.5], [1, 0.5], [0.5, 0], [0.5, 1]], "l2", "geometric-median")
    assert not metas(tree) and degrees(tree)[0] == 4


def test_an_even_median_keeps_the_source_value():
    tree = tree_of([[0.4], [0.0], [0.3], [1.0]], "l1", "geometric-median")
    median = [node for i, node in enumerate(tree.nodes) if degrees(tree)[i] == 3]
    assert median[0].alpha == pytest.approx([0.4])


def test_independent_is_a_star_and_the_ratio_compares_with_it():
    points = np.random.default_rng(13).random((5, 20))
    star = tree_of(points, "l1", "independent")
    assert star.length == pytest.approx(np.abs(points[1:] - points[0]).sum()) and star.ratio == pytest.approx(1)
    assert star.optimal and {e.start for e in star.edges} == {0}
    shared = tree_of(points)
    assert shared.ratio == pytest.approx(star.length / shared.length) and shared.ratio > 1


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("metric", METRICS)
def test_degenerate_inputs(metric, kind):
    alone = evolution_tree(Terminal("source", np.ones(3)), [], metric, kind)
    assert len(alone.nodes) == 1 and not alone.edges and alone.length == 0 and alone.optimal and alone.ratio == 1
    one = tree_of([[0, 0], [1, 1]], metric, kind)
    assert len(one.edges) == 1 and not metas(one) and one.optimal
    same = tree_of(np.full((5, 4), 0.3), metric, kind)
    check_tree(same)
    assert same.length == 0 and same.optimal and not metas(same)
    twins = tree_of([[0, 0], [1, 1], [1, 1], [0, 0], [0, 1]], metric, kind)
    check_tree(twins)
    assert {node.name for node in twins.nodes} >= {"source", "t1", "t2", "t3", "t4"}


def test_meta_robots_do_not_take_a_robot_s_name():
    points = [[0, 0, 0], [1, 1, 0], [0, 1, 1], [1, 0, 1]]
    targets = [Terminal(name, p) for name, p in zip(["meta-1", "b", "c"], points[1:], strict=True)]
    names = [node.name for node in evolution_tree(Terminal("a", points[0]), targets).nodes]
    assert len(set(names)) == len(names)


# --------------------------------------------------------------------------------------------- properties


clouds = st.integers(2, 7).flatmap(
    lambda n: st.integers(1, 4).flatmap(
        lambda d: st.lists(st.lists(st.integers(0, 8), min_size=d, max_size=d), min_size=n, max_size=n)
    )
)


@settings(max_examples=60, deadline=None)
@given(clouds)
def test_l1_tree_properties(cloud):
    points = np.array(cloud) / 8
    tree = tree_of(points)
    check_tree(tree)
    span = mst(points, "l1")
    assert np.ptp(points, axis=0).sum() - 1e-12 <= tree.length <= span + 1e-12
    assert span / 2 - 1e-12 <= tree.length and tree.optimal
    inside = (n.alpha for n in metas(tree))
    assert all(((points.min(0) <= a) & (a <= points.max(0))).all() for a in inside)


@settings(max_examples=25, deadline=None)
@given(clouds)
def test_l2_tree_properties(cloud):
    points = np.unique(np.array(cloud)[:6], axis=0) / 8
    tree = tree_of(points, "l2")
    check_tree(tree)
    assert tree.length <= tree_of(points, "l1").length + 1e-9
    assert mst(points, "l2") * np.sqrt(3) / 2 * 0.7 <= tree.length + 1e-9 <= mst(points, "l2") + 2e-9
    assert tree.optimal


@settings(max_examples=40, deadline=None)
@given(clouds)
def test_projection_on_the_targets_box_lies_on_a_shortest_tree(cloud):
    points = np.array(cloud) / 8
    clamped = np.clip(points[0], points[1:].min(axis=0), points[1:].max(axis=0))
    moved = np.abs(points[0] - clamped).sum()
    assert tree_of(points).length == pytest.approx(moved + tree_of([clamped, *points[1:]]).length, abs=1e-12)


# -------------------------------------------------------------------------------------------- Algorithm 2


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


# -------------------------------------------------------------------------------------------------- speed


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


# ------------------------------------------------------------------------------------------- files and errors


def test_unknown_metric_kind_and_too_many():
    source, targets = robots([[0, 0], [1, 1]])
    with pytest.raises(ToolkitError, match="metric"):
        evolution_tree(source, targets, "l3")
    with pytest.raises(ToolkitError, match="kind"):
        next_meta_robot(source, targets, "l1", "bush")
    with pytest.raises(ToolkitError, match="at most"):
        evolution_tree(source, [Terminal(f"t{i}", [0.5, 0.5]) for i in range(60)])

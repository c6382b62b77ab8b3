"""What holds of trees of either metric: chains, stars, twins, what is beyond a proof, and inputs that are none."""

import numpy as np
import pytest
from toy_trees import check_tree, degrees, metas, mst, robots, tree_of

from toolkit.errors import ToolkitError
from toolkit.evolution import KINDS, METRICS, Terminal, evolution_tree, next_meta_robot


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


def test_a_search_that_works_longer_finds_no_longer_tree():
    points = np.random.default_rng(17).random((14, 20))
    source, targets = robots(points)
    short, long = (evolution_tree(source, targets, effort=effort).length for effort in (0.02, 0.2))
    assert long <= short
    for effort in (0.0, -1.0, np.nan, np.inf):
        with pytest.raises(ToolkitError, match="effort"):
            evolution_tree(source, targets, effort=effort)


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











def test_unknown_metric_kind_and_too_many():
    source, targets = robots([[0, 0], [1, 1]])
    with pytest.raises(ToolkitError, match="metric"):
        evolution_tree(source, targets, "l3")
    with pytest.raises(ToolkitError, match="kind"):
        next_meta_robot(source, targets, "l1", "bush")
    with pytest.raises(ToolkitError, match="at most"):
        evolution_tree(source, [Terminal(f"t{i}", [0.5, 0.5]) for i in range(60)])

"""The shortest L1 tree, against every topology solved by other means, and what is known by hand."""

import numpy as np
import pytest
from hypothesis import given, settings
from toy_trees import check_tree, clouds, hanan_length, metas, mst, topologies, tree_of

from toolkit.evolution import l1


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


def test_l1_optimum_does_not_depend_on_who_is_the_source():
    points = np.random.default_rng(8).random((8, 40))
    lengths = [tree_of(np.roll(points, shift, axis=0)).length for shift in range(4)]
    assert np.ptp(lengths) < 1e-10


def test_a_proof_that_ran_out_of_budget_claims_nothing(monkeypatch):
    points = np.random.default_rng(18).random((9, 30))
    proven = tree_of(points)
    monkeypatch.setattr(l1, "PROOF_WORK", 4_000)
    stopped = tree_of(points)
    assert proven.optimal and not stopped.optimal and stopped.lower_bound < proven.length <= stopped.length


def test_three_terminals_meet_at_the_coordinate_wise_median():
    points = np.random.default_rng(10).random((3, 105))
    tree = tree_of(points)
    (meta,) = metas(tree)
    np.testing.assert_allclose(meta.alpha, np.median(points, axis=0), atol=1e-15)
    assert tree.length == pytest.approx(np.ptp(points, axis=0).sum())


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


@settings(max_examples=40, deadline=None)
@given(clouds)
def test_projection_on_the_targets_box_lies_on_a_shortest_tree(cloud):
    points = np.array(cloud) / 8
    clamped = np.clip(points[0], points[1:].min(axis=0), points[1:].max(axis=0))
    moved = np.abs(points[0] - clamped).sum()
    assert tree_of(points).length == pytest.approx(moved + tree_of([clamped, *points[1:]]).length, abs=1e-12)

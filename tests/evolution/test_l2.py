"""The shortest Euclidean tree, against every topology solved by other means, and what is known by hand."""

import numpy as np
import pytest
from hypothesis import given, settings
from toy_trees import check_tree, clouds, euclidean_length, metas, mst, topologies, tree_of

from toolkit.evolution import l2


@pytest.mark.parametrize("n, d, seed", [(3, 2, 0), (4, 2, 1), (4, 5, 2), (5, 2, 3), (5, 3, 4)])
def test_l2_is_the_shortest_of_all_topologies(n, d, seed):
    rng = np.random.default_rng(seed)
    points = rng.random((n, d))
    tree = tree_of(points, "l2")
    check_tree(tree)
    brute = min(euclidean_length(edges, points, rng) for edges in topologies(n))
    assert tree.length == pytest.approx(brute, abs=1e-5) and tree.length <= brute + 1e-9
    assert tree.optimal and tree.length - tree.lower_bound <= 1e-8


def test_the_l2_search_alone_finds_what_the_proof_finds(monkeypatch):
    for seed in range(4):
        points = np.random.default_rng(seed).random((7, 10))
        proven = tree_of(points, "l2")
        monkeypatch.setattr(l2, "EXACT_UP_TO", 3)
        found = tree_of(points, "l2")
        monkeypatch.undo()
        assert proven.optimal and not found.optimal
        assert found.length == pytest.approx(proven.length, rel=1e-7), f"seed {seed}"


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


@settings(max_examples=25, deadline=None)
@given(clouds)
def test_l2_tree_properties(cloud):
    points = np.unique(np.array(cloud)[:6], axis=0) / 8
    tree = tree_of(points, "l2")
    check_tree(tree)
    assert tree.length <= tree_of(points, "l1").length + 1e-9
    assert mst(points, "l2") * np.sqrt(3) / 2 * 0.7 <= tree.length + 1e-9 <= mst(points, "l2") + 2e-9
    assert tree.optimal

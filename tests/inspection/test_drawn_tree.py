"""The tree as it is drawn: to scale, every path where it leaves, named as a transfer names it."""

import json
from pathlib import Path

import numpy as np
import pytest

from toolkit.inspection.drawn_tree import Plan, matrix
from toolkit.inspection.report.figures import tree_figure

ROOT = Path(__file__).parents[2]


def test_the_tree_is_laid_out_to_scale():
    nodes = [{"name": name, "kind": kind, "alpha": alpha} for name, kind, alpha in
             [("s", "source", [0, 0, 0]), ("m", "meta", [1, 0, 0]), ("t", "target", [1, 1, 0]), ("u", "target", [1, 0, 3])]]
    edges = [{"from": "s", "to": "m", "length": 1.0}, {"from": "m", "to": "t", "length": 1.0}, {"from": "m", "to": "u", "length": 3.0}]
    plan = Plan({"nodes": nodes, "edges": edges})
    assert plan.places["s"][0] == 0 and plan.places["m"][0] == pytest.approx(250) and plan.places["u"][0] == pytest.approx(1000)
    assert plan.edge_of(["t", "u"]) is edges[0] and plan.edge_of(["u"]) is edges[2] and plan.edge_of(["s"]) is None
    assert plan.fraction(edges[2], np.array([1, 0, 1.5])) == pytest.approx(0.5)
    assert plan.share.sum() == pytest.approx(1.0), "four points in space: three components tell all"
    flat = plan.project(np.array([node["alpha"] for node in nodes], float))
    apart = np.linalg.norm(flat[3] - flat[1]) / np.linalg.norm(flat[1] - flat[0])
    assert apart == pytest.approx(3.0), "a projection that keeps everything keeps distances"


def test_a_path_that_leaves_from_elsewhere_has_a_way_of_its_own():
    """A tree that asks takes jaco's path from the source, and iiwa's from kinova3: neither is drawn on the plan's edge."""
    nodes = [{"name": name, "kind": kind, "alpha": alpha} for name, kind, alpha in
             [("s", "source", [0, 0, 0]), ("m", "meta", [1, 0, 0]), ("t", "target", [1, 1, 0]), ("u", "target", [1, 0, 3])]]
    edges = [{"from": "s", "to": "m", "length": 1.0}, {"from": "m", "to": "t", "length": 1.0}, {"from": "m", "to": "u", "length": 3.0}]
    plan = Plan({"nodes": nodes, "edges": edges})
    along = [np.array(alpha) for alpha in ([1, 0, 0], [1, 0.4, 0], [1, 1, 0])]
    assert all(plan.way_of(["t"], alpha) is edges[1] for alpha in along)
    for alpha in ([0, 0, 0], [0.4, 0.4, 0], [0.2, 0.9, 0]):  # straight, and round a corner
        way = plan.way_of(["t"], np.array(alpha, float))
        assert (way["from"], way["to"], way["length"]) == ("s", "t", 2.0)
    way = plan.way_of(["t"], np.array([1, 0.5, 1.5]))
    assert (way["from"], way["to"]) == ("u", "t") and plan.fraction(way, np.array([1, 0.5, 1.5])) == pytest.approx(0.5)
    half = plan.stretch(way, 0.0, 0.5)
    np.testing.assert_allclose(half, [plan.places["u"], np.add(plan.places["u"], plan.places["t"]) / 2])
    assert plan.way_of(["t", "u"], np.array([0.5, 0, 0])) is edges[0] and plan.way_of(["s"], np.zeros(3)) is None
    assert len(tree_figure(plan, [("s", "t", 0.5, 1.0), ("s", "m", 1.0, None)]).axes[0].lines) == 3 + 2 + 4


def test_paths_are_named_as_a_transfer_names_them():
    """Of a committed run, whose paths are still counted in the order in which they were played, there are as many as were told of."""
    folder = ROOT / "docs" / "results" / "tree-0"
    records = [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]
    named = Plan(json.loads((folder / "tree.json").read_bytes())).paths
    assert len(named) == len({record["path"] for record in records}) and named[0] == "path 1"
    nodes = [{"name": name, "kind": kind, "alpha": [x]} for name, kind, x in
             [("s", "source", 0), ("t", "target", 1), ("u", "target", -1), ("v", "target", 2)]]
    edges = [{"from": start, "to": end, "length": 1.0} for start, end in (("s", "t"), ("s", "u"), ("t", "v"))]
    assert Plan({"nodes": nodes, "edges": edges}).paths == ["path 1.1", "path 1.1.1", "path 1.1.2", "path 1.2"], (
        "s forks: 1 has nothing to do; 1.1 to t, which is a target, so that it parts; 1.2 to u"
    )


def test_a_matrix_has_a_place_for_every_dimension(small):
    places, rows, columns = matrix(small.space)
    assert len({tuple(place) for place in places}) == small.space.size, "no two dimensions share a cell"
    assert places[:, 1].max() + 1 == len(rows) and "anchor" in columns and "arm1" in rows

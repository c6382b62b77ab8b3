"""The tree's record: what it says as JSON, and that nobody changes it."""

import json

import numpy as np
import pytest
from toy_trees import tree_of

from toolkit.evolution import Terminal


def test_json_contract():
    tree = tree_of(np.random.default_rng(15).random((5, 6)))
    record = json.loads(json.dumps(tree.to_json()))
    assert list(record) == ["metric", "kind", "length", "optimal", "lower_bound", "nodes", "edges"]
    assert all(list(node) == ["name", "kind", "alpha"] for node in record["nodes"])
    assert all(list(edge) == ["from", "to", "length"] for edge in record["edges"])
    assert {node["kind"] for node in record["nodes"]} == {"source", "meta", "target"}
    assert record["length"] == pytest.approx(sum(edge["length"] for edge in record["edges"]))
    assert isinstance(record["optimal"], bool)


def test_alpha_is_read_only():
    robot = Terminal("a", [0.0, 1.0])
    with pytest.raises(ValueError, match="read-only"):
        robot.alpha[0] = 1

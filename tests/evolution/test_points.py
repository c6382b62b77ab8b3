"""Files of points: read, or refused by one sentence."""

import json

import pytest

from toolkit.errors import ToolkitError
from toolkit.evolution import (
    load_points,
    tree_from_points,
)

GOOD = {"source": {"name": "hand", "alpha": [0, 0.5]}, "targets": [{"name": "jaw", "alpha": [1, 0.25]}]}


def test_points_file_round_trip(tmp_path):
    path = tmp_path / "points.json"
    path.write_text(json.dumps(GOOD))
    source, targets = load_points(path)
    assert source.name == "hand" and [t.name for t in targets] == ["jaw"]
    tree = tree_from_points(path)
    assert tree.to_json() == tree_from_points(GOOD).to_json() == tree_from_points(str(path)).to_json()


BROKEN = {
    "not JSON": ("{", "not JSON"),
    "a list": ([1], "list"),
    "no source": ({"targets": GOOD["targets"]}, '"source"'),
    "no key targets": ({"source": GOOD["source"]}, '"targets"'),
    "empty targets": ({**GOOD, "targets": []}, "empty"),
    "targets not a list": ({**GOOD, "targets": {"a": 1}}, "list of robots"),
    "robot not an object": ({**GOOD, "targets": [3]}, r"targets\[0\]"),
    "no alpha": ({**GOOD, "targets": [{"name": "jaw"}]}, '"alpha"'),
    "no name": ({**GOOD, "source": {"alpha": [0, 0]}}, '"name"'),
    "empty name": ({**GOOD, "source": {"name": "", "alpha": [0, 0]}}, "name"),
    "unequal D": ({**GOOD, "targets": [{"name": "jaw", "alpha": [1]}]}, "dimensions"),
    "no dimensions": ({**GOOD, "source": {"name": "hand", "alpha": []}}, "shape"),
    "text": ({**GOOD, "source": {"name": "hand", "alpha": ["0", 1]}}, "numbers"),
    "null": ({**GOOD, "source": {"name": "hand", "alpha": [None, 1]}}, "nan|numbers"),
    "an object": ({**GOOD, "source": {"name": "hand", "alpha": [{}, 1]}}, "numbers"),
    "truth": ({**GOOD, "source": {"name": "hand", "alpha": [True, 1]}}, "numbers"),
    "not a list": ({**GOOD, "source": {"name": "hand", "alpha": 3}}, "numbers"),
    "nested": ({**GOOD, "source": {"name": "hand", "alpha": [[0, 1]]}}, "numbers"),
    "not a number": ({**GOOD, "source": {"name": "hand", "alpha": [float("nan"), 1]}}, r"alpha\[0\] is nan"),
    "infinite": ({**GOOD, "source": {"name": "hand", "alpha": [0, float("inf")]}}, r"alpha\[1\] is inf"),
    "huge": ({**GOOD, "source": {"name": "hand", "alpha": [0, 10**400]}}, "too large"),
    "outside": ({**GOOD, "targets": [{"name": "jaw", "alpha": [1, 1.5]}]}, r"alpha\[1\] is 1.5"),
    "twice": ({**GOOD, "targets": [{"name": "hand", "alpha": [1, 1]}]}, "twice"),
}


@pytest.mark.parametrize("content, message", BROKEN.values(), ids=BROKEN)
def test_broken_points_files(content, message, tmp_path):
    path = tmp_path / "points.json"
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    with pytest.raises(ToolkitError, match=message) as error:
        tree_from_points(path)
    assert "points.json" in str(error.value) and "\n" not in str(error.value)


def test_missing_and_unreadable_files(tmp_path):
    with pytest.raises(ToolkitError, match="cannot be read"):
        load_points(tmp_path / "nowhere.json")
    (tmp_path / "bytes.json").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(ToolkitError, match="not JSON"):
        load_points(tmp_path / "bytes.json")
    (tmp_path / "deep.json").write_text("[" * 100_000)
    with pytest.raises(ToolkitError, match="not JSON"):
        load_points(tmp_path / "deep.json")

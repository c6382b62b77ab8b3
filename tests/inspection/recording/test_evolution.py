"""The page of the evolution: the tree to scale, the robots on it, a cell per dimension of alpha."""

import pytest
from rerun_rows import seconds


def test_tree_projection_and_alpha(rows, small):
    tree = small.tree("l1", "steiner").to_json()
    labels = {label for row in rows["/evolution/tree/names"] for label in row["Points2D:labels"]}
    assert {"adroit (source)", "jaco (target)"} == labels
    names = rows["/evolution/tree/names"][0]
    across = dict(zip(names["Points2D:labels"], (place[0] for place in names["Points2D:positions"]), strict=True))
    assert across["adroit (source)"] == 0 and across["jaco (target)"] > 1000, "names stand at their nodes"
    assert rows["/evolution/tree/lengths"][0]["Points2D:labels"] == [f"{tree['edges'][0]['length']:.1f}"]
    cells = [row for row in rows["/evolution/alpha/cells"] if "film" in row]
    assert len(cells[0]["Points2D:positions"]) == small.space.size == len(cells[0]["Points2D:colors"])
    done = [row for row in rows["/evolution/tree/done"] if "film" in row]
    assert len(done) == 3 and len(done[-1]["LineStrips2D:strips"]) == 3, "one stretch per phase"
    here = sorted((row for row in rows["/evolution/tree/here"] if "film" in row), key=seconds)
    across = [row["Points2D:positions"][0][0] for row in here]
    assert across[0] == 0 and max(across) == pytest.approx(1000), "from the source to the target"

"""bench: what is timed is told with its figures, and impossible sizes are refused."""

import pytest
from command_line import answer, refusal

pytestmark = pytest.mark.usefixtures("at_home")


def test_ticks_are_timed(capsys):
    found = answer(capsys, "bench", "tick", "kinova3", "--ticks", "100")
    assert found["bundle"] == "kinova3" and found["ticks"] == 100 and list(found["forms"]) == ["osc", "pose", "joint"]
    for row in found["forms"].values():
        assert 0 < row["observe_ms"] < row["p50_ms"] <= row["p99_ms"] <= row["max_ms"]
    assert "ticks is 5" in refusal(capsys, "bench", "tick", "--ticks", "5")


@pytest.mark.slow
def test_trees_are_timed(capsys):
    found = answer(capsys, "bench", "tree", "--terminals", "4", "8", "--dimensions", "20", "--longer", "2")
    assert [(t["metric"], t["terminals"], t["optimal"]) for t in found["trees"]] == [
        ("l1", 4, True), ("l1", 8, True), ("l2", 4, True), ("l2", 8, False),
    ]
    for timing in found["trees"]:
        assert timing["seconds"] > 0 and timing["length"] >= timing["best_known"] > 0 and timing["excess"] >= 0
        assert timing["gap"] == pytest.approx(max(0, 1 - timing["lower_bound"] / timing["length"]))
    assert "terminals are 1" in refusal(capsys, "bench", "tree", "--terminals", "1")
    assert "dimensions is 0" in refusal(capsys, "bench", "tree", "--dimensions", "0")

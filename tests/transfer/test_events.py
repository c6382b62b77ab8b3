"""What is told of a run is strict JSON, an event a line."""

import json

import pytest

pytestmark = pytest.mark.usefixtures("unhurried")


def test_metrics_are_strict_json(finished):
    transfer, _ = finished
    text = (transfer.run.path / "metrics.jsonl").read_text()
    assert "NaN" not in text and "Infinity" not in text
    events = {json.loads(line)["event"] for line in text.splitlines()}
    assert events - {"look"} == {"check", "explore", "moved", "update", "split", "arrived"}
    assert ("look" in events) is (transfer.config.step == "adaptive"), "a phase of adaptive steps begins with looks"

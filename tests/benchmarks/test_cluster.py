"""What larger clusters would give, worked out from the time of an episode."""

import json
from pathlib import Path

import pytest

from toolkit.benchmarks.cluster import CORES, paper_tables, run_times
from toolkit.benchmarks.paper import HERD, PAPER


def test_the_papers_tables_take_as_long_as_their_updates_or_their_episodes():
    rows = paper_tables(episode_s=0.5)
    assert len(rows) == sum(map(len, PAPER.values()))
    (ants,) = [row for row in rows if row["task"] == "ant-maze" and row["method"] == HERD]
    few, more, many = ants["hours"]
    assert CORES[0] == 16 and few == pytest.approx(84931 * 5 * 0.5 / 16 / 3600), "each core always plays"
    assert more == many == pytest.approx(14793 * 0.5 / 3600), "an update waits for an episode at least"
    assert ants["cores"] == 29 and 84931 / (29 / 5) <= 14793 < 84931 / (28 / 5), "the fewest processors with which that is so"


def test_our_own_runs_take_as_long_as_their_slowest_seed():
    """Of a tree that asks, whose batches all come one after the other; counted from the files themselves."""
    folder = Path(__file__).parents[2] / "docs" / "results-measured"
    (row,) = [row for row in run_times(folder, episode_s=0.5) if row["method"].startswith("tree that asks") and "jaco" in row["targets"]]
    runs = [path for path in folder.glob("found-asking-*") if (path / "report.json").is_file()]
    assert row["seeds"] == len(runs) >= 3
    slowest = 0.0
    for path in runs:
        lines, report = (path / "metrics.jsonl").read_text().splitlines(), json.loads((path / "report.json").read_text())
        batches = sum(json.loads(line)["event"] in ("update", "check", "look") for line in lines)
        beside = report["time"]["wall_s"] - report["time"]["play_s"]
        slowest = max(slowest, (0.5 * batches + beside) / 3600)
    assert row["hours"][-1] == pytest.approx(slowest), "with processors enough each batch waits for one episode"
    assert row["hours"][0] > 2 * row["hours"][-1], "with few the episodes count"

"""What larger clusters would give, worked out from the time of an episode."""

import pytest

from toolkit.benchmarks.cluster import CORES, paper_tables
from toolkit.benchmarks.paper import HERD, PAPER


def test_the_papers_tables_take_as_long_as_their_updates_or_their_episodes():
    rows = paper_tables(episode_s=0.5)
    assert len(rows) == sum(map(len, PAPER.values()))
    (ants,) = [row for row in rows if row["task"] == "ant-maze" and row["method"] == HERD]
    few, more, many = ants["hours"]
    assert CORES[0] == 16 and few == pytest.approx(84931 * 5 * 0.5 / 16 / 3600), "each core always plays"
    assert more == many == pytest.approx(14793 * 0.5 / 3600), "an update waits for an episode at least"
    assert ants["cores"] == 29 and 84931 / (29 / 5) <= 14793 < 84931 / (28 / 5), "the fewest processors with which that is so"

"""A run as a recording while it goes on: what it spends, and what it draws all the same."""

import pytest
from rerun_rows import entities

from toolkit.inspection.recording.recorder import SHARE, RunRecorder
from toolkit.inspection.recording.stream import Stream
from toolkit.runs.phases import landmarks, load_phases
from toolkit.runs.run import Run


@pytest.mark.slow
def test_a_running_transfer_spends_at_most_its_share(tmp_path, stored):
    """With no time at all, curves and ways are told, and of every path the landmarks at the end; a rebuild plays the rest."""
    recorder = RunRecorder(Stream(tmp_path / "a.rrd"), stored.folder, stored.merged, stored.tree(), stored.policy, stored.native, 1e-9,
                  Run.open(stored.folder).read_metrics())
    cost = recorder.finish()
    kept = landmarks([(phase, kept) for phase in load_phases(stored.folder).values() for kept in phase.episodes])
    assert 2 <= cost.drawn == len(kept) <= cost.known == 4 and 0 < SHARE <= 0.03
    assert cost.drawn == 4 or f"meta-evolve view {stored.folder} --rebuild" in str(cost)
    told = entities(tmp_path / "a.rrd")
    assert "/learning/success" in told
    captions = [row["TextDocument:text"][0] for row in told["/signals/caption"]]
    assert any("first" in text for text in captions) and any("last" in text for text in captions)

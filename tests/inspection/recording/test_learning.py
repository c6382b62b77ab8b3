"""The page of the learning: a point per record, and a sentence for what is zero all along."""

from toolkit.inspection.recording import learning, viewer
from toolkit.runs.run import Run


def test_curves_have_a_point_per_record_on_both_timelines(rows, run):
    records = Run.open(run).read_metrics()
    success = [row for row in rows["/learning/success"] if "iteration" in row]
    assert [row["Scalars:scalars"][0] for row in success] == [r["success"] for r in records if r["event"] == "check"]
    totals = [row for row in rows["/learning/sim_epochs"] if "iteration" in row]
    assert [row["iteration"] for row in totals] == list(range(1, len(records) + 1))
    assert len([row for row in rows["/learning/sim_epochs"] if "film" in row and "iteration" not in row]) == len(records)
    widths = {len(row["Scalars:scalars"]) for row in rows["/learning/success"] if "Scalars:scalars" in row}
    assert widths == {1}, "the viewer draws the first of several lines only if rows differ in length"
    assert rows["/learning/success"][0]["SeriesLines:names"] == ["path 1"], "the legend names the paths that there are, and no other"


def test_what_is_zero_all_along_has_a_sentence(rebuilt, stored):
    """The run trained nothing; its success and its wall time are curves."""
    flat = learning.flat_curves(viewer.chunks_of(rebuilt[0]))
    assert {"sim_epochs", "train_iterations", "diverged", "kl"} <= flat and not {"success", "wall"} & flat
    assert set(learning.FLAT) == set(learning.CURVES)

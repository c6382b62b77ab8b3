"""Whole recordings: of a run however far it came, of a morph, of two robots side by side."""

import json

import numpy as np
import pytest
from rerun_rows import entities, seconds

from tasks import TASKS
from toolkit.errors import ToolkitError
from toolkit.inspection.recording import excerpt, recordings, viewer
from toolkit.inspection.visual import AT_THE_TABLE
from toolkit.learning.policy import MeanActor
from toolkit.runs.phases import PhaseRecorder
from toolkit.simulation.laws import merged_plant
from toolkit.simulation.rollout import play


def test_every_page_is_there_and_small(rebuilt, rows):
    file, cost = rebuilt
    pages = {path.split("/")[1] for path in rows}
    assert {"scene", "evolution", "learning", "signals", "summary"} <= pages
    assert cost.drawn == cost.known == 4 and cost.size == file.stat().st_size < 20e6
    assert "4 of 4 episodes" in str(cost) and "MB" in str(cost)
    chunks = sum(1 for _ in viewer.reader_of(file).stream())
    assert chunks < 200, f"{chunks} chunks: viewers open a recording at once while it has few"


@pytest.mark.slow
def test_a_run_without_phases_shows_its_last_policies(tmp_path, stored):
    """An older version's run: config, tree, metrics and final policies."""
    old = tmp_path / "old"
    old.mkdir()
    for name in ("config.json", "tree.json", "metrics.jsonl"):
        (old / name).write_bytes((stored.folder / name).read_bytes())
    cost = recordings.rebuild(recordings.StoredRun(old, stored.merged, stored.policy, stored.native, stored.trained))
    assert cost.drawn == 2
    assert any("at 100% of adroit to jaco" in row["TextDocument:text"][0] for row in entities(old / "recording.rrd")["/signals/caption"])


@pytest.mark.slow
def test_what_a_stopped_run_is_stuck_on_is_shown(tmp_path, stored):
    """Its last phase has no end and no record: the episodes that it holds are played all the same."""
    import shutil

    stuck = tmp_path / "stuck"
    shutil.copytree(stored.folder, stuck, ignore=shutil.ignore_patterns("*.rrd"))
    for file in stuck.glob("phases/path-1-00[12]*"):
        file.unlink()
    records = (stuck / "metrics.jsonl").read_text().splitlines(keepends=True)
    (stuck / "metrics.jsonl").write_text("".join(records[:2]))
    played = [play(merged_plant(stored.merged, stored.merged.space.betas[1], *stored.merged.new()),
                   MeanActor(stored.policy), 11, stored.merged.space.betas[1])]
    policies = [stored.policy] * len(played)
    recorder = PhaseRecorder(stuck, TASKS["061_foam_brick"].miss, {"path 1": 1})
    recorder.record("path 1", "evolve", ["jaco"], stored.merged.space.betas[0], policies, played, False, 0)
    cost = recordings.rebuild(recordings.StoredRun(stuck, stored.merged, stored.policy, stored.native, {}))
    assert cost.drawn == cost.known == 3, "two episodes of the phase that ended, one of the phase that did not"
    texts = [row["TextDocument:text"][0] for row in entities(stuck / "recording.rrd")["/signals/caption"]]
    assert any("phase 1 (evolve)" in text and "seed 11" in text for text in texts)


def test_a_run_without_any_path_done_is_shown(tmp_path, stored):
    young = tmp_path / "young"
    young.mkdir()
    for name in ("config.json", "tree.json"):
        (young / name).write_bytes((stored.folder / name).read_bytes())
    cost = recordings.rebuild(recordings.StoredRun(young, stored.merged, stored.policy, stored.native, {}))
    assert cost.known == 0
    told = entities(young / "recording.rrd")
    assert "0 records; targets reached: none yet" in told["/summary"][-1]["TextDocument:text"][0]


def test_a_run_of_another_space_is_refused_in_one_sentence(tmp_path, stored):
    other = tmp_path / "other"
    other.mkdir()
    tree = json.loads((stored.folder / "tree.json").read_bytes())
    tree["nodes"] = [node | {"alpha": node["alpha"][:-1]} for node in tree["nodes"]]
    (other / "tree.json").write_text(json.dumps(tree))
    with pytest.raises(ToolkitError, match="another version"):
        recordings.rebuild(recordings.StoredRun(other, stored.merged, stored.policy, stored.native, {}))
    (other / "tree.json").write_text("{")
    with pytest.raises(ToolkitError, match="tree.json is damaged"):
        recordings.rebuild(recordings.StoredRun(other, stored.merged, stored.policy, stored.native, {}))
    (other / "tree.json").unlink()
    with pytest.raises(ToolkitError, match="has no tree.json yet"):
        recordings.rebuild(recordings.StoredRun(other, stored.merged, stored.policy, stored.native, {}))


def test_a_morph_follows_the_tree(tmp_path, small):
    recordings.morph(small.merged, "adroit", ["jaco"], tmp_path / "m.rrd", small.tree("l1", "steiner").to_json(), frames=6)
    told = entities(tmp_path / "m.rrd")
    frames = [row for row in told["/scene/robot/bones"] if "film" in row]
    assert len(frames) == 6 and "/signals/action" not in told
    across = [row["Points2D:positions"][0][0] for row in told["/evolution/tree/here"] if "film" in row]
    assert len(across) == 6 and across == sorted(across) and across[0] == 0 and across[-1] == pytest.approx(1000)
    texts = {seconds(row): row["TextDocument:text"][0] for row in told["/evolution/changes"]}
    assert "this is the source" in texts[0.0], "the page is whole from the first frame on"


@pytest.mark.slow
def test_two_runs_stand_side_by_side(tmp_path, stored):
    films, layout = recordings.compare([("one", stored, "jaco"), ("two", stored, "jaco")], tmp_path / "c.rrd", seed=11)
    np.testing.assert_array_equal(films[0].qpos, films[1].qpos)
    assert films[0].qpos.shape[1] == stored.native("jaco").model.nq, "the unmodified robot, of which success is claimed"
    told = entities(tmp_path / "c.rrd")
    (entity,) = [path for path in told if path.endswith("/j2s7s300_link_7")]
    places = np.array(next(row for row in told[entity] if "film" in row)["InstancePoses3D:translations"])
    np.testing.assert_allclose(places[1] - places[0], [0, AT_THE_TABLE.apart, 0], atol=1e-5)
    assert sum("Mesh3D:vertex_positions" in row for row in told[entity]) == 1, "two robots, one mesh"
    assert {"/side-1/distance", "/side-2/distance"} <= set(told)
    excerpt.excerpt(tmp_path / "c.rrd", "compare", 1.0, layout(True), tmp_path / "e.rrd")
    assert {"/side-1/caption", "/side-2/caption", "/scene/goal"} <= set(entities(tmp_path / "e.rrd"))
    with pytest.raises(ToolkitError, match="has no policy for 'iiwa' yet"):
        recordings.compare([("one", stored, "jaco"), ("two", stored, "iiwa")], tmp_path / "d.rrd", seed=11)

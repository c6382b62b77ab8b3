"""Optional outputs: recording, pictures, logs, dumps and summaries never decide what becomes of the work, and their loss is told.

The log of an arm and lost progress are in tests/cli/test_exits.py.
"""

import json
import os
import subprocess
import time

import numpy as np
import pytest

import toolkit.transfer.pipeline as pipeline
from tasks import TASKS
from toolkit.cli import main
from toolkit.cli.terminal import Progress, room_for
from toolkit.errors import ToolkitError
from toolkit.inspection.recording.stream import Stream, finish
from toolkit.inspection.recording.viewer import chunks_of
from toolkit.runs.run import Run
from toolkit.transfer.pipeline import _Guarded

POINTS = '{"source": {"name": "s", "alpha": [0, 0]}, "targets": [{"name": "a", "alpha": [1, 0]}, {"name": "b", "alpha": [0, 1]}]}'


@pytest.fixture
def small(tmp_path):
    """A disk of one megabyte; only root may mount one."""
    folder = tmp_path / "small"
    folder.mkdir()
    mounted = subprocess.run(["mount", "-t", "tmpfs", "-o", "size=1m", "t", str(folder)], capture_output=True)
    if mounted.returncode:
        pytest.skip("no disk can be mounted here")
    yield folder
    subprocess.run(["umount", "-l", str(folder)], check=True)


# -- recordings ----------------------------------------------------------------------------------------------


class Broken:
    """A recorder that fails where it is told to."""

    def __init__(self, where, error):
        self.where, self.error, self.calls = where, error, []

    def _at(self, where):
        self.calls.append(where)
        if where == self.where:
            raise self.error

    def tell(self, record):
        self._at("tell")

    def summary(self, text):
        self._at("summary")

    def finish(self):
        self._at("finish")
        return "cost: none"


ERRORS = [RuntimeError("File-writer thread shut down"), OSError(28, "No space left on device"), ToolkitError("a sentence"), MemoryError()]


@pytest.mark.parametrize("error", ERRORS, ids=repr)
@pytest.mark.parametrize("where", ["begin", "tell", "summary", "finish", "aside", "nowhere"])
def test_a_recording_that_fails_is_told_once_and_ends_nothing(tmp_path, where, error):
    recorder = Broken(where, error)

    def begin():
        recorder._at("begin")
        return recorder

    def fail():
        raise error

    told = _Guarded(tmp_path, begin)
    for _ in range(2):
        told.tell({"event": "check"})
    told.aside(fail if where == "aside" else lambda: None)
    told.summary("words")
    said = told.finish()
    assert ("not fully recorded" in said) == (where != "nowhere") and said == ("cost: none" if where == "nowhere" else said)
    after = recorder.calls[recorder.calls.index(where) + 1 :] if where in recorder.calls else []
    assert after == [], "what has failed is not asked again"
    if where == "aside":
        assert "finish" in recorder.calls, "what is kept beside the recording does not end it"


def test_what_stops_a_run_is_not_hidden_by_the_recording(tmp_path, monkeypatch):
    """A full disk stops the run by its own sentence; the recording's closing once hid it behind a traceback."""
    job = pipeline.Pipeline.__new__(pipeline.Pipeline)
    recorder, watched = Broken("finish", RuntimeError("File-writer thread shut down")), []
    job.recording = _Guarded(tmp_path, lambda: recorder)
    job._at_once, job.cluster = 1, None
    job.watch, job.engine = watched.append, type("Engine", (), {"trouble": "", "close": lambda self: None})()

    class Transfer:
        def meta_evolve(self, at_once):
            raise ToolkitError("checkpoint cannot be written (No space left on device)")

    job.transfer, job.run = Transfer(), Run.create(tmp_path / "r", {})
    with pytest.raises(ToolkitError, match="No space left on device"):
        job.play()
    assert watched[-1]["event"] == "recorded" and watched[-1]["trouble"] and "File-writer" in watched[-1]["cost"]


def test_a_lost_recording_is_told_even_where_progress_is_quiet(capsys):
    with Progress("t", quiet=True) as progress:
        seen = progress.transfer(None)
        seen({"event": "recorded", "cost": "the run is not fully recorded: x", "trouble": True})
        seen({"event": "recorded", "cost": "recording: 1 MB", "trouble": False})
    said = capsys.readouterr().err
    assert "the run is not fully recorded: x" in said and "1 MB" not in said


@pytest.mark.parametrize("size", ["1m", "3m", "36m"])
def test_a_recording_on_a_disk_that_fills_is_a_sentence(small, size):
    """It stops before the disk is full and leaves what is left to the run: rerun itself would wait for ever for its dead writer."""
    import rerun as rr

    from toolkit.inspection.recording.stream import RESERVE

    subprocess.run(["mount", "-o", f"remount,size={size}", str(small)], check=True)
    rng, path = np.random.default_rng(0), small / "recording.rrd"
    with pytest.raises(ToolkitError, match=r"recording.rrd is cut off \(No space left on device.*--rebuild"):
        stream = Stream(path)
        for k in range(1500):
            stream.row("x", k / 10, k, rr.Tensor(rng.integers(0, 255, 20_000, dtype=np.uint8)))
            if k % 10 == 0:
                stream.flush()
                time.sleep(0.01)
        stream.close()
    free = os.statvfs(small)
    if size == "36m":
        assert free.f_bavail * free.f_frsize > RESERVE - (4 << 20), "it took what it was to leave"
        stream.flush()
        assert sum(1 for _ in chunks_of(path)) > 3, "what was drawn before can be looked at"


def test_a_whole_recording_is_whole(tmp_path):
    import rerun as rr

    stream = Stream(tmp_path / "a.rrd")
    stream.row("x", 0.0, 0, rr.Scalars(1.0))
    stream.close()
    assert any(chunk.entity_path == "/x" for chunk in chunks_of(tmp_path / "a.rrd"))
    other = rr.RecordingStream("x")
    other.save(tmp_path / "b.rrd")
    other.log("x", rr.Scalars(1.0))
    finish(other, tmp_path / "b.rrd")


def test_a_dump_that_cannot_be_written_costs_no_episode(tmp_path, pair):
    from toolkit.simulation.rollout import RolloutEngine

    engine = RolloutEngine(pair.merged, threads=1, dump=tmp_path / "nosuch" / "divergence.npz")
    played = engine.play(lambda observation, rng: np.full(28, np.nan), [pair.merged.space.betas[0]] * 2, [0, 1])
    engine.close()
    assert [episode.diverged for episode in played] == [True, True]
    assert "nosuch/divergence.npz cannot be written (No such file or directory)" in engine.trouble


# -- pictures and pages ----------------------------------------------------------------------------------------


def test_a_tree_is_printed_whatever_becomes_of_its_picture(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "p.json").write_text(POINTS)

    def full(tree, path):
        raise ToolkitError(f"the plot cannot be written to {path} (No space left on device)")

    monkeypatch.setattr("toolkit.evolution.plot_tree", full)
    for json_wanted in ([], ["--json"]):
        with pytest.raises(SystemExit) as stop:
            main(["tree", "--points", "p.json", "--plot", "tree.png", *json_wanted])
        out, err = capsys.readouterr()
        assert stop.value.code == 2 and ("Length" in out or json.loads(out)["edges"]) and "tree.png" in err


@pytest.mark.parametrize("command", [
    ("tree", "--points", "p.json", "--plot"), ("match", "--plot"), ("bench", "walk", "--plot"), ("bench", "engine", "--page"),
])
@pytest.mark.parametrize("place", ["nosuch/a.png", "noending", "folder.png", "a.nosuch"])
def test_a_place_where_nothing_can_be_written_is_refused_before_the_work(tmp_path, monkeypatch, capsys, command, place):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "p.json").write_text(POINTS)
    (tmp_path / "folder.png").mkdir()
    for name in ("toolkit.cli.systems.make_lab", "toolkit.cli.benchmarks.make_lab", "toolkit.evolution.evolution_tree"):
        monkeypatch.setattr(name, lambda *_: pytest.fail("the work has begun"))
    with pytest.raises(SystemExit) as stop:
        main([*command, place])
    out, err = capsys.readouterr()
    assert stop.value.code == 2 and out == "" and place in err


def test_room_is_asked_of_the_folder(tmp_path):
    room_for(tmp_path / "a.png")
    room_for(None)
    with pytest.raises(ToolkitError, match="is no folder"):
        room_for(tmp_path / "x" / "a.png")


def test_a_trained_expert_is_reported_whatever_becomes_of_its_place(tmp_path, monkeypatch, capsys):
    """After hours: the run folder has the policy and the report, the sentence says how to save it elsewhere."""
    from toolkit.evaluation.success import Evaluation
    from toolkit.expert.training import new_learner

    monkeypatch.chdir(tmp_path)
    policy, value = new_learner(TASKS["061_foam_brick"], 0)
    monkeypatch.setattr("toolkit.cli.training.make_lab", lambda *_: type("L", (), {"merged": None})())
    monkeypatch.setattr("toolkit.simulation.rollout.RolloutEngine", lambda merged: type("E", (), {"close": lambda self: None})())
    monkeypatch.setattr("toolkit.expert.training.train_expert", lambda *_: (policy, value, {"demonstrations_kept": 3}))
    measured = Evaluation("adroit", "native", 1, 1, 0, 0)
    monkeypatch.setattr("toolkit.evaluation.success.evaluate_compiled", lambda p, robot, task, episodes, cluster: measured)
    (tmp_path / "file").write_text("")
    with pytest.raises(SystemExit) as stop:
        main(["expert", "--run", "r", "--out", "file/below", "--episodes", "1", "--compiled", "--json"])
    out, err = capsys.readouterr()
    assert stop.value.code == 2 and json.loads(out)["demonstrations_kept"] == 3
    assert "the expert is trained, but" in err and "--resume" in err
    assert (tmp_path / "r" / "report.json").is_file() and (tmp_path / "r" / "adroit.policy.safetensors").is_file()
    main(["expert", "--run", "r", "--out", "elsewhere", "--episodes", "1", "--compiled", "--json", "--resume"])
    kinds = ("json", "policy.safetensors", "value.safetensors")
    assert sorted(os.listdir("elsewhere")) == [f"adroit-061_foam_brick.{kind}" for kind in kinds]


def test_retargeted_figures_are_printed_whatever_becomes_of_the_film(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    main(["recordings", "make", "hands", "--objects", "061_foam_brick", "--each", "1"])
    capsys.readouterr()
    (tmp_path / "file").write_text("")
    with pytest.raises(SystemExit) as stop:
        main(["recordings", "retarget", "hands", "--record", "file/below.rrd", "--json"])
    out, err = capsys.readouterr()
    assert stop.value.code == 2 and len(json.loads(out)["recordings"]) == 1 and "cannot be written" in err

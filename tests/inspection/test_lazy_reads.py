"""What opens well may fail further on: every lazy read says so in one sentence, at the latest when it comes to it.

Places: recordings of older versions or with damage inside (view, stills, excerpts, layouts), a run's report, tree, records and git
state, checkpoints of another version. Files that are damaged at random are in tests/benchmarks/test_fuzz.py.
"""

import json

import numpy as np
import pytest
import rerun as rr

from tasks import TASKS
from toolkit.benchmarks.fuzz import _run_of
from toolkit.benchmarks.results import finished_runs
from toolkit.cli import main
from toolkit.errors import ToolkitError
from toolkit.inspection.recording import excerpt, viewer
from toolkit.inspection.recording.stream import Stream
from toolkit.runs.run import Run


@pytest.fixture(scope="module")
def sound(tmp_path_factory):
    path = tmp_path_factory.mktemp("rrd") / "a.rrd"
    stream = Stream(path)
    for k in range(50):
        stream.row("signals/caption", k / 10, k, rr.TextDocument(f"moment {k}"))
    stream.close()
    return path.read_bytes()



HARM = {
    "version 0.10": (lambda b: b[:4] + bytes([0, 10, 0, 0]) + b[8:], "written by another version of Rerun"),
    "version 0.22": (lambda b: b[:4] + bytes([0, 22, 1, 0]) + b[8:], "written by another version of Rerun"),
    "an old format": (lambda b: b"RRF0" + b[4:], "written by an old version of Rerun"),
    "cut in half": (lambda b: b[: len(b) // 2], "is cut off"),
    "a hole": (lambda b: b[: len(b) // 3] + bytes(64) + b[len(b) // 3 + 64 :], "damaged|cut off"),
    "its head alone": (lambda b: b[:12], "is cut off"),
    "another file": (lambda b: b"PNG" + b[3:], "is not a Rerun recording"),
    "nothing": (lambda b: b"", "is not a Rerun recording"),
}


@pytest.mark.parametrize("name", HARM)
def test_a_recording_that_opens_and_cannot_be_read(tmp_path, sound, name, capsys):
    harm, said = HARM[name]
    path = tmp_path / "a.rrd"
    path.write_bytes(harm(sound))
    with pytest.raises(ToolkitError, match=said):
        list(viewer.chunks_of(path))
    with pytest.raises(ToolkitError, match=said):
        excerpt.moment_of(path, None, "rollouts")
    with pytest.raises(ToolkitError, match=said):
        excerpt.excerpt(path, "rollouts", 1.0, None, tmp_path / "o.rrd")
    with pytest.raises(SystemExit) as stop:
        main(["view", str(path)])
    assert stop.value.code == 2 and len(capsys.readouterr().err.splitlines()) == 1


def test_a_sound_recording_is_read(tmp_path, sound):
    (tmp_path / "a.rrd").write_bytes(sound)
    assert viewer.recording_of(tmp_path / "a.rrd") == tmp_path / "a.rrd"
    assert excerpt.moment_of(tmp_path / "a.rrd", None, "rollouts") == pytest.approx(4.9)


def test_a_recording_that_breaks_its_reader_down(tmp_path, sound, monkeypatch):
    """Rerun's reader ends its process on some damage; it is asked in one that may end."""
    (tmp_path / "a.rrd").write_bytes(sound)
    breaks = tmp_path / "breaks"
    breaks.write_text("#!/bin/sh\nkill -ABRT $$\n")
    breaks.chmod(0o755)
    monkeypatch.setattr(viewer, "viewer_program", lambda: breaks)
    with pytest.raises(ToolkitError, match="its reader breaks down"):
        viewer.reader_of(tmp_path / "a.rrd")


TEXTS = ("[]", "{}", "null", "3", '"x"', "{", '{"targets": {"a": []}}', '{"targets": {"a": {"native": {}}}}')


@pytest.mark.parametrize("name", ["report", "tree", "git"])
@pytest.mark.parametrize("text", TEXTS)
def test_a_run_with_a_file_that_says_something_else(tmp_path, capsys, name, text):
    run = _run_of(tmp_path)
    (run.path / f"{name}.json").write_text(text)
    broken = []
    found = finished_runs(tmp_path, broken.append)
    if (name, text) == ("git", "null"):
        assert found[0].commit == "unknown"
        return
    assert found == [] and len(broken) == 1 and f"{name}.json" in broken[0]


@pytest.mark.parametrize("command", [("report",), ("view", "--rebuild"), ("evaluate",), ("export", "--target", "a", "--out", "o")])
@pytest.mark.parametrize("text", ["[]", '{"source": 3, "targets": 3, "task": 3}', "{"])
def test_commands_on_a_run_whose_config_says_something_else(tmp_path, capsys, monkeypatch, command, text):
    monkeypatch.chdir(tmp_path)
    run = _run_of(tmp_path)
    (run.path / "config.json").write_text(text)
    with pytest.raises(SystemExit) as stop:
        main([command[0], str(run.path), *command[1:]])
    err = capsys.readouterr().err
    assert stop.value.code == 2 and "config.json" in err and len(err.splitlines()) == 1


@pytest.mark.parametrize("command", [("report",), ("export", "--target", "kinova3", "--out", "o")])
@pytest.mark.parametrize("file, text", [("report.json", "[]"), ("tree.json", "[]"), ("metrics.jsonl", "[]\n"), ("metrics.jsonl", "{}\n")])
def test_commands_on_a_run_whose_files_say_something_else(tmp_path, capsys, monkeypatch, command, file, text):
    """Of real robots, so that the command comes as far as these files; and that before an episode is played."""
    if (command[0], file) == ("export", "metrics.jsonl"):
        return  # an export asks no records
    from toolkit.cli import inspection
    from toolkit.expert.training import new_learner

    monkeypatch.chdir(tmp_path)
    run = _run_of(tmp_path)
    config = json.loads((run.path / "config.json").read_text()) | {"source": "adroit", "targets": ["kinova3"], "task": "061_foam_brick"}
    (run.path / "config.json").write_text(json.dumps(config))
    new_learner(TASKS["061_foam_brick"], 0)[0].save(run.path / "kinova3.policy.safetensors")

    class StoredRun:
        merged = None

        def tree(self):
            from toolkit.runs.run import read_tree

            return read_tree(run.path)

    monkeypatch.setattr(inspection, "stored_run", lambda folder: StoredRun())
    monkeypatch.setattr("toolkit.export.labels.evaluate_native", lambda *_, **__: pytest.fail("an export played before it read the run"))
    (run.path / file).write_text(text)
    with pytest.raises(SystemExit) as stop:
        main([command[0], str(run.path), *command[1:]])
    err = capsys.readouterr().err.splitlines()[-1]
    assert stop.value.code == 2 and file in err, err


@pytest.mark.parametrize("state", [
    {}, {"updates": 3}, {"updates": [], "rounds": 0, "cloned": True, "card": {}, "records": 0, "rng": {}, "rows": 0},
])
def test_an_experts_checkpoint_of_another_version(tmp_path, state):
    from toolkit.expert.training import ExpertConfig, _Training, learner_tensors, new_learner

    run = Run.create(tmp_path / "r", {})
    policy, value = new_learner(TASKS["061_foam_brick"], 0)
    run.save_checkpoint("expert", learner_tensors("expert", policy, value), state)
    task = TASKS["061_foam_brick"]
    training = _Training(None, task, None, ExpertConfig(), policy, value, np.random.default_rng(0), False, lambda record: None, run)
    with pytest.raises(ToolkitError, match="another version|random generator"):
        training.restore()
    run.save_checkpoint("expert", {"x": np.zeros(2)}, state)
    with pytest.raises(ToolkitError, match="another version"):
        training.restore()

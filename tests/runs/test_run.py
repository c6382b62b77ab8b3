"""A run folder survives kills, and refuses what is not the same run."""

import json
import os
import platform
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from toolkit.errors import ToolkitError
from toolkit.runs.run import Run, paths_to, read_report, read_tree, transfer_records

CONFIG = {"seed": 3, "targets": ("jaco", "iiwa"), "learner": {"step": 0.05, "layers": [32, 32]}}


def test_create_explains_the_run(tmp_path: Path) -> None:
    run = Run.create(tmp_path / "logs" / "a", CONFIG)
    versions = json.loads((run.path / "versions.json").read_text())
    assert versions["python"] == platform.python_version() and {"mujoco", "torch", "numba", "platform"} <= set(versions)
    assert str(tmp_path) not in (run.path / "versions.json").read_text() and platform.node() not in versions["platform"]
    git = json.loads((run.path / "git.json").read_text())
    assert git is None or (len(git["commit"]) == 40 and isinstance(git["dirty"], bool))
    assert Run.open(run.path, CONFIG).config == run.config


def test_create_refuses_a_used_folder(tmp_path: Path) -> None:
    Run.create(tmp_path / "a", CONFIG)
    with pytest.raises(ToolkitError, match="exists; add --resume to continue it, or choose another --run"):
        Run.create(tmp_path / "a", CONFIG)
    (tmp_path / "file").write_text("")
    for path in (tmp_path / "file", tmp_path / "file" / "below"):
        with pytest.raises(ToolkitError, match="is a file or lies below one"):
            Run.create(path, CONFIG)


@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() == 0, reason="root may write anywhere")
def test_create_in_an_unwritable_folder(tmp_path: Path) -> None:
    tmp_path.chmod(0o500)
    with pytest.raises(ToolkitError, match="cannot be written"):
        Run.create(tmp_path / "a", CONFIG)


def test_open_names_the_first_differing_key(tmp_path: Path) -> None:
    Run.create(tmp_path / "a", CONFIG)
    with pytest.raises(ToolkitError, match=r"learner\.step = 0\.05, not 0\.1"):
        Run.open(tmp_path / "a", CONFIG | {"learner": {"step": 0.1, "layers": [32, 32]}})
    with pytest.raises(ToolkitError, match=r"extra = \(absent\), not 1"):
        Run.open(tmp_path / "a", CONFIG | {"extra": 1})


@pytest.mark.parametrize("text, complaint", [('{"seed": 3, "targ', "truncated"), ("[1]", "no JSON object"), (None, "holds no config.json")])
def test_open_refuses_a_broken_config(tmp_path: Path, text: str | None, complaint: str) -> None:
    Run.create(tmp_path / "a", CONFIG)
    (tmp_path / "a" / "config.json").unlink()
    if text is not None:
        (tmp_path / "a" / "config.json").write_text(text)
    with pytest.raises(ToolkitError, match=complaint):
        Run.open(tmp_path / "a", CONFIG)
    with pytest.raises(ToolkitError, match="does not exist"):
        Run.open(tmp_path / "b", CONFIG)


@settings(max_examples=25, deadline=None)
@given(total=st.integers(1, 8), checkpoint=st.integers(0, 7), torn=st.integers(0, 40))
def test_killed_and_resumed_metrics_equal_unbroken_ones(
    tmp_path_factory: pytest.TempPathFactory, total: int, checkpoint: int, torn: int
) -> None:
    folder = tmp_path_factory.mktemp("metrics")
    records = [{"iteration": i, "success": np.float64(i / 3), "kl": float("nan")} for i in range(total)]
    whole, killed = Run.create(folder / "whole", {}), Run.create(folder / "killed", {})
    checkpoint = min(checkpoint, total)
    for record in records:
        whole.append_metrics(record)
        killed.append_metrics(record)
    with open(killed.path / "metrics.jsonl", "ab") as file:
        file.write(b'{"iteration": 99, "success": 0.123456789012345}'[:torn])
    looked_at = (killed.path / "metrics.jsonl").read_bytes()
    assert len(Run.open(killed.path).read_metrics()) == total
    assert (killed.path / "metrics.jsonl").read_bytes() == looked_at, "who only looks writes nothing: the run may be going on"
    resumed = Run.open(killed.path, {})
    assert len(resumed.read_metrics()) == total
    resumed.truncate_metrics(checkpoint)
    for record in records[checkpoint:]:
        resumed.append_metrics(record)
    assert (killed.path / "metrics.jsonl").read_bytes() == (whole.path / "metrics.jsonl").read_bytes()
    assert resumed.read_metrics()[0]["kl"] is None


def test_broken_metrics_are_named(tmp_path: Path) -> None:
    run = Run.create(tmp_path / "a", {})
    run.append_metrics({"i": 0})
    with pytest.raises(ToolkitError, match="holds 1 records but the checkpoint was saved after 2"):
        run.truncate_metrics(2)
    (run.path / "metrics.jsonl").write_text('{"i": 0}\nrubbish\n{"i": 1}\n')
    with pytest.raises(ToolkitError, match="line 2"):
        Run.open(run.path, {})


def test_checkpoint_round_trip(tmp_path: Path) -> None:
    run = Run.create(tmp_path / "a", {})
    tensors = {
        "weights": np.arange(12, dtype=np.float32).reshape(3, 4).T,  # not contiguous
        "scalar": np.array(1.5),
        "empty": np.empty((0, 3)),
        "counts": np.array([1, 2], dtype=np.int64),
    }
    run.save_checkpoint("iteration-3", tensors, {"iteration": 3, "best": float("nan"), "path": ["a", "b"]})
    assert run.checkpoints() == ["iteration-3"]
    loaded, state = run.load_checkpoint("iteration-3")
    for key, tensor in tensors.items():
        np.testing.assert_array_equal(loaded[key], tensor, strict=True)
    assert state["iteration"] == 3 and np.isnan(state["best"]) and state["path"] == ["a", "b"]


def test_a_kill_before_the_rename_leaves_the_old_checkpoint(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run = Run.create(tmp_path / "a", {})
    run.save_checkpoint("latest", {"x": np.zeros(3)}, {"iteration": 1})

    def killed(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(os, "replace", killed)
    with pytest.raises(KeyboardInterrupt):
        run.save_checkpoint("latest", {"x": np.ones(3)}, {"iteration": 2})
    monkeypatch.undo()
    resumed = Run.open(run.path)
    assert resumed.checkpoints() == ["latest"]
    tensors, state = resumed.load_checkpoint("latest")
    assert state == {"iteration": 1} and not tensors["x"].any()
    resumed.save_checkpoint("latest", {"x": np.ones(3)}, {"iteration": 2})
    assert resumed.load_checkpoint("latest")[1] == {"iteration": 2}


def test_broken_checkpoints_are_named(tmp_path: Path) -> None:
    from safetensors.numpy import save_file

    run = Run.create(tmp_path / "a", {})
    file = run.save_checkpoint("c", {"x": np.arange(100.0)}, {"iteration": 1})
    data = file.read_bytes()
    for length in (0, 4, 60, len(data) - 1):
        file.write_bytes(data[:length])
        with pytest.raises(ToolkitError, match="c.safetensors.*delete it"):
            run.load_checkpoint("c")
    save_file({"x": np.zeros(2)}, file)
    with pytest.raises(ToolkitError, match="not ours"):
        run.load_checkpoint("c")
    with pytest.raises(ToolkitError, match="this run has: c"):
        run.load_checkpoint("d")
    with pytest.raises(ToolkitError, match="plain file name"):
        run.load_checkpoint("../c")


def test_report_and_summary(tmp_path: Path) -> None:
    run = Run.create(tmp_path / "a", {})
    run.write_json("report", {"success_rate": np.float32(0.5), "worst": float("inf"), "ci95": np.array([0.4, 0.6])})
    run.write_summary("# Done\n")
    assert json.loads((run.path / "report.json").read_text()) == {"success_rate": 0.5, "worst": None, "ci95": [0.4, 0.6]}
    assert (run.path / "summary.md").read_text() == "# Done\n"
    with pytest.raises(ToolkitError, match="cannot be stored as JSON"):
        run.write_json("report", {"object": object()})


@pytest.mark.parametrize("name", ["report", "tree"])
@pytest.mark.parametrize("text", ["[]", "{}", "null", "3", '{"targets": []}', '{"nodes": [], "edges": []}', "{", '{"nodes": {"a": 1}}'])
def test_a_run_file_that_opens_and_says_nothing(tmp_path, name, text):
    (tmp_path / f"{name}.json").write_text(text)
    with pytest.raises(ToolkitError, match=f"{name}.json"):
        {"report": read_report, "tree": read_tree}[name](tmp_path)


@pytest.mark.parametrize("line", [
    "{}", '{"event": "check"}', '{"event": "check", "path": "path 1", "stage": "evolve", "success": "high"}', "[]",
])
def test_a_record_that_lacks_what_is_drawn(tmp_path, line):
    run = Run.create(tmp_path / "r", {})
    (run.path / "metrics.jsonl").write_text(line + "\n")
    with pytest.raises(ToolkitError, match="metrics.jsonl line 1"):
        transfer_records(run)


@pytest.mark.parametrize(("target", "paths"), [
    ("jaco", ["path 1.1", "path 1"]),  # not path 1.2, which has left from the same fork
    ("iiwa", ["path 1.2.2", "path 1.2", "path 1"]),
    ("panda", ["path 1.2.2.0"]),  # set out from the source
    ("ur5e", ["path 1.2.3", "path 1.1", "path 1"]),  # from the Jaco
    ("sawyer", []),
])
def test_the_way_to_a_target_is_of_the_paths_that_lead_there(target, paths):
    routes = {
        "path 1": ["adroit"], "path 1.1": ["adroit", "meta", "jaco"], "path 1.2": ["adroit", "meta"],
        "path 1.2.1": ["adroit", "meta", "meta", "kinova3"], "path 1.2.2": ["adroit", "meta", "meta", "iiwa"],
        "path 1.2.2.0": ["adroit", "panda"], "path 1.2.3": ["adroit", "meta", "jaco", "ur5e"],
    }
    assert paths_to(routes, target) == paths

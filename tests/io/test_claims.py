"""Two writers, and starts that fail: one process works in a folder, a crash leaves no claim, and neither does a failed start.

Places: transfer and expert (run folders), view --rebuild, export, recordings make, deploy --log.
"""

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from tasks import TASKS
from toolkit import cli
from toolkit.cli import main
from toolkit.errors import ToolkitError
from toolkit.io import claims
from toolkit.io.claims import LOCK, claim, claim_file, give_up, is_claimed
from toolkit.runs.run import Run

ROOT = Path(cli.__file__).parents[2]
BRICK = "061_foam_brick"


@pytest.fixture(autouse=True)
def at_home(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PYTHONPATH", str(ROOT))


def other(code):
    """Another process, which has run some code and now waits."""
    process = subprocess.Popen([sys.executable, "-c", code + "\nprint('there', flush=True)\nimport time\ntime.sleep(600)"],
                               stdout=subprocess.PIPE, text=True)
    assert process.stdout.readline().strip() == "there"
    return process


def refusal(capsys, *words):
    with pytest.raises(SystemExit) as stop:
        main([*map(str, words)])
    out, err = capsys.readouterr()
    assert stop.value.code == 2 and "Traceback" not in err, err
    return err.splitlines()[-1]


# -- the claim -----------------------------------------------------------------------------------------------


def test_a_second_process_is_refused_by_the_name_of_the_first(tmp_path):
    holder = other(f"from pathlib import Path\nfrom toolkit.io.claims import claim\nclaim(Path({str(tmp_path)!r}), 'wait')")
    try:
        with pytest.raises(ToolkitError, match=f"is being written by process {holder.pid} on .*; mend it"):
            claim(tmp_path, "mend it")
        assert is_claimed(tmp_path)
    finally:
        holder.kill()
        holder.wait()
    assert (tmp_path / LOCK).exists(), "the file lies about"
    assert not is_claimed(tmp_path)
    claim(tmp_path, "mend it")  # and is no claim
    assert is_claimed(tmp_path)
    give_up(tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_a_process_may_claim_again_and_give_up_twice(tmp_path):
    for _ in range(3):
        claim(tmp_path, "")
    give_up(tmp_path)
    give_up(tmp_path)
    assert not is_claimed(tmp_path) and not (tmp_path / LOCK).exists()


def test_a_folder_that_was_made_again_is_claimed_again(tmp_path):
    folder = tmp_path / "f"
    for _ in range(2):
        folder.mkdir()
        claim(folder, "")
        (folder / LOCK).unlink()
        folder.rmdir()
    folder.mkdir()
    assert not is_claimed(folder)
    claim(folder, "")
    assert is_claimed(folder)
    give_up(folder)


def test_of_many_at_once_one_wins(tmp_path):
    code = (
        "import sys, time\nfrom pathlib import Path\nfrom toolkit.io.claims import claim\nfrom toolkit.errors import ToolkitError\n"
        f"try: claim(Path({str(tmp_path)!r}), '')\nexcept ToolkitError: sys.exit(3)\ntime.sleep(3)\n"
    )
    racing = [subprocess.Popen([sys.executable, "-c", code]) for _ in range(6)]
    assert sorted(process.wait() for process in racing) == [0] + [3] * 5
    assert not is_claimed(tmp_path)


def test_without_locks_nothing_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(claims, "fcntl", None)
    claim(tmp_path, "")
    assert not is_claimed(tmp_path) and list(tmp_path.iterdir()) == []


def test_a_file_has_one_writer(tmp_path):
    with open(tmp_path / "log", "a") as first, open(tmp_path / "log", "a") as second:
        claim_file(first, "")
        with pytest.raises(ToolkitError, match="log is being written by another process; give another"):
            claim_file(second, "give another")


# -- run folders ---------------------------------------------------------------------------------------------


def test_two_sittings_of_one_run(tmp_path):
    Run.create(tmp_path / "r", {"a": 1}).end()
    holder = other(f"from toolkit.runs.run import Run\nrun = Run.open({str(tmp_path / 'r')!r}, {{'a': 1}})")
    try:
        with pytest.raises(ToolkitError, match=f"is being written by process {holder.pid}"):
            Run.open(tmp_path / "r", {"a": 1})
        with pytest.raises(ToolkitError, match=f"is being written by process {holder.pid}"):
            Run.create(tmp_path / "r", {"a": 1})
        assert Run.open(tmp_path / "r").config == {"a": 1}, "looking is free"
    finally:
        holder.send_signal(signal.SIGKILL)
        holder.wait()
    Run.open(tmp_path / "r", {"a": 1}).end()
    assert not (tmp_path / "r" / LOCK).exists()


@pytest.mark.parametrize("command", [("transfer", "--targets", "kinova3"), ("expert",)])
def test_resuming_twice_is_refused_at_once(tmp_path, capsys, command):
    """Both once trained, and their metrics interleaved."""
    from toolkit.cli.suites import Entry

    asked = Entry(targets=("kinova3",), episodes=40, expert=f"adroit-{BRICK}-wide-recordings")
    config = asked.job("quick").config() if command[0] == "transfer" else {
        "source": "adroit", "task": BRICK, "demos": None, "frame_rate": 25.0, "seed": 0, "updates": 6, "demonstrations": 160}
    Run.create(tmp_path / "r", config).end()
    holder = other(f"from pathlib import Path\nfrom toolkit.io.claims import claim\nclaim(Path({str(tmp_path / 'r')!r}), '')")
    try:
        assert f"process {holder.pid}" in refusal(capsys, *command, "--run", "r", "--resume")
        assert f"process {holder.pid}" in refusal(capsys, *command, "--run", "r")
    finally:
        holder.kill()
        holder.wait()


def test_the_recording_of_a_running_transfer_is_not_made_anew(tmp_path, monkeypatch, capsys):
    from toolkit.cli import inspection
    from toolkit.inspection.recording import recordings

    (tmp_path / "r").mkdir()
    monkeypatch.setattr(inspection, "stored_run", lambda path: None)
    monkeypatch.setattr(recordings, "rebuild", lambda known, file: f"made {file}")
    holder = other(f"from pathlib import Path\nfrom toolkit.io.claims import claim\nclaim(Path({str(tmp_path / 'r')!r}), '')")
    try:
        with pytest.raises(ToolkitError, match="--live, or give --out"):
            inspection._recording(tmp_path / "r", True, None)
        assert inspection._recording(tmp_path / "r", True, tmp_path / "o.rrd") == tmp_path / "o.rrd"
    finally:
        holder.kill()
        holder.wait()
    assert inspection._recording(tmp_path / "r", True, None) == tmp_path / "r" / "recording.rrd"
    assert not is_claimed(tmp_path / "r")


# -- starts that fail ----------------------------------------------------------------------------------------


def test_a_transfer_whose_preparation_fails_leaves_no_folder(tmp_path, monkeypatch, capsys):
    import toolkit.transfer.pipeline as pipeline
    from toolkit.expert.training import new_learner

    monkeypatch.setattr(pipeline, "load_expert", lambda source, task, name: new_learner(task, 0))

    def fail(*_):
        raise ToolkitError("the merged robot does not compile")

    monkeypatch.setattr(pipeline, "Lab", fail)
    for _ in range(2):
        assert "does not compile" in refusal(capsys, "transfer", "--targets", "kinova3", "--run", "logs/new/r")
        assert list(tmp_path.iterdir()) == [], "nor the folders above it that were made for it"
    (tmp_path / "logs").mkdir()
    refusal(capsys, "transfer", "--targets", "kinova3", "--run", "logs/r")
    assert list((tmp_path / "logs").iterdir()) == []


def test_an_expert_that_cannot_begin_leaves_no_folder(tmp_path, monkeypatch, capsys):
    from toolkit.cli import training

    def fail(*_):
        raise ToolkitError("no robot")

    monkeypatch.setattr(training, "make_lab", fail)
    for _ in range(2):
        assert "no robot" in refusal(capsys, "expert", "--run", "r")
        assert list(tmp_path.iterdir()) == []


def test_a_start_that_came_to_something_is_kept(tmp_path):
    run = Run.create(tmp_path / "r", {})
    with pytest.raises(ToolkitError), run.at_work():
        run.append_metrics({"event": "x"})
        run.save_checkpoint("c", {"x": np.ones(2)}, {})
        raise ToolkitError("later")
    assert Run.open(tmp_path / "r").checkpoints() == ["c"] and not is_claimed(tmp_path / "r")


def test_ctrl_c_leaves_a_run_to_resume(tmp_path):
    run = Run.create(tmp_path / "r", {"a": 1})
    with pytest.raises(KeyboardInterrupt), run.at_work():
        raise KeyboardInterrupt
    Run.open(tmp_path / "r", {"a": 1}).end()


def test_a_resumed_run_that_fails_is_kept(tmp_path):
    Run.create(tmp_path / "r", {"a": 1}).end()
    run = Run.open(tmp_path / "r", {"a": 1})
    with pytest.raises(ToolkitError), run.at_work():
        raise ToolkitError("again")
    assert (tmp_path / "r" / "config.json").exists()


def test_a_folder_with_other_files_is_left_as_it_was(tmp_path):
    (tmp_path / "r").mkdir()
    (tmp_path / "r" / "mine.txt").write_text("mine")
    with pytest.raises(ToolkitError, match="exists; add --resume"):
        Run.create(tmp_path / "r", {})
    with pytest.raises(ToolkitError):
        Run.create(tmp_path / "s", {"a": object()})
    assert [str(file.relative_to(tmp_path)) for file in sorted(tmp_path.rglob("*"))] == ["r", "r/mine.txt"]


def test_an_export_that_fails_leaves_an_earlier_bundle_whole(tmp_path, task, monkeypatch):
    import zipfile

    from robots import ROBOTS
    from toolkit.bundle.manifest import Lineage, Success
    from toolkit.bundle.reading import SHIPPED, load_bundle
    from toolkit.expert.shelf import load_expert
    from toolkit.export import packing

    with zipfile.ZipFile(SHIPPED / "kinova3.zip") as archive:
        archive.extractall(tmp_path)
    (tmp_path / "kinova3.zip").write_bytes((SHIPPED / "kinova3.zip").read_bytes())
    before = {file: file.read_bytes() for file in tmp_path.rglob("*") if file.is_file()}
    lineage = Lineage("adroit", ("kinova3",), (0.0,), "steiner", "l1", 0, 0)
    arguments = (load_expert("adroit", TASKS["061_foam_brick"])[0], ROBOTS["kinova3"], task, {}, lineage,
                 Success(1, 1, 1.0, (0.2, 1.0), 0, "x"))

    def fail(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(packing, "_describe", fail)
    with pytest.raises(ToolkitError, match="No space left on device"):
        packing.write_bundle(*arguments, tmp_path / "kinova3")
    assert {file: file.read_bytes() for file in tmp_path.rglob("*") if file.is_file()} == before
    load_bundle(tmp_path / "kinova3")
    with pytest.raises(ToolkitError, match="No space left on device"):
        packing.write_bundle(*arguments, tmp_path / "new")
    assert not (tmp_path / "new").exists(), "nor does it leave an empty folder"
    holder = other(f"from pathlib import Path\nfrom toolkit.io.claims import claim\nclaim(Path({str(tmp_path / 'kinova3')!r}), '')")
    try:
        with pytest.raises(ToolkitError, match=f"process {holder.pid}"):
            packing.write_bundle(*arguments, tmp_path / "kinova3")
    finally:
        holder.kill()
        holder.wait()


@pytest.mark.parametrize("error", [OSError(28, "No space left on device"), KeyboardInterrupt()], ids=repr)
def test_recordings_appear_whole_or_not_at_all(tmp_path, monkeypatch, error):
    from tasks.dexycb import standin as dexycb_standin

    written = dexycb_standin._write_take
    made = []

    def fail(*arguments):
        made.append(1)
        if len(made) == 2:
            raise error
        written(*arguments)

    monkeypatch.setattr(dexycb_standin, "_write_take", fail)
    with pytest.raises(type(error)):
        dexycb_standin.write_standin(tmp_path / "hands", [BRICK], 3, 0, 12)
    assert list(tmp_path.iterdir()) == []
    (tmp_path / "hands").mkdir()
    assert len(dexycb_standin.write_standin(tmp_path / "hands", [BRICK], 2, 0, 12)) == 2
    assert sorted(file.name for file in tmp_path.iterdir()) == ["hands"]


def test_two_deployments_with_one_log(tmp_path):
    from toolkit.deploy.runtime import TickLog

    (tmp_path / "log.jsonl").write_text("an older one\n" * 100)
    first = TickLog(tmp_path / "log.jsonl", {"robot": "a"})
    first.note(0, "x", "1")
    with pytest.raises(ToolkitError, match="is being written by another process; give another --log"):
        TickLog(tmp_path / "log.jsonl", {"robot": "b"})
    first.close()
    rows = [json.loads(line) for line in (tmp_path / "log.jsonl").read_text().splitlines()]
    assert [row.get("robot") or row.get("x") for row in rows] == ["a", "1"]
    TickLog(tmp_path / "log.jsonl", {"robot": "b"}).close()
    assert os.path.getsize(tmp_path / "log.jsonl") < 200

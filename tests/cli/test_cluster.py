"""`--cluster` on the command line: each command leaves what it leaves without, file by file and bit by bit, but for times.

The cluster is two nodes with a processor each, begun by `ray start`.
"""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from ray_nodes import Nodes, ray

from toolkit.benchmarks import paper
from toolkit.cli import benchmarks, suites
from toolkit.cli.app import main
from toolkit.runs.run import Run
from toolkit.simulation.cluster import _answers

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("log_elsewhere")]
TIMING = {"episodes_per_s", "play_s", "learn_s", "seconds"}
TIMED = [f"checkpoints/{name}.safetensors" for name in ("transfer", "expert")]
APART = {"metrics.jsonl", "report.json", "summary.md", "recording.rrd", *TIMED}
"""Files that say how long something took, or when."""
TRANSFER = ["transfer", "--task", "ant-maze", "--source", "ant", "--targets", "ant-1", "ant-2", "--kind", "independent", "--budget", "40",
            "--episodes", "2"]
"""Two paths, of which one has to learn."""


@pytest.fixture(scope="module")
def address(tmp_path_factory, wait_for):
    nodes = Nodes(tmp_path_factory.mktemp("nodes"))
    nodes.start(1, head=True)
    wait_for(lambda: _answers(nodes.address), 120.0)
    nodes.start(1)
    yield nodes.address
    nodes.end()


def timeless(value):
    """A JSON value without what tells of time."""
    if isinstance(value, dict):
        return {key: timeless(one) for key, one in value.items() if key not in (*TIMING, "wall_s", "time")}
    return [timeless(one) for one in value] if isinstance(value, list) else value


def by_path(folder):
    """Path -> its metrics in their order; those of paths that are played side by side interleave."""
    found = {}
    for record in Run.open(folder).read_metrics():
        found.setdefault(record.get("path", ""), []).append(timeless(record))
    return found


def assert_same_run(one, other, left_out=()):
    """Whether two run folders hold the same: every file of the one is in the other."""
    files = lambda folder: {str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file()} - set(left_out)  # noqa: E731
    assert files(one) == files(other)
    for name in files(one) - APART:
        assert (one / name).read_bytes() == (other / name).read_bytes(), f"{name} differs"
    assert by_path(one) == by_path(other), "the metrics of a path differ"
    for name in ("transfer", "expert"):
        if (one / "checkpoints" / f"{name}.safetensors").is_file():
            (tensors, state), (others, after) = (Run.open(folder).load_checkpoint(name) for folder in (one, other))
            assert timeless(state) == timeless(after) and set(tensors) == set(others)
            for key, tensor in tensors.items():
                np.testing.assert_array_equal(tensor, others[key], err_msg=f"{name}: {key}")
    mine, theirs = (timeless(json.loads((folder / "report.json").read_text())) for folder in (one, other))
    assert mine == theirs
    clock = lambda folder: [line for line in (folder / "summary.md").read_text().splitlines() if not line.startswith("Wall time")]  # noqa: E731
    if (one / "summary.md").is_file():
        assert clock(one) == clock(other)


@pytest.fixture(scope="module")
def here(tmp_path_factory):
    """The transfer on this machine."""
    folder = tmp_path_factory.mktemp("here") / "run"
    main([*TRANSFER, "--run", str(folder), "--json"])
    return folder


def test_a_transfer_leaves_the_same_files(address, here, tmp_path, capsys):
    main([*TRANSFER, "--run", str(tmp_path / "run"), "--cluster", address, "--json"])
    assert_same_run(here, tmp_path / "run")
    report = json.loads((here / "report.json").read_text())
    assert report["totals"]["train_iterations"] > 0, "nothing was learned, and nothing was proven"
    assert timeless(json.loads(capsys.readouterr().out)) == timeless(report)


@pytest.mark.parametrize("more", [[], ["--native"]], ids=["merged", "native"])
def test_an_evaluation_says_the_same(address, here, capsys, more):
    found = []
    for where in ([], ["--cluster", address]):
        main(["evaluate", str(here), "--episodes", "6", "--seed", "3", *more, *where, "--json"])
        found.append(json.loads(capsys.readouterr().out))
    assert found[0] == found[1] and len(found[0]) == 2
    assert 0 < sum(one["successes"] for one in found[0]) < 12, "all episodes end alike: nothing was proven"


def test_an_expert_learns_the_same(address, tmp_path, capsys):
    """From scripted demonstrations, at a task of its own beside the source's, then by rewards."""
    cards = []
    for name, where in (("here", []), ("there", ["--cluster", address])):
        main(["expert", "--demonstrations", "6", "--updates", "1", "--episodes", "2", "--run", str(tmp_path / name), "--out",
              str(tmp_path / f"{name}-shelf"), "--json", *where])
        cards.append(json.loads(capsys.readouterr().out))
    assert cards[0] == cards[1] and cards[0]["demonstrations_kept"] > 0
    assert_same_run(tmp_path / "here", tmp_path / "there")
    for file in (tmp_path / "here-shelf").iterdir():
        assert file.read_bytes() == (tmp_path / "there-shelf" / file.name).read_bytes(), f"{file.name} differs"


def test_a_suite_leaves_the_same_runs_and_page(address, tmp_path, monkeypatch, capsys):
    """Its runs side by side on the cluster, one after the other without."""
    ant = suites.Entry(task="ant-maze", source="ant", targets=("ant-1",), episodes=2, budget=20)
    entries = {f"run-{seed}": suites.Entry(**vars(ant) | {"seed": seed}) for seed in range(3)}
    monkeypatch.setattr(benchmarks, "SUITES", {"ant": suites.Suite("Ants", tmp_path / "usual", entries)})
    monkeypatch.setitem(paper.PAPER, "ant", ())
    found = []
    for name, where in (("here", []), ("there", ["--cluster", address, "--at-once", "3"])):
        main(["bench", "transfer", "--suite", "ant", "--preset", "quick", "--out", str(tmp_path / name), "--json", *where])
        found.append(timeless(json.loads(capsys.readouterr().out)))
    assert found[0]["rows"] and without_minutes(found[0]) == without_minutes(found[1])
    for name in entries:
        assert_same_run(tmp_path / "here" / name, tmp_path / "there" / name)


def without_minutes(value):
    if isinstance(value, dict):
        return {key: without_minutes(one) for key, one in value.items() if "minutes" not in key and "wall" not in key}
    return [without_minutes(one) for one in value] if isinstance(value, list) else value


def test_ctrl_c_leaves_a_run_to_be_continued_and_a_tidy_cluster(address, here, tmp_path, wait_for):
    """In the middle of both paths; continued without the cluster, it comes to what a run that nobody stopped comes to."""
    folder = tmp_path / "run"
    command = [sys.executable, "-m", "toolkit.cli", *TRANSFER, "--run", str(folder)]
    process = subprocess.Popen([*command, "--cluster", address], stderr=subprocess.PIPE, text=True, start_new_session=True)
    metrics = folder / "metrics.jsonl"
    wait_for(lambda: process.poll() is not None or (metrics.is_file() and metrics.read_text().count("\n") > 6), 300.0)
    assert process.poll() is None, process.stderr.read()
    began = time.monotonic()
    os.kill(process.pid, signal.SIGINT)
    _, said = process.communicate(timeout=120.0)
    assert process.returncode == 130 and said.splitlines()[-1].endswith("--resume"), said
    assert time.monotonic() - began < 60.0
    assert not (folder / "report.json").is_file()
    ray.init(address=address, log_to_driver=False, logging_level="ERROR")
    try:
        wait_for(lambda: ray.available_resources().get("CPU") == 2.0, 60.0)
    finally:
        ray.shutdown()
    main([*TRANSFER, "--run", str(folder), "--resume", "--json"])
    assert_same_run(here, folder, left_out=[str(path.relative_to(each)) for each in (here, folder) for path in each.rglob("phases/*")])
    assert Path(folder / "ant-2.policy.safetensors").read_bytes() == (here / "ant-2.policy.safetensors").read_bytes()

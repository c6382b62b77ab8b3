"""Batches: one bad item is named, and the others are served all the same.

Places: recordings (list, retarget, expert --demos), cards, the targets of a run, the runs of a suite, its entries, phases.
"""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from robots import ROBOTS
from tasks import TASKS
from tasks.dexycb.recording import read_recording, sequences
from tasks.dexycb.standin import write_standin
from toolkit import cli
from toolkit.benchmarks.results import finished_runs, write_results
from toolkit.cli import main
from toolkit.demonstrations.replay import Broken, Retargeter, teachers_for
from toolkit.errors import ToolkitError
from toolkit.runs.phases import FOLDER, Phase, load_phases
from toolkit.runs.run import Run

ROOT = Path(cli.__file__).parents[2]
BRICK, BOX = "061_foam_brick", "008_pudding_box"


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """Two recordings of each of two objects."""
    root = tmp_path_factory.mktemp("hands") / "root"
    write_standin(root, [BRICK, BOX], 2, 0, 42)
    return root


@pytest.fixture
def hands(whole, tmp_path):
    shutil.copytree(whole, tmp_path / "hands")
    return tmp_path / "hands"


def of(root, item):
    return [name for name in sequences(root) if read_recording(root, name).object == item]


def without_a_label(root, name):
    sorted((root / name).glob("*/labels_*.npz"))[3].unlink()


def refusal(capsys, *words):
    with pytest.raises(SystemExit) as stop:
        main([*map(str, words)])
    said = capsys.readouterr()
    assert stop.value.code == 2 and len(said.err.splitlines()) >= 1, said.err
    return said.out, said.err.splitlines()[-1]


# -- recordings ----------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_another_objects_broken_recording_is_nobodys_business(hands, capsys):
    without_a_label(hands, of(hands, BOX)[0])
    main(["recordings", "retarget", str(hands), "--object", BRICK, "--json"])
    found = json.loads(capsys.readouterr().out)
    assert [r["object"] for r in found["recordings"]] == [BRICK] * 2 and found["broken"] == []
    scripts, counts = teachers_for(hands, ROBOTS["adroit"], TASKS[BRICK])
    assert scripts and counts["recordings"] == 2 and counts["broken"] == 0


def test_a_broken_recording_of_the_same_object_is_left_out_and_named(hands, capsys):
    broken, sound = of(hands, BRICK)
    without_a_label(hands, broken)
    out, said = refusal(capsys, "recordings", "retarget", hands, "--object", BRICK, "--json")
    found = json.loads(out)
    assert [r["recording"] for r in found["recordings"]] == [sound]
    assert [b["recording"] for b in found["broken"]] == [broken] and broken in said
    scripts, counts = teachers_for(hands, ROBOTS["adroit"], TASKS[BRICK])
    assert list(scripts) == [sound] and (counts["broken"], counts["followed"]) == (1, 1)


def test_only_broken_recordings_are_a_sentence(hands):
    for name in of(hands, BRICK):
        without_a_label(hands, name)
    with pytest.raises(ToolkitError, match=r"none of 2 recordings .* 2 are broken: .*labels_\d+.npz"):
        teachers_for(hands, ROBOTS["adroit"], TASKS[BRICK])


@pytest.mark.slow
def test_a_recording_that_does_not_say_its_object(hands, capsys):
    (hands / of(hands, BOX)[0] / "meta.yml").write_text("nothing: [")
    main(["recordings", "retarget", str(hands), "--object", BRICK])
    said = capsys.readouterr().out
    assert "2 of 2 replays" in said or "replays reach" in said
    assert "left out:" in said and "meta.yml" in said
    assert teachers_for(hands, ROBOTS["adroit"], TASKS[BRICK])[1]["recordings"] == 2


def test_a_broken_mesh_is_its_own_objects(hands, capsys):
    folder = hands / "models" / BOX
    folder.mkdir(parents=True)
    (folder / "textured_simple.obj").write_text("v a b c\n")
    out, said = refusal(capsys, "recordings", "retarget", hands, "--json")
    found = json.loads(out)
    assert {r["object"] for r in found["recordings"]} == set() or BOX not in {r["object"] for r in found["recordings"]}
    assert len(found["broken"]) == 2 and "textured_simple.obj" in said
    retargeter = Retargeter(hands, ROBOTS["adroit"])
    assert isinstance(retargeter.demonstration_of(of(hands, BOX)[0]), Broken)


def test_the_list_names_each_broken_one_and_shows_the_rest(hands, capsys):
    names = of(hands, BOX)
    for name in names:
        without_a_label(hands, name)
    out, said = refusal(capsys, "recordings", "list", hands, "--json")
    found = json.loads(out)
    assert len(found["recordings"]) == 2 and [b["recording"] for b in found["broken"]] == names and "2 of 4 are broken" in said


# -- cards ---------------------------------------------------------------------------------------------------

CARDS = {
    "name": 'from robots.panda import PANDA\nfrom dataclasses import replace\nMINE = replace(PANDA, name="my panda")\n',
    "syntax": "def (\n", "import": "import nosuchmodule\n", "attribute": "import numpy\nnumpy.nosuch\n", "key": "{}['x']\n",
    "zero": "1 / 0\n",
    "file": "open('/nosuch')\n",
}


@pytest.fixture
def user(tmp_path, checkout):
    """A checkout to whose robots/ and grippers/ cards may be added, and how commands run there."""
    checkout(tmp_path)
    environment = os.environ | {"PYTHONPATH": str(tmp_path)}

    def run(*words):
        return subprocess.run([sys.executable, "-m", "toolkit.cli", *words], capture_output=True, text=True, cwd=tmp_path, env=environment)

    return tmp_path, run


@pytest.mark.slow
def test_broken_cards_stop_no_other_robot(user):
    folder, run = user
    for name, code in CARDS.items():
        (folder / "robots" / f"my_{name}.py").write_text(code)
    (folder / "grippers" / "my_hand.py").write_text("x = [\n")
    (folder / "robots" / "my_user.py").write_text("from grippers.my_hand import HAND\n")
    done = run("robots", "--json")
    assert done.returncode == 2 and set(ROBOTS) == {row["name"] for row in json.loads(done.stdout)["robots"]}, done.stderr
    for module in (*(f"robots/my_{name}.py" for name in CARDS), "grippers/my_hand.py", "robots/my_user.py"):
        assert module in done.stderr
    assert run("robots", "--check", "panda").returncode == 0
    asked = run("robots", "--check", "my_panda")
    assert asked.returncode == 2 and "'my_panda' is unknown" in asked.stderr and "is not an identifier" in asked.stderr


# -- runs ----------------------------------------------------------------------------------------------------


def test_a_target_without_a_policy_leaves_the_others_evaluated(tmp_path, capsys):
    from toolkit.expert.training import new_learner

    run = Run.create(tmp_path / "r", {"source": "adroit", "targets": ["kinova3", "iiwa", "jaco"], "task": BRICK})
    new_learner(TASKS["061_foam_brick"], 0)[0].save(run.path / "kinova3.policy.safetensors")
    (run.path / "jaco.policy.safetensors").write_bytes(b"cut off")
    out, said = refusal(capsys, "evaluate", run.path, "--native", "--episodes", "1", "--json")
    assert json.loads(out)["target"] == "kinova3"
    assert "no policy for 'iiwa'" in said and "jaco.policy.safetensors is damaged" in said


def test_a_broken_run_is_left_out_of_the_page(tmp_path):
    from toolkit.benchmarks.fuzz import _run_of

    suite = tmp_path / "suite"
    for name in ("good", "bad", "odd"):
        (suite / name).mkdir(parents=True)
        shutil.move(_run_of(suite / name).path, suite / f"{name}-0")
        (suite / name).rmdir()
    (suite / "bad-0" / "report.json").write_text("[]")
    (suite / "odd-0" / "git.json").write_text("[]")
    broken = []
    runs = finished_runs(suite, broken.append)
    assert [run.name for run in runs] == ["good-0"] and len(broken) == 2
    assert "good-0" in write_results(suite, "A suite", "make it").read_text()


def test_an_entry_of_a_suite_that_fails_lets_the_others_play(tmp_path, monkeypatch, capsys):
    from toolkit.benchmarks import paper
    from toolkit.cli import benchmarks, suites
    from toolkit.transfer import pipeline

    entries = {name: suites.Entry() for name in ("first", "second", "third")}
    monkeypatch.setattr(benchmarks, "SUITES", {"s": suites.Suite("A suite", tmp_path / "out", entries)})
    monkeypatch.setitem(paper.PAPER, "s", ())
    played = []

    class Fake:
        def __init__(self, job, folder, resume, watch, recording, cluster, paths):
            assert (cluster, paths) == (None, 1), "without a cluster one path after the other"
            self.name = folder.name

        def play(self):
            played.append(self.name)
            if self.name != "third":
                raise ToolkitError(f"{self.name} went wrong")

    monkeypatch.setattr(pipeline, "Pipeline", Fake)
    _, said = refusal(capsys, "bench", "transfer", "--suite", "s", "--json")
    assert played == ["first", "second", "third"]
    assert "first did not finish: first went wrong; second did not finish" in said, "though none of them has a row for a page"


def test_a_broken_phase_does_not_hide_the_others(tmp_path):
    network = {"parameters": np.zeros(4), "shift": np.zeros(2), "scale": np.ones(2)}
    for number in range(3):
        Phase("path 1", number, "evolve", ["a"], np.zeros(3), np.ones(3), [network]).save(tmp_path)
    (tmp_path / FOLDER / "path-1-001-evolve.safetensors").write_bytes(b"cut")
    told = []
    assert list(load_phases(tmp_path, told.append)) == ["path-1-000-evolve", "path-1-002-evolve"]
    assert len(told) == 1 and "path-1-001-evolve" in told[0]

"""Every command of docs/deploy.md runs, in order, in one folder; those on a run use a run of the suite's own making."""

import dataclasses
import json
import re
import shlex
import zipfile
from pathlib import Path

import pytest

from toolkit.bundle.reading import load_bundle
from toolkit.cli.app import app
from toolkit.deploy.safety import PASSING
from toolkit.inspection.recording import viewer

PAGE = Path(__file__).parents[2] / "docs" / "deploy.md"
COMMANDS = [line for block in re.findall(r"```bash\n(.*?)```", PAGE.read_text(), re.DOTALL) for line in block.splitlines() if line]


def test_there_are_commands():
    assert [shlex.split(line)[1] for line in COMMANDS] == ["export", "verify", "deploy", "view", "bench", "deploy"]
    assert all(line.startswith("meta-evolve ") for line in COMMANDS)


def test_the_faults_that_pass_are_the_ones_that_the_page_names():
    passing = re.search(r"\| (.*) \| goes on once it has passed", PAGE.read_text())[1]
    assert tuple(re.findall(r"`(\w+)`", passing)) == PASSING
    source = (PAGE.parent.parent / "toolkit" / "deploy" / "safety.py").read_text()
    source += (PAGE.parent.parent / "toolkit" / "deploy" / "runtime.py").read_text()
    alive = (PAGE.parent.parent / "toolkit" / "deploy" / "liveness.py").read_text()
    kinds = set(re.findall(r'Fault\("(\w+)"', source)) | set(re.findall(r'return "(\w+)", ', alive)) | {"joint_speed", "effort"}
    assert kinds == set(re.findall(r"`(\w+)`", PAGE.read_text().split("| fault |")[1].split("### A bad day")[0]))


@pytest.fixture
def followed(tmp_path, monkeypatch):
    """A folder with the run that the page speaks of, whose policy is the shipped bundle's."""
    monkeypatch.chdir(tmp_path)
    bundle, run = load_bundle("kinova3"), tmp_path / "logs" / "my-run"
    run.mkdir(parents=True)
    with zipfile.ZipFile(bundle.path) if bundle.path.suffix == ".zip" else Folder(bundle.path) as archive:
        name = next(name for name in archive.namelist() if name.endswith("policy.safetensors"))
        (run / "kinova3.policy.safetensors").write_bytes(archive.read(name))
    m = bundle.manifest
    nodes = [{"name": "adroit", "kind": "source", "alpha": [0.0]}, {"name": "kinova3", "kind": "target", "alpha": list(m.lineage.alpha)}]
    files = {"config": m.run, "tree": {"kind": "steiner", "metric": "l1", "nodes": nodes},
             "report": {"targets": {"kinova3": {"native": dataclasses.asdict(m.success)}}, "totals": {}, "routes": {}}}
    for file, content in files.items():
        (run / f"{file}.json").write_text(json.dumps(content))
    return tmp_path


class Folder:
    """A bundle's folder, read as its .zip would be."""

    def __init__(self, path):
        self.path = path

    def __enter__(self):
        return self

    def __exit__(self, *_):
        pass

    def namelist(self):
        return [file.name for file in self.path.iterdir()]

    def read(self, name):
        return (self.path / name).read_bytes()


@pytest.mark.slow
def test_the_page_can_be_followed_from_its_first_command_to_its_last(followed, capsys, monkeypatch):
    shown = []
    monkeypatch.setattr(viewer, "has_display", lambda: True)  # without one, view serves the log until Ctrl-C
    monkeypatch.setattr(viewer, "open_window", lambda *files: shown.extend(files))
    for line in COMMANDS:
        app.cli(prog="meta-evolve", args=shlex.split(line)[1:])
        said = capsys.readouterr().out
        assert "DISAGREES" not in said and "BROKEN" not in said, f"{line}: {said}"
    assert (followed / "kinova3-bundle.zip").is_file() and [file.name for file in shown] == ["deploy.rrd"]

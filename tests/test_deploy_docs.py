"""Every command of docs/deploy.md runs, in order, in one folder; those on a run use a run of the suite's own making."""

import re
import shlex
from pathlib import Path

import pytest

from toolkit.cli.app import app
from toolkit.deploy.safety import PASSING

PAGE = Path(__file__).parent.parent / "docs" / "deploy.md"
COMMANDS = [line for block in re.findall(r"```bash\n(.*?)```", PAGE.read_text(), re.DOTALL) for line in block.splitlines() if line]


def test_there_are_commands():
    assert [shlex.split(line)[1] for line in COMMANDS] == ["export", "verify", "deploy", "view"]
    assert all(line.startswith("meta-evolve ") for line in COMMANDS)


def test_the_faults_that_pass_are_the_ones_that_the_page_names():
    passing = re.search(r"\| (.*) \| goes on once it has passed", PAGE.read_text())[1]
    assert tuple(re.findall(r"`(\w+)`", passing)) == PASSING
    source = (PAGE.parent.parent / "toolkit" / "deploy" / "safety.py").read_text()
    source += (PAGE.parent.parent / "toolkit" / "deploy" / "runtime.py").read_text()
    kinds = set(re.findall(r'Fault\("(\w+)"', source)) | {"joint_speed", "effort"}
    assert kinds == set(re.findall(r"`(\w+)`", PAGE.read_text().split("| fault |")[1].split("`META_EVOLVE")[0]))


@pytest.mark.parametrize("line", [line for line in COMMANDS if shlex.split(line)[1] in ("verify", "deploy")])
def test_the_page_can_be_followed(line, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    app.cli(prog="meta-evolve", args=shlex.split(line)[1:])
    said = capsys.readouterr().out
    assert "DISAGREES" not in said and "BROKEN" not in said

"""docs/python.md: its scripts run as they stand, in a folder of their own."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

import meta_evolve

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "python.md").read_text(encoding="utf-8")
_, LOOK, TRANSFER = re.findall(r"```python\n(.*?)```", PAGE, re.S)


def run(script, folder):
    """A script in a file of its own; returns the lines that it printed."""
    (folder / "script.py").write_text(script)
    done = subprocess.run([sys.executable, "script.py"], cwd=folder, env=os.environ | {"PYTHONPATH": str(ROOT)}, capture_output=True,
                          text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines()


def test_the_page_names_all_that_there_is():
    named = set(re.findall(r"`(\w+)\(", PAGE.split("## Look")[0]))
    functions = {name for name in meta_evolve.__all__ if callable(getattr(meta_evolve, name))}
    assert named == functions - {"ToolkitError"}


@pytest.mark.slow
def test_the_page_looks_plays_and_evaluates(tmp_path):
    robots, *edges, merged, played, evaluated = run(LOOK, tmp_path)
    assert robots.split()[0] == "adroit" and {"kinova3", "iiwa", "jaco"} <= set(robots.split())
    assert len(edges) >= 2 and all(" -> " in edge for edge in edges)
    assert int(merged.split()[0]) >= 5
    assert "'success': True" in played and "'diverged': False" in played
    assert re.match(r"[34] of 4, 0 diverged", evaluated)


@pytest.mark.slow
def test_the_page_transfers_and_exports(tmp_path):
    told = run(TRANSFER, tmp_path)
    assert "'episodes': 4" in told[-2] and told[-1].startswith("Success(episodes=4")
    assert (tmp_path / "first-bundle.zip").is_file() and (tmp_path / "logs" / "first" / "report.json").is_file()

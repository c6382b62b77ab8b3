"""A line that is printed can be typed, whatever names are in it."""

import shlex
import subprocess
from pathlib import Path

import pytest
from command_line import NAMES

from toolkit.io.quoting import told


@pytest.mark.parametrize("name", [name for name in NAMES if "\0" not in name])
def test_a_line_that_is_printed_can_be_typed(tmp_path, name):
    line = told("view", name, "--rebuild")
    assert shlex.split(line)[1:] == ["view", name, "--rebuild"]
    said = line.removeprefix("meta-evolve view ").removesuffix(" --rebuild")
    done = subprocess.run(["/bin/sh", "-c", f"printf '%s' {said}"], capture_output=True, cwd=tmp_path)
    assert done.stdout.decode() == name or name.startswith("-")
    assert not (tmp_path / "pwned").exists()
    assert told("view", Path("-x")).endswith(" ./-x"), "a path is no option"

"""A recording that is written while a run goes on."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from rerun_rows import entities

from toolkit.errors import ToolkitError
from toolkit.inspection.recording import viewer

ROOT = Path(__file__).parents[3]


@pytest.mark.skipif(os.name != "posix", reason="needs SIGKILL")
def test_a_killed_runs_recording_is_readable(tmp_path):
    file = tmp_path / "recording.rrd"
    program = (
        "import os, sys; from pathlib import Path; import rerun as rr; from toolkit.inspection.recording.stream import Stream\n"
        "stream = Stream(Path(sys.argv[1]))\n"
        "for step in range(9): stream.row('a', float(step), step, rr.Scalars(0.5)); stream.flush()\n"
        "os.kill(os.getpid(), 9)\n"
    )
    killed = subprocess.run([sys.executable, "-c", program, str(file)], cwd=ROOT, env=os.environ | {"PYTHONPATH": str(ROOT)})
    assert killed.returncode == -signal.SIGKILL
    assert len(entities(file)["/a"]) == 9
    file.write_bytes(file.read_bytes()[:-5])  # as if killed within a write
    try:
        assert viewer.recording_of(file) == file
    except ToolkitError as error:
        assert "--rebuild" in str(error)

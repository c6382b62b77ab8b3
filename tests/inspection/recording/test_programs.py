"""The viewer's program: the one of this environment, and the mend where it is missing."""

import subprocess
from types import SimpleNamespace

import pytest
import rerun as rr

from toolkit.errors import ToolkitError
from toolkit.inspection.recording import programs
from toolkit.inspection.recording.programs import viewer_program


def test_the_program_is_of_the_version_that_is_imported():
    """And no script: whoever ends a script leaves the viewer running."""
    program = viewer_program()
    assert not program.read_bytes()[:2] == b"#!"
    said = subprocess.run([program, "--version"], capture_output=True, text=True, timeout=60, check=True).stdout
    assert rr.__version__ in said, said


@pytest.mark.parametrize("found", [None, "nowhere/rerun_cli/__init__.py"])
def test_a_missing_program_is_named_with_its_mend(monkeypatch, found):
    monkeypatch.setattr(programs, "find_spec", lambda name: found and SimpleNamespace(origin=found))
    with pytest.raises(ToolkitError, match="the Rerun viewer .*rerun.* is missing; run `pip install --force-reinstall rerun-sdk`"):
        viewer_program()

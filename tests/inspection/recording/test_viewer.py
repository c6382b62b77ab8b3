"""The viewer: what is no recording is told, without a display it is served, and without it a sentence says how to have it."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from toolkit.errors import ToolkitError
from toolkit.inspection.recording import viewer

ROOT = Path(__file__).parents[3]


def test_what_is_no_recording_gets_one_sentence(tmp_path, rebuilt):
    data = rebuilt[0].read_bytes()
    file = tmp_path / "a.rrd"
    for length, complaint in [(0, "not a Rerun recording"), (10, "cut off")]:
        file.write_bytes(data[:length])
        with pytest.raises(ToolkitError, match=complaint):
            viewer.recording_of(file)
    file.write_bytes(b"PNG" + data)
    with pytest.raises(ToolkitError, match="not a Rerun recording"):
        viewer.recording_of(file)
    with pytest.raises(ToolkitError, match="no recording at"):
        viewer.recording_of(tmp_path)


def test_without_a_display_the_viewer_is_served(rebuilt):
    import urllib.request

    process, address, proxy = viewer.serve(rebuilt[0])
    try:
        page = urllib.request.urlopen(address.split("?")[0], timeout=20).read().decode()
        assert "<html" in page.lower() and proxy.endswith("/proxy")
    finally:
        process.terminate()
        process.wait()
    with pytest.raises(OSError):  # nobody is left behind who serves on
        urllib.request.urlopen(address.split("?")[0], timeout=20)


@pytest.mark.slow
def test_without_the_viewer_a_sentence_says_how_to_have_it():
    program = (
        "import sys; sys.modules['rerun'] = None; from toolkit.cli import main\n"
        "import importlib.util; found = importlib.util.find_spec\n"
        "importlib.util.find_spec = lambda name, *more: None if name == 'rerun' else found(name, *more)\n"
        "from toolkit.quiet import silence_robosuite; silence_robosuite(); import toolkit.transfer.pipeline; main(['view', 'run.rrd'])"
    )
    done = subprocess.run([sys.executable, "-c", program], cwd=ROOT, env=os.environ | {"PYTHONPATH": str(ROOT)}, capture_output=True,
                          text=True)
    assert done.returncode == 2, done.stderr
    assert done.stderr == "meta-evolve: the Rerun viewer is not installed; pip install 'meta-evolve[viewer]'\n"

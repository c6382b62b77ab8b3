"""A file appears whole or not at all, and nothing else does."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from toolkit.io.atomic import write_atomically

ROOT = Path(__file__).parents[2]


def test_an_atomic_write_leaves_nothing_behind(tmp_path):
    (tmp_path / "a").mkdir()
    with pytest.raises(OSError):
        write_atomically(tmp_path / "a", b"x")
    assert [file.name for file in tmp_path.iterdir()] == ["a"]


@pytest.mark.skipif(os.name != "posix", reason="needs SIGKILL")
@pytest.mark.parametrize("dies_in", ["fsync", "replace", None])
def test_a_process_that_is_killed_while_it_writes_leaves_the_old_file_or_the_new_one(tmp_path, dies_in):
    """Killed before the file is on the disk, before it takes its place, and after that."""
    file = tmp_path / "a"
    write_atomically(file, b"old")
    program = (
        "import os, sys; from pathlib import Path; from toolkit.io.atomic import write_atomically\n"
        "die = lambda *_: os.kill(os.getpid(), 9)\n"
        "if sys.argv[2]: setattr(os, sys.argv[2], die)\n"
        "write_atomically(Path(sys.argv[1]), b'new' * 10**6)\n"
        "die()\n"
    )
    killed = subprocess.run([sys.executable, "-c", program, str(file), dies_in or ""], cwd=ROOT)
    assert killed.returncode == -signal.SIGKILL
    assert file.read_bytes() == (b"old" if dies_in else b"new" * 10**6)
    write_atomically(file, b"next")
    assert file.read_bytes() == b"next", "what the dead process left is in nobody's way"

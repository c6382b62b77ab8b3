"""Silence for robosuite, and workers that go with their parent."""

import os
import subprocess
import sys
import time
from pathlib import Path


def test_workers_leave_when_their_parent_is_killed(tmp_path):
    """kill -9 must not leave processes behind that hold a gigabyte each."""
    program = tmp_path / "parent.py"
    program.write_text(
        "import os, time\n"
        "from concurrent.futures import ProcessPoolExecutor\n"
        "from multiprocessing import get_context\n"
        "from toolkit.quiet import start_worker\n"
        "if __name__ == '__main__':\n"
        "    pool = ProcessPoolExecutor(1, mp_context=get_context('spawn'), initializer=start_worker)\n"
        "    print(pool.submit(os.getpid).result(), flush=True)\n"
        "    time.sleep(600)\n"
    )
    environment = os.environ | {"PYTHONPATH": str(Path(__file__).parents[1])}
    parent = subprocess.Popen([sys.executable, str(program)], stdout=subprocess.PIPE, text=True, env=environment)
    worker = int(parent.stdout.readline())
    parent.kill()
    parent.wait()
    deadline = time.monotonic() + 60
    while Path(f"/proc/{worker}").exists() and "Z" not in Path(f"/proc/{worker}/stat").read_text().split(")")[1][:3]:
        assert time.monotonic() < deadline, f"worker {worker} outlived its parent"
        time.sleep(0.2)


def test_errors_alone_come_through(tmp_path):
    """Of robosuite's own logger, and of no other; in a process of its own, since a filter stays."""
    code = (
        "import logging, sys\n"
        "from toolkit.quiet import silence_robosuite\n"
        "logging.basicConfig(format='%(name)s %(message)s')\n"
        "silence_robosuite()\n"
        "for name in ('robosuite_logs', 'other'):\n"
        "    for level in (logging.WARNING, logging.ERROR): logging.getLogger(name).log(level, logging.getLevelName(level))\n"
        "sys.exit('robosuite' in sys.modules)\n"
    )
    environment = os.environ | {"PYTHONPATH": str(Path(__file__).parents[1])}
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=environment)
    assert (done.returncode, done.stderr.splitlines()) == (0, ["robosuite_logs ERROR", "other WARNING", "other ERROR"])

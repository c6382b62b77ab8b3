"""Nodes of a Ray cluster on this machine, each begun by `ray start` in processes of its own, as on machines of their own."""

import os
import signal
import socket
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from toolkit.errors import ToolkitError
from toolkit.simulation.cluster import imported_ray

try:
    ray = imported_ray()  # as a command imports it: Ray reads what it is told as it is loaded
except ToolkitError as absent:
    pytest.skip(str(absent), allow_module_level=True)

STORE = 80 * 2**20
"""Bytes of a node's object store, the least that Ray takes being some 75 MiB."""


def assert_same(found, wanted):
    """The episodes, in their order, bit for bit."""
    assert [episode.seed for episode in found] == [episode.seed for episode in wanted]
    for mine, theirs in zip(found, wanted, strict=True):
        for name, value in vars(theirs).items():
            np.testing.assert_array_equal(getattr(mine, name), value, err_msg=f"{name} of seed {theirs.seed}")


def descendants(pid):
    """A process and all that it has begun."""
    told = subprocess.run(["ps", "-eo", "pid=,ppid="], capture_output=True, text=True, check=True).stdout
    parents = [tuple(map(int, line.split())) for line in told.splitlines()]
    found = [pid]
    for one in found:
        found += [child for child, parent in parents if parent == one]
    return found


class Nodes:
    """Nodes of a cluster on this machine: its head listens at ``address``."""

    def __init__(self, folder):
        with socket.socket() as one:
            one.bind(("", 0))
            self.port = one.getsockname()[1] % 10_000 + 20_000  # workers have the ports from 10002 to 19999
        self.address, self.folder, self.processes = f"{socket.gethostbyname(socket.gethostname())}:{self.port}", folder, []

    def start(self, processors, head=False):
        """Begin a node, the head or one that joins it; returns its process."""
        where = ["--head", f"--port={self.port}", "--include-dashboard=false"] if head else [f"--address={self.address}"]
        surroundings = os.environ | {"PYTHONPATH": os.pathsep.join([*map(str, sys.path), str(Path(__file__).parent)])}  # toys are cards too
        command = [sys.executable, "-m", "ray.scripts.scripts", "start", *where, "--block", f"--num-cpus={processors}",
                   f"--object-store-memory={STORE}", "--disable-usage-stats"]
        with open(self.folder / f"node-{len(self.processes)}.log", "w") as log:
            process = subprocess.Popen(command, stdout=log, stderr=log, stdin=subprocess.DEVNULL, env=surroundings,
                                       start_new_session=True)
        self.processes.append(process)
        return process

    def kill(self, process):
        """What pulling a machine's plug does."""
        for pid in descendants(process.pid):
            try:
                os.kill(pid, signal.SIGKILL)
            except ProcessLookupError:
                pass
        process.wait()

    def end(self):
        for process in self.processes:
            if process.poll() is None:
                self.kill(process)

"""One writer per folder: a claim that lives as long as its process, however that ends.

The kernel holds it (flock), so that a crash, a kill or a power cut leaves nothing to be cleared away: a lock file that lies about
is claimed anew. Where there are no such locks (Windows, some network disks) nothing is refused.
"""

import atexit
import os
import socket
from pathlib import Path
from typing import Literal, TextIO

from toolkit.errors import ToolkitError

try:
    import fcntl
except ImportError:  # not a POSIX system
    fcntl = None  # type: ignore[assignment]

LOCK = ".lock"
"""Name of the lock file in a claimed folder; gone once the claim is given up."""
_held: dict[Path, int] = {}


def claim(folder: Path, mend: str) -> None:
    """Be the only process that writes into a folder, which must exist, until ``give_up`` or the process's end.

    Args:
        folder: which. A process may claim it again.
        mend: what to do where another process has it.

    Raises:
        ToolkitError: another process writes there; the sentence says which.
        OSError: the lock file cannot be made.
    """
    file = folder.resolve() / LOCK
    if fcntl is None or _is_ours(file):
        return
    while True:
        descriptor = os.open(file, os.O_RDWR | os.O_CREAT, 0o644)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            who = os.read(descriptor, 200).decode(errors="replace").strip() or "another process"
            os.close(descriptor)
            raise ToolkitError(f"{folder} is being written by {who}; {mend}") from None
        except OSError:  # a disk without locks
            os.close(descriptor)
            return
        if _same(file, descriptor):
            break
        os.close(descriptor)  # whoever held it has just removed it
    os.ftruncate(descriptor, 0)
    os.pwrite(descriptor, f"process {os.getpid()} on {socket.gethostname()}".encode(), 0)
    _held[file] = descriptor


def give_up(folder: Path) -> None:
    """Let others write into a folder; nothing if it is not claimed."""
    file = folder.resolve() / LOCK
    descriptor = _held.pop(file, None)
    if descriptor is not None:
        if _same(file, descriptor):
            file.unlink(missing_ok=True)  # while it is still held: nobody can have claimed it meanwhile
        os.close(descriptor)


def is_claimed(folder: Path) -> bool:
    """Whether this process or another writes into a folder."""
    file = folder / LOCK
    if fcntl is None or not file.exists():
        return False
    if _is_ours(folder.resolve() / LOCK):
        return True
    with open(file, "rb") as opened:
        try:
            fcntl.flock(opened, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except BlockingIOError:
            return True
        except OSError:
            return False
    return False


def claim_file(file: TextIO, mend: str) -> None:
    """Be the only process that writes a file, as long as it is open.

    Raises:
        ToolkitError: another process writes it.
    """
    if fcntl is None:
        return
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        raise ToolkitError(f"{file.name} is being written by another process; {mend}") from None
    except OSError:
        pass  # a device, or a disk without locks


def open_claimed(path: Path, mode: Literal["a", "a+"], option: str) -> TextIO:
    """A file, with the folders above it, that only this process writes as long as it is open.

    Args:
        mode: it is not emptied before it is claimed.  option: that names another file.

    Raises:
        ToolkitError: another process writes it.
        OSError: it cannot be opened.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    file = path.open(mode, encoding="utf-8")
    claim_file(file, f"give another {option}")
    return file


def _is_ours(file: Path) -> bool:
    if file not in _held:
        return False
    if _same(file, _held[file]):
        return True
    os.close(_held.pop(file))  # the folder was removed, and perhaps made again
    return False


def _same(file: Path, descriptor: int) -> bool:
    """Whether a path still leads to an open file."""
    try:
        return os.path.samestat(os.stat(file), os.fstat(descriptor))
    except OSError:
        return False


@atexit.register
def _give_up_all() -> None:
    for file in list(_held):
        give_up(file.parent)

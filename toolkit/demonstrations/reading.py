"""Which reader a file of demonstrations is for."""

from pathlib import Path

from tasks.task import Task
from toolkit.demonstrations.hand_dapg import read_hand_dapg
from toolkit.demonstrations.recorded import Recorded, read_recorded
from toolkit.errors import ToolkitError


def read_demonstrations(path: Path, task: Task) -> Recorded:
    """Read a file of either layout: .npz (docs/demonstrations.md), or one of hand_dapg's.

    Raises:
        ToolkitError: as those readers.
    """
    try:
        with path.open("rb") as file:
            begins = file.read(2)
    except OSError as error:
        raise ToolkitError(f"{path} cannot be read ({error.strerror}); give a file of demonstrations") from None
    return read_recorded(path, task) if begins == b"PK" else read_hand_dapg(path, task)

"""The `rerun` program of this environment."""

import os
import sysconfig
from pathlib import Path

from toolkit.errors import ToolkitError


def viewer_program() -> Path:
    """Its path.

    Raises:
        ToolkitError: it is not installed.
    """
    name = "rerun.exe" if os.name == "nt" else "rerun"
    program = Path(sysconfig.get_path("scripts")) / name
    if not program.exists():
        raise ToolkitError(f"the Rerun viewer {program} is missing; run `pip install --force-reinstall rerun-sdk`")
    return program

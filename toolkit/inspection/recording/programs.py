"""The `rerun` program of this environment."""

import os
from importlib.util import find_spec
from pathlib import Path

from toolkit.errors import ToolkitError


def viewer_program() -> Path:
    """Path of the viewer itself, not of the script that starts it: whoever ends the script leaves the viewer running.

    Raises:
        ToolkitError: it is not installed.
    """
    package = find_spec("rerun_cli")
    folder = Path(package.origin).parent if package and package.origin else Path()
    candidates = [folder / "Rerun.app" / "Contents" / "MacOS" / "Rerun", folder / ("rerun.exe" if os.name == "nt" else "rerun")]
    program = next((path for path in candidates if package and path.exists()), None)
    if program is None:
        raise ToolkitError(f"the Rerun viewer {candidates[-1]} is missing; run `pip install --force-reinstall rerun-sdk`")
    return program

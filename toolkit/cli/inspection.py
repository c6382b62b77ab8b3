"""view, doctor: looking at a run, and at the installation."""

from pathlib import Path
from typing import Annotated

import tyro

from toolkit.cli.terminal import emit, table


def view(path: Annotated[Path, tyro.conf.Positional]) -> None:
    """Open a run's recording in the Rerun viewer.

    Args:
        path: a run folder or an .rrd file.
    """
    from toolkit.recording import show

    print(show(path))


def doctor(json: bool = False) -> None:
    """Check versions, models, rendering and Rerun, and say what to mend.

    Args:
        json: print one JSON object.
    """
    from toolkit.doctor import checks

    found = checks()
    if json:
        emit({"checks": [c._asdict() for c in found]}, True, "")
    else:
        marks = {True: "ok", False: "BROKEN", None: "warning"}
        table("Doctor", ["check", "", "found", "mend"], [[c.name, marks[c.ok], c.detail, "" if c.ok else c.mend] for c in found])
    if any(c.ok is False for c in found):
        raise SystemExit(1)

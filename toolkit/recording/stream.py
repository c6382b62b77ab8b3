"""A stream of log calls into one .rrd file, or into a viewer; the timelines, and what rerun wants of numbers.

    film        [s] the run as one film: robots turn into robots, then play the episodes worth seeing
    iteration   the run's records, one after another; of an episode its last frame
"""

import os
import subprocess
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from toolkit.errors import ToolkitError
from toolkit.recording.programs import viewer_program

APPLICATION = "meta-evolve"
FILM, ITERATION = "film", "iteration"


class Stream:
    """Writes a recording; what was logged before the process was killed can be viewed.

    Args:
        target: the .rrd file, or the address of a viewer (rerun+http://...).

    Raises:
        ToolkitError: the file cannot be written.
    """

    def __init__(self, target: Path | str) -> None:
        self.path = target if isinstance(target, Path) else None
        self._stream = rr.RecordingStream(APPLICATION)
        self._stream.set_log_time_enabled(False)
        self._stream.set_log_tick_enabled(False)
        if self.path is None:
            self._stream.connect_grpc(target)
            return
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            self.path.touch()
            self._stream.save(self.path)
        except (OSError, RuntimeError) as error:
            raise ToolkitError(f"recording {self.path} cannot be written ({error}); choose a folder that can be") from None

    def arrange(self, blueprint: rrb.Blueprint) -> None:
        """Lay the viewer out; once per recording, as a layout is large."""
        self._stream.send_blueprint(blueprint)

    def static(self, entity: str, *parts: rr.AsComponents) -> None:
        """Log what is the same at all times."""
        self._stream.log(entity, *parts, static=True)

    def row(self, entity: str, film: float | None, iteration: int | None, *parts: rr.AsComponents) -> None:
        """Log what holds from a moment on; None: not on that timeline."""
        self._stream.reset_time()
        if film is not None:
            self._stream.set_time(FILM, duration=duration(film))
        if iteration is not None:
            self._stream.set_time(ITERATION, sequence=iteration)
        self._stream.log(entity, *parts)

    def rows(self, entity: str, film: np.ndarray | None, iteration: int | Sequence[int] | None, *columns: Any) -> None:
        """Log many moments at once.

        Args:
            entity: where.
            film: (T,) [s] or None.
            iteration: of all rows, or of each.
            columns: what an archetype's ``columns`` made.
        """
        count = len(film) if film is not None else len(iteration)
        indexes = [] if film is None else [rr.TimeColumn(FILM, duration=duration(film))]
        if iteration is not None:
            numbers = np.broadcast_to(np.asarray(iteration), (count,))
            indexes.append(rr.TimeColumn(ITERATION, sequence=np.array(numbers)))
        parts = [part for column in columns for part in column]
        self._stream.send_columns(entity, indexes, parts)

    def flush(self) -> None:
        """Let a viewer, or whoever reads the file, see what was logged so far."""
        self._stream.flush()

    def close(self) -> None:
        """Finish the file: chunks of the same entity are joined, so that viewers open it at once."""
        self._stream.flush()
        self._stream.disconnect()
        if self.path is not None:
            compact(self.path)


def compact(path: Path) -> None:
    """Join a recording's chunks in place; if that fails the recording stays as it is."""
    temporary = path.with_name(f".{path.name}.tmp")
    command = [str(viewer_program()), "rrd", "optimize", str(path), "-o", str(temporary), "--max-rows", "100000", "--max-size", "64MiB"]
    answer = subprocess.run(command, capture_output=True, check=False)
    if answer.returncode == 0 and temporary.exists():
        os.replace(temporary, path)
    temporary.unlink(missing_ok=True)


def duration(seconds: float | np.ndarray) -> np.ndarray:
    """Whole microseconds, so that what is logged for one moment falls on the same instant."""
    return np.round(np.asarray(seconds, dtype=np.float64) * 1e6).astype("timedelta64[us]")[()]


def x_first(quaternion: np.ndarray) -> np.ndarray:
    """MuJoCo's w-first quaternions (..., 4) in rerun's order."""
    return np.roll(quaternion, -1, axis=-1)

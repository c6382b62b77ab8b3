"""A stream of log calls into one .rrd file, or into a viewer; the timelines, and what rerun wants of numbers.

    film        [s] the run as one film: robots turn into robots, then play the episodes worth seeing
    iteration   the run's records, one after another; of an episode its last frame
"""

import os
import subprocess
import time
import warnings
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from rerun.chunk import RrdReader

from toolkit.errors import ToolkitError
from toolkit.inspection.recording.programs import viewer_program
from toolkit.io.quoting import told

APPLICATION = "meta-evolve"
RESERVE = 32 << 20
"""[bytes] that a recording leaves free on its disk."""
BETWEEN = 0.05
"""[s] between two looks at what is free."""
PATIENCE = 20.0
"""[s] that a flush may take."""
LONGEST = 600.0
"""[s] that joining the chunks of a recording may take."""
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
        if not isinstance(target, Path):
            self._stream.connect_grpc(target)
            return
        self._checked = 0.0
        try:
            target.parent.mkdir(parents=True, exist_ok=True)
            target.touch()
            try:
                self._room()
            except ToolkitError:
                target.unlink()  # an empty file would be taken for a damaged recording
                raise
            self._stream.save(target)
        except (OSError, RuntimeError) as error:
            raise ToolkitError(f"recording {target} cannot be written ({error}); choose a folder that can be") from None

    def _room(self) -> None:
        """Stop before the disk is full: rerun's writer dies of it, and then whoever flushes, closes or ends waits for ever. What is
        left is for what matters more than a recording.

        Raises:
            ToolkitError: there is little room.
        """
        if self.path is not None and time.monotonic() - self._checked > BETWEEN:
            self._checked = time.monotonic()
            disk = os.statvfs(self.path)
            if disk.f_bavail * disk.f_frsize < RESERVE:
                raise lost(self.path, f"No space left on device: less than {RESERVE >> 20} MiB are free")

    def arrange(self, blueprint: rrb.Blueprint) -> None:
        """Lay the viewer out; once per recording, as a layout is large."""
        self._room()
        self._stream.send_blueprint(blueprint)

    def static(self, entity: str, *parts: rr.AsComponents | Iterable[rr.DescribedComponentBatch]) -> None:
        """Log what is the same at all times."""
        self._room()
        self._stream.log(entity, *parts, static=True)

    def row(self, entity: str, film: float | None, iteration: int | None, *parts: rr.AsComponents) -> None:
        """Log what holds from a moment on; None: not on that timeline."""
        self._room()
        self._stream.reset_time()
        if film is not None:
            self._stream.set_time(FILM, duration=np.timedelta64(round(1e6 * film), "us"))  # as of `duration`
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
        self._room()
        count = len(film) if film is not None else 0 if iteration is None else np.size(iteration)
        indexes = [] if film is None else [rr.TimeColumn(FILM, duration=duration(film))]
        if iteration is not None:
            numbers = np.broadcast_to(np.asarray(iteration), (count,))
            indexes.append(rr.TimeColumn(ITERATION, sequence=np.array(numbers)))
        parts = [part for column in columns for part in column]
        self._stream.send_columns(entity, indexes, parts)

    def flush(self) -> None:
        """Let a viewer, or whoever reads the file, see what was logged so far.

        Raises:
            ToolkitError: the file, or the viewer, takes nothing any more.
        """
        try:
            self._stream.flush(timeout_sec=PATIENCE)  # rerun would wait for ever for a writer that has given up
        except RuntimeError as error:
            raise lost(self.path, str(error)) from None

    def close(self) -> None:
        """Finish the file: chunks of the same entity are joined, so that viewers open it at once.

        Raises:
            ToolkitError: what was logged is not all in it.
        """
        finish(self._stream, self.path)
        if self.path is not None:
            compact(self.path)


def lost(path: Path | None, why: str) -> ToolkitError:
    """The sentence on a recording that is not whole."""
    where = "the viewer takes no more" if path is None else f"recording {path} is cut off"
    again = f", with: {told('view', path.parent, '--rebuild')}" if path is not None and path.name == "recording.rrd" else ""
    return ToolkitError(f"{where} ({why[:100]}); free space there and make it anew{again}")


def finish(stream: rr.RecordingStream, path: Path | None) -> None:
    """Write what is still on its way, and look whether the file is whole: rerun only prints that a disk was full.

    Raises:
        ToolkitError: it is not.
    """
    why = ""
    try:
        stream.flush(timeout_sec=PATIENCE)
        stream.disconnect()
    except RuntimeError as error:
        why = str(error)
    if path is not None and not why:
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("error")  # a file without its end is warned of
                RrdReader(path)
        except (RuntimeError, ValueError, OSError, Warning) as error:
            why = " ".join(str(error).split())
    if why:
        raise lost(path, why)


def compact(path: Path) -> None:
    """Join a recording's chunks in place; if that fails the recording stays as it is."""
    temporary = path.with_name(f".{path.name}.tmp")
    command = [str(viewer_program()), "rrd", "optimize", str(path), "-o", str(temporary), "--max-rows", "100000", "--max-size", "64MiB"]
    try:
        if subprocess.run(command, capture_output=True, check=False, timeout=LONGEST).returncode == 0 and temporary.exists():
            os.replace(temporary, path)
    except (OSError, subprocess.TimeoutExpired):
        pass
    finally:
        temporary.unlink(missing_ok=True)


def duration(seconds: np.ndarray) -> np.ndarray:
    """Whole microseconds, so that what is logged for one moment falls on the same instant."""
    return np.round(np.asarray(seconds, dtype=np.float64) * 1e6).astype("timedelta64[us]")


def x_first(quaternion: np.ndarray) -> np.ndarray:
    """MuJoCo's w-first quaternions (..., 4) in rerun's order."""
    return np.roll(quaternion, -1, axis=-1)

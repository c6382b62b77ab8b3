"""The Rerun viewer: opening recordings, serving them to a browser, taking stills without a screen, reading them back."""

import os
import socket
import subprocess
import time
import warnings
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from rerun.chunk import Chunk, RrdReader

from toolkit.errors import ToolkitError
from toolkit.inspection.recording.programs import viewer_program
from toolkit.inspection.recording.stream import FILM, LONGEST
from toolkit.io.quoting import told

if TYPE_CHECKING:
    from rerun.experimental import ViewerClient

WEB_PORT, VIEWER_PORT = 9090, 9876
"""The viewer's own defaults."""
STILL_SIZE = "1600x1000"
STILL_PATIENCE = 180.0
"""[s] that a viewer without a screen may take to show a recording."""
OPENING = 1.5
"""[s] within which a viewer that cannot draw here has ended."""
CANNOT_DRAW = (
    "the viewer cannot draw here; install a Vulkan driver (Debian: apt-get install mesa-vulkan-drivers libvulkan1), then see: "
    "meta-evolve doctor"
)
LOOK = 1.0
"""[s] between two looks at a viewer without a screen; meshes and texts are loaded, frame by frame, when two look the same."""


def has_display() -> bool:
    """Whether a window can be opened here."""
    linux = os.name == "posix" and os.uname().sysname == "Linux"
    return not linux or bool({"DISPLAY", "WAYLAND_DISPLAY"} & set(os.environ))


def recording_of(path: Path) -> Path:
    """The recording of a run folder, or the file itself.

    Raises:
        ToolkitError: there is none, or it cannot be read: truncated, or no recording.
    """
    file = path / "recording.rrd" if path.is_dir() else path
    if not file.exists():
        hint = "; make it with --rebuild" if (path / "config.json").exists() else ""
        raise ToolkitError(f"no recording at {file}{hint or '; give an .rrd file, or the folder of a run that records'}")
    for _ in chunks_of(file):  # what cannot be read further on is said here, not by the viewer
        pass
    return file


def open_window(*files: Path) -> None:
    """Open a recording, and a layout for it, in a viewer of its own.

    Raises:
        ToolkitError: it ends at once.
    """
    process = subprocess.Popen([str(viewer_program()), *map(str, files)], start_new_session=True, stdout=subprocess.DEVNULL,
                               stderr=subprocess.DEVNULL)
    try:
        process.wait(OPENING)
    except subprocess.TimeoutExpired:
        return
    if process.returncode:
        raise ToolkitError(f"the viewer ended at once with status {process.returncode}; see `meta-evolve doctor`, or save a --still")


def serve(*files: Path) -> tuple[subprocess.Popen, str, str]:
    """Serve a viewer to browsers, showing a recording (and a layout for it), or whatever is sent to it.

    Returns:
        the process, which lives until it is ended; the address for a browser; the address to which streams are sent.

    Raises:
        ToolkitError: the server does not start.
    """
    web, port = free_port(WEB_PORT), free_port(VIEWER_PORT)
    command = [str(viewer_program()), *map(str, files), "--serve-web", "--web-viewer-port", str(web), "--port", str(port)]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    proxy = f"rerun+http://127.0.0.1:{port}/proxy"
    if not _answers(web, process) or not _answers(port, process):
        process.terminate()
        raise ToolkitError(f"the web viewer does not start on ports {web} and {port}; end what uses them")
    return process, f"http://127.0.0.1:{web}/?url={proxy.replace(':', '%3A').replace('/', '%2F').replace('+', '%2B')}", proxy


def follow_window() -> tuple[subprocess.Popen, str]:
    """A viewer that waits for a stream; returns its process and the address to send to.

    Raises:
        ToolkitError: it does not start.
    """
    port = free_port(VIEWER_PORT)
    command = [str(viewer_program()), "--port", str(port), "--expect-data-soon"]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    if not _answers(port, process):
        process.terminate()
        raise ToolkitError(f"the viewer does not start on port {port}; see `meta-evolve doctor`")
    return process, f"rerun+http://127.0.0.1:{port}/proxy"


def still(files: Sequence[Path], out: Path, at: float | None = None, size: str = STILL_SIZE, timeline: str = FILM) -> None:
    """Show a recording in a viewer without a screen and save what it shows.

    Args:
        files: the recording, and perhaps a layout for it.
        out: PNG file.
        at: [s] on the film, or number of the iteration; None: where the recording begins.
        size: "WIDTHxHEIGHT" in pixels.
        timeline: that ``at`` is on.

    Raises:
        ToolkitError: no graphics driver, or the viewer does not get there.
    """
    port = free_port(VIEWER_PORT)
    command = [str(viewer_program()), *map(str, files), "--headless", "--port", str(port), "--window-size", size]
    calm = os.environ | {"RUST_LOG": "error"}  # what it would log it also shows, over the picture
    process = subprocess.Popen(command, env=calm, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        if not _answers(port, process):
            raise ToolkitError(CANNOT_DRAW)
        picture = _picture(port, process, files[0], at, timeline)
    finally:
        process.terminate()
        process.wait()
    try:
        out.write_bytes(picture)
    except OSError as error:
        raise ToolkitError(f"{out} cannot be written ({error.strerror})") from None


def _picture(port: int, process: subprocess.Popen, file: Path, at: float | None, timeline: str) -> bytes:
    """What a viewer without a screen shows, as a PNG, once it shows the recording; a busy machine draws slowly."""
    from rerun.experimental import ViewerClient

    deadline = time.monotonic() + STILL_PATIENCE
    while time.monotonic() < deadline and process.poll() is None:
        try:
            client = ViewerClient(f"127.0.0.1:{port}")
            if _shows(client):
                client.run_command("ui.toggle_top_panel")
                if at is not None and timeline == FILM:
                    client.set_time(timeline, duration=float(at), play_state="paused")
                elif at is not None:
                    client.set_time(timeline, sequence=int(at), play_state="paused")
                return _settled(client, deadline)
        except (TimeoutError, RuntimeError, ConnectionError):
            pass  # it is still opening; what rerun's client says of it helps nobody
        time.sleep(LOOK)
    if process.poll() is not None:  # it breaks down in its first frame where there is no driver
        raise ToolkitError(CANNOT_DRAW)
    raise ToolkitError(f"the viewer did not show {file} within {STILL_PATIENCE:.0f} s; if the machine is not busy, see: meta-evolve doctor")


def _settled(client: "ViewerClient", deadline: float) -> bytes:
    """The picture that does not change any more; on a busy machine, the last one before the deadline."""
    before, picture = b"", client.take_screenshot()
    while picture != before and time.monotonic() < deadline:
        time.sleep(LOOK)
        before, picture = picture, client.take_screenshot()
    return picture


def _shows(client: "ViewerClient") -> bool:
    state = client.get_state()
    return bool(getattr(state, "recordings", None)) and getattr(state, "active_recording", True) is not None


def reader_of(path: Path) -> RrdReader:
    """Open a recording for reading; its chunks are read by ``chunks_of`` alone.

    Raises:
        ToolkitError: it cannot be read, is cut off, or is no recording.
    """
    try:
        with open(path, "rb") as file:
            mark = file.read(4)
    except OSError as error:
        raise ToolkitError(f"recording {path} cannot be read ({error.strerror}); check the path") from None
    if mark != b"RRF2":
        if mark[:3] == b"RRF":
            raise _unreadable(path, "was written by an old version of Rerun")
        raise ToolkitError(f"{path} is not a Rerun recording; give an .rrd file written by `meta-evolve transfer`")
    if _ends_its_reader(path):
        raise _unreadable(path, "is damaged, so that its reader breaks down")
    try:
        with warnings.catch_warnings():  # a running or killed transfer's file has no footer, and reads well without
            warnings.simplefilter("ignore")
            reader = RrdReader(path)
            found = reader.recordings()
    except UNREADABLE as error:
        raise _unreadable(path, _why(error)) from None
    if not found:
        raise _unreadable(path, "is cut off: it holds no recording")
    return reader


def chunks_of(path: Path) -> Iterator[Chunk]:
    """A recording's chunks, one after the other: what opens well may still be damaged, or of another version, further on.

    Raises:
        ToolkitError: as soon as one cannot be read.
    """
    try:
        yield from reader_of(path).stream()
    except UNREADABLE as error:
        raise _unreadable(path, _why(error)) from None


def _ends_its_reader(path: Path) -> bool:
    """Whether a file makes rerun's reader end its process, as some damage does: asked of the viewer's program, in one of its own."""
    command = [str(viewer_program()), "rrd", "verify", str(path)]
    try:
        status = subprocess.run(command, capture_output=True, check=False, timeout=LONGEST).returncode
    except subprocess.TimeoutExpired:
        return True
    return status not in (0, 1)  # 1 is a complaint, as of a running transfer's missing end, which the reader here does not mind


UNREADABLE = (RuntimeError, ValueError, TypeError, OSError, MemoryError)
"""What rerun and Arrow raise on a damaged file, here or where its chunks are taken apart."""


def _why(error: BaseException) -> str:
    text = " ".join(str(error).split())
    if "incompatible" in text:
        return f"was written by another version of Rerun ({text.rsplit(': ', 1)[-1][:100]})"
    return f"is cut off or damaged ({text.rsplit(': ', 1)[-1][:100]})"


def _unreadable(path: Path, why: str) -> ToolkitError:
    return ToolkitError(f"recording {path} {why}; make it anew with `{told('view', path.parent, '--rebuild')}`")


def free_port(wanted: int) -> int:
    """The wanted port if nobody listens on it, else any free one."""
    for port in (wanted, 0):
        with socket.socket() as probe:
            try:
                probe.bind(("127.0.0.1", port))
                return probe.getsockname()[1]
            except OSError:
                continue
    raise ToolkitError("no port is free on this machine")


def _answers(port: int, process: subprocess.Popen, patience: float = 30.0) -> bool:
    deadline = time.monotonic() + patience
    while time.monotonic() < deadline and process.poll() is None:
        with socket.socket() as probe:
            probe.settimeout(1.0)
            if probe.connect_ex(("127.0.0.1", port)) == 0:
                return True
        time.sleep(0.2)
    return False

"""What a command prints: JSON or text, tables, progress."""

import json
import os
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TextIO

from toolkit.errors import ToolkitError
from toolkit.io.quoting import plain

PICTURES = (".png", ".svg", ".pdf", ".eps", ".ps", ".jpg", ".jpeg", ".tif", ".tiff", ".webp")
"""Endings of pictures that matplotlib writes without anything else installed."""


class Outlet:
    """Standard output or error, whose loss ends no command: what is printed once it is lost is dropped.

    A reader that has gone (`| head`) wants no more; a full disk is told by the exit status. Neither undoes what the command does.

    Args:
        stream: the text stream.

    Attributes:
        lost: why nothing can be written any more; None while it can.
    """

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream
        self.lost: OSError | None = None

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def write(self, text: str) -> int:
        """As of a text stream, but for errors."""
        if self.lost is None:
            try:
                self._stream.write(text)
            except OSError as error:
                self._lose(error)
        return len(text)

    def flush(self) -> None:
        """As of a text stream, but for errors."""
        if self.lost is None:
            try:
                self._stream.flush()
            except OSError as error:
                self._lose(error)

    def _lose(self, error: OSError) -> None:
        self.lost = error
        try:  # what is still buffered would be tried again, and complained of, when the interpreter ends
            nowhere = os.open(os.devnull, os.O_WRONLY)
            os.dup2(nowhere, self._stream.fileno())
            os.close(nowhere)
        except (OSError, ValueError):
            pass  # a stream without a file of its own, as in a test


@contextmanager
def outlets() -> Iterator[tuple[Outlet, Outlet]]:
    """Standard output and error as outlets, for the time of a command."""
    before = sys.stdout, sys.stderr
    out, err = (Outlet(stream if stream is not None else open(os.devnull, "w")) for stream in before)
    sys.stdout, sys.stderr = out, err
    try:
        yield out, err
    finally:
        out.flush()
        err.flush()
        sys.stdout, sys.stderr = before


def emit(content: Any, as_json: bool, text: str) -> None:
    """Print one JSON value, or the text for people."""
    print(json.dumps(content) if as_json else "\n".join(map(plain, text.split("\n"))))


def table(title: str, columns: Sequence[str], rows: Sequence[Sequence[Any]]) -> None:
    """Print a table; its texts are data, never the terminal library's markup.

    On a terminal too narrow for its words it becomes a list, a line per cell: a name broken into syllables names nothing.
    """
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    said = lambda value: Text(plain(str(value)))  # noqa: E731
    table = Table(title=said(title), title_justify="left")
    for column in columns:
        table.add_column(said(column), overflow="fold")
    for row in rows:
        table.add_row(*map(said, row))
    console = Console()
    if not console.is_terminal:
        console.width = 1000  # a row stays one line in a file or a pipe
    if table.__rich_measure__(console, console.options.update(max_width=1000)).minimum <= console.width:
        console.print(table)
        return
    console.print(Text(plain(title), style="italic"))
    for row in rows:
        console.print()
        for column, value in zip(columns, row, strict=True):
            if str(value):
                console.print(Text.assemble((f"{plain(column)}: " if column else "", "bold"), said(value)))


def document(markdown: str) -> None:
    """Print Markdown: drawn, with its tables, on a terminal; as it is into a file or a pipe, where Markdown is what is wanted."""
    from rich.console import Console
    from rich.markdown import Markdown

    console = Console()
    if console.is_terminal:
        console.print(Markdown(markdown))
    else:
        print(markdown)


def room_for(file: Path | None, endings: Sequence[str] = PICTURES) -> None:
    """Refuse a picture's or page's place before the work, not after it, if nothing can be written there.

    Raises:
        ToolkitError: its folder is missing or not writable, it is a folder itself, or its name has another ending.
    """
    if file is None:
        return
    if file.suffix.lower() not in endings or file.is_dir():
        raise ToolkitError(f"the picture cannot be written to {file}; name a {' or '.join(endings[:2])} file")
    if not file.parent.is_dir() or not os.access(file.parent, os.W_OK):
        raise ToolkitError(f"{file} cannot be written: {file.parent} is no folder, or not yours to write to; choose another one")


def short(value: Any) -> str:
    """Three digits of a float, anything else as it is."""
    return f"{value:.3g}" if isinstance(value, float) else str(value)


class Progress:
    """A live line on the terminal with rate and time left; a plain line now and then where there is no terminal.

    Args:
        title: what goes on.
        quiet: say nothing but what went wrong.
        alone: False: others tell of their progress at the same time, in plain lines that begin with their titles.
    """

    def __init__(self, title: str, quiet: bool, alone: bool = True) -> None:
        from rich.console import Console
        from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
        from rich.table import Column

        self.console = Console(stderr=True)
        self.live = alone and self.console.is_terminal and not quiet
        self._prefix = "" if alone else f"{title}: "
        self.quiet = quiet
        self._last = 0.0
        text = lambda what: TextColumn(what, markup=False, table_column=Column(overflow="fold"))  # noqa: E731 - wraps, is never cut
        columns = (text("{task.description}"), BarColumn(), text("{task.fields[detail]}"), TimeElapsedColumn(), TextColumn("left"),
                   TimeRemainingColumn())
        self.bar = Progress(*columns, console=self.console, disable=not self.live)
        self._task = self.bar.add_task(title, total=None, detail="")

    def __enter__(self) -> "Progress":
        self.bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.bar.stop()

    def show(self, title: str, detail: str, done: float | None = None, total: float | None = None, now: bool = False) -> None:
        """Update the line; without a terminal print at most every ten seconds, or ``now``."""
        import time

        title, detail = plain(self._prefix + title), plain(detail)
        self.bar.update(self._task, description=title, detail=detail, completed=done or 0, total=total)
        if not self.live and not self.quiet and (now or time.monotonic() - self._last > 10.0):
            self._last = time.monotonic()
            print(f"{title}: {detail}", file=sys.stderr, flush=True)

    def count(self, title: str, total: int) -> Any:
        """A callback (done, successes) for evaluations."""
        return lambda done, successes: self.show(title, f"{successes} of {done} succeed", done, total, now=done == total)

    def recordings(self, name: str) -> Any:
        """A callback (done, total, kept) for retargeting."""
        return lambda done, total, kept: self.show(f"recordings of {name}", f"{kept} of {done} followed", done, total, now=done == total)

    def expert(self, config: Any) -> Any:
        """A callback for train_expert."""

        def seen(record: dict[str, Any]) -> None:
            if record["event"] == "demonstrations":
                self.show("demonstrations", f"{record['kept']} of {record['played']} kept", now=True)
            elif record["event"] == "trial":
                self.show(f"teacher {record['teacher']}", f"{record['kept']} of {record['played']} succeed", now=True)
            elif record["event"] == "visits":
                self.show("visits", f"the clone succeeds in {record['success']:.0%} of {record['played']}", now=True)
            elif record["event"] in ("practice", "progress"):
                self.show(record["event"], f"reward {record['reward_per_step']:.3f} a step, success {record['success_rate']:.0%}",
                          record["update"], record["of"])
            elif record["event"] == "cloning":
                self.show("cloning", f"loss {record['loss']:.4f}", record["epoch"], record["of"])
            else:
                self.show("updates", f"success {record['success']:.0%}", record["update"] + 1, config.updates, now=True)

        return seen

    def transfer(self, config: Any) -> Any:
        """A callback for Transfer: path, distance to the meta robot, success, episodes per second, budget left."""
        state: dict[str, str] = {}  # what was last known of each

        def seen(record: dict[str, Any]) -> None:
            if record["event"] == "recorded":
                if not self.quiet or record.get("trouble"):
                    self.console.print(str(record["cost"]), highlight=False, markup=False, soft_wrap=True)
                return
            if record["event"] == "preparing":
                self.show("preparing", f"measuring and merging {', '.join(record['robots'])}", now=True)
                return
            if record["event"] == "untrained":
                detail = f"{record['successes']} of {record['episodes']} succeed on the unmodified robot"
                self.show(f"direct, untrained, on {record['target']}", detail, now=True)
                return
            if record["event"] == "audited":
                self.show("audit", record["verdict"].removeprefix("audit: "), now=True)
                return
            if record["event"] == "evaluating":
                detail = f"{record['episodes']} episodes on F(beta) and on the unmodified robot"
                self.show(f"evaluating {record['target']}", detail, now=True)
                return
            success = record.get("success", record.get("train_success"))
            if "distance" in record:
                state["distance"] = f"{record['distance']:.2f} to go"
            if success is not None:
                state["success"] = f"success {success:.0%}"
            played = f"{record['sim_epochs']} training and {record['check_episodes']} checking episodes"
            rate = [f"{record['episodes_per_s']:.1f}/s"] if "episodes_per_s" in record else []
            self.show(f"{record['path']} {record['stage']}", ", ".join([record["event"], *state.values(), played, *rate]),
                      record["sim_epochs"], config.path_budget,
                      now=record["event"] in ("moved", "split", "arrived", "budget"))

        return seen

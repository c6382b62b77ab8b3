"""The commands, in the order in which --help lists them, and what becomes of their errors."""

import errno
import sys
from collections.abc import Sequence
from difflib import get_close_matches

import tyro

from toolkit import __version__
from toolkit.cli.audits import audit
from toolkit.cli.benchmarks import bench
from toolkit.cli.deployment import deploy, export, twin
from toolkit.cli.help import helped
from toolkit.cli.inspection import doctor, morph, replay, report, view
from toolkit.cli.judging import evaluate, verify
from toolkit.cli.recordings import recordings
from toolkit.cli.stressing import stress
from toolkit.cli.systems import match, robots
from toolkit.cli.terminal import outlets
from toolkit.cli.training import expert, transfer
from toolkit.cli.trees import tree
from toolkit.errors import ToolkitError
from toolkit.io.quoting import plain, told
from toolkit.quiet import silence_robosuite

COMMANDS = (robots, match, tree, audit, expert, transfer, evaluate, view, report, morph, replay, export, verify, stress, deploy, twin,
            doctor)
app = tyro.extras.SubcommandApp()
for command in COMMANDS:
    app.command(helped(command))
app.command(recordings, name="recordings", help="Recordings of hands: make a stand-in, list, retarget to the source's hand.")
app.command(bench, name="bench", help="Measure the toolkit itself.")
NAMES = (*(command.__name__ for command in COMMANDS), "recordings", "bench")
HELP = (tyro.conf.DisallowNone, tyro.conf.FlagCreatePairsOff, tyro.conf.PositionalMetavarFromFieldName)
"""Options are left out rather than given as None, switches have one form, positional arguments are called by their names."""
RESUMED = ("transfer", "expert", "bench transfer")
"""Commands whose runs go on where they were stopped."""

SURROUNDINGS = (errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EACCES, errno.EPERM, errno.EFBIG, errno.EMFILE, errno.ENFILE, errno.EIO)
"""What the machine refuses, rather than the tool does wrong: the last resort where no better sentence was found."""


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command line; exit status 0 done, 2 bad input or no room for what comes out, 1 a failure of the tool, 130 on Ctrl-C.

    The status is that of the work: a reader that has gone changes it no more than a lost line of progress does.
    """
    silence_robosuite()
    with outlets() as (out, _):
        status = _run(arguments)
        out.flush()
        if out.lost is not None and not isinstance(out.lost, BrokenPipeError) and status in (None, 0):
            status = _refuse(f"standard output cannot be written ({out.lost.strerror}); free space there, or send it elsewhere")
    if status not in (None, 0):
        raise SystemExit(status)


def _run(arguments: Sequence[str] | None) -> int | str | None:
    """One command; returns its exit status."""
    given = list(sys.argv[1:] if arguments is None else arguments)
    if given == ["--version"]:
        print(f"meta-evolve {__version__}")
        return 0
    if given and not given[0].startswith("-") and given[0] not in NAMES:
        near = get_close_matches(given[0], NAMES, n=1)
        return _refuse(f"{given[0]!r} is no command; {f'did you mean: {told(*near)}' if near else f'{told()} --help lists them'}")
    try:
        app.cli(prog="meta-evolve", description="Transfer a dexterous hand's policy to commercial arms by robot evolution.",
                args=given or ["--help"], config=HELP)
    except ToolkitError as error:
        return _refuse(str(error))
    except OSError as error:
        if error.errno not in SURROUNDINGS:  # anything else is a mistake of ours, and wants its traceback
            raise
        where = f"{error.filename} cannot be used" if error.filename else "a file or a connection cannot be used"
        return _refuse(f"{where} ({error.strerror}); free space or permissions there, or choose another place")
    except KeyboardInterrupt:
        print(f"meta-evolve: {_stopped(given)}", file=sys.stderr)
        return 130
    except SystemExit as end:
        return end.code
    return 0


def _stopped(given: Sequence[str]) -> str:
    """What a Ctrl-C leaves: of a run the whole command that continues it."""
    if not any(" ".join(given[:2]).startswith(name) for name in RESUMED):
        return "stopped"
    again = [] if "--resume" in given or given[0] == "bench" else ["--resume"]  # the suite resumes by itself
    return f"stopped; continue with: {plain(told(*given, *again))}"


def _refuse(sentence: str) -> int:
    """Say why on stderr, in one line whatever the culprit's name holds; returns the exit status."""
    print(f"meta-evolve: {plain(' '.join(sentence.split()))}", file=sys.stderr)
    return 2

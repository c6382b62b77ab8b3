"""The commands, in the order in which --help lists them, and what becomes of their errors."""

import sys
from collections.abc import Sequence

import tyro

from toolkit.cli.audits import audit
from toolkit.cli.benchmarks import bench
from toolkit.cli.deployment import deploy, export, twin
from toolkit.cli.inspection import doctor, morph, replay, report, view
from toolkit.cli.judging import evaluate, verify
from toolkit.cli.recordings import recordings
from toolkit.cli.systems import match, robots
from toolkit.cli.training import expert, transfer
from toolkit.cli.trees import tree
from toolkit.errors import ToolkitError
from toolkit.quiet import silence_robosuite

app = tyro.extras.SubcommandApp()
for command in (robots, match, tree, audit, expert, transfer, evaluate, view, report, morph, replay, export, verify, deploy, twin, doctor):
    app.command(command)
app.command(recordings, name="recordings", help="Recordings of hands: make a stand-in, list, retarget to the source's hand.")
app.command(bench, name="bench", help="Measure the toolkit itself.")


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command line; exit status 0 done, 2 bad input, 1 a failure of the tool, 130 on Ctrl-C."""
    silence_robosuite()
    try:
        app.cli(prog="meta-evolve", description="Transfer a dexterous hand's policy to commercial arms by robot evolution.",
                args=arguments)  # fmt: skip
    except ToolkitError as error:
        print(f"meta-evolve: {error}", file=sys.stderr)
        raise SystemExit(2) from None
    except BrokenPipeError:
        raise SystemExit(0) from None
    except KeyboardInterrupt:
        print("meta-evolve: stopped; a run continues with --resume", file=sys.stderr)
        raise SystemExit(130) from None

"""The command line: beside ``meta_evolve``, the only place where names become robots and tasks, and the only one that prints.

A file holds the commands of one noun. Heavy imports wait until a command needs them, so that --help answers at once.
"""

from collections.abc import Sequence


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command line; see ``toolkit.cli.app``."""
    from toolkit.cli.app import main as run

    run(arguments)

"""The command line: the only place where names become robots and tasks, and the only one that prints.

A file holds the commands of one noun. Heavy imports wait until a command needs them, so that --help answers at once.
"""

from toolkit.cli.app import main

"""python -m toolkit.cli is meta-evolve."""

from toolkit.cli import main

main()

"""Command lines that people are told to type."""

import shlex
from pathlib import Path


def told(*words: str | Path | int) -> str:
    """A command of the toolkit, its words quoted as a shell needs them."""
    plain = [f"./{word}" if isinstance(word, Path) and str(word).startswith("-") else str(word) for word in words]
    return shlex.join(["meta-evolve", *plain])

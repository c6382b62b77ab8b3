"""Names from outside, made harmless where they are shown: in a shell's line, on a terminal, in Markdown, in a picture."""

import re
import shlex
import unicodedata
from collections.abc import Callable
from functools import wraps
from pathlib import Path
from typing import ParamSpec, TypeVar

Given = ParamSpec("Given")
Made = TypeVar("Made")


def told(*words: str | Path | int) -> str:
    """A command of the toolkit, its words quoted as a shell needs them."""
    plain = [f"./{word}" if isinstance(word, Path) and str(word).startswith("-") else str(word) for word in words]
    return shlex.join(["meta-evolve", *plain])


def plain(text: str) -> str:
    """Text with every control and formatting character spelled out, so that a name from a file moves no cursor."""
    moves = lambda c: unicodedata.category(c) in ("Cc", "Cf", "Cs", "Zl", "Zp")  # noqa: E731
    return "".join(c.encode("unicode_escape").decode() if moves(c) else c for c in text)


def markdown(text: str) -> str:
    """Text as it is, in Markdown and in a cell of its tables: nothing in it is emphasis, a link, HTML or a column's end."""
    return re.sub(r"([\\`*\[\]<>|~$&]|(?<!\w)_|_(?!\w))", r"\\\1", plain(text))  # an underscore within a word is a letter


def letters(draw: Callable[Given, Made]) -> Callable[Given, Made]:
    """A function that draws with matplotlib, in whose texts a dollar is a dollar and no formula."""

    @wraps(draw)
    def drawn(*arguments: Given.args, **named: Given.kwargs) -> Made:
        import matplotlib

        with matplotlib.rc_context({"text.parse_math": False}):
            return draw(*arguments, **named)

    return drawn

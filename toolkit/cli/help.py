"""What --help says of a command."""

import inspect
import re
from collections.abc import Callable
from typing import Annotated, TypeVar

import tyro

Command = TypeVar("Command", bound=Callable[..., None])


def helped(command: Command) -> Command:
    """A command whose help reads as its docstring does.

    An argument's lines are one text, to be wrapped as the terminal wants, and a default that tells nobody anything (none of it, no)
    is not said.
    """
    command.__doc__ = re.sub(r"\n {8,}", " ", inspect.cleandoc(command.__doc__ or ""))  # deeper than the arguments: a line goes on
    for name, parameter in inspect.signature(command).parameters.items():
        if parameter.default is None or parameter.default is False or parameter.default == ():
            command.__annotations__[name] = Annotated[parameter.annotation, tyro.conf.arg(help_behavior_hint="")]
    return command

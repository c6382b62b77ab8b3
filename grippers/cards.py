"""Cards are found, not listed: a file in the folder is all that a new system needs."""

import sys
from importlib import import_module
from pkgutil import iter_modules
from typing import Protocol, TypeVar


class Named(Protocol):
    """Whatever has a name."""

    @property
    def name(self) -> str: ...


Card = TypeVar("Card", bound=Named)


BROKEN: dict[str, str] = {}
"""Module, as "robots/panda.py" -> why its cards do not load; the others load all the same."""
MISTAKES = (ValueError, TypeError, ImportError, NameError, SyntaxError, AttributeError, LookupError, ArithmeticError, OSError)
"""What a card that is written by hand raises."""


def discover(package: str, kind: type[Card]) -> dict[str, Card]:
    """Every card of a kind in the modules of a package, by its name, modules in alphabetical order.

    A module holds each card under a name of its own, or several in a dictionary ``CARDS``.

    A module that does not load, or describes what another one does, is left out and named in ``BROKEN``.

    Args:
        package: name of a package that is being imported.
        kind: class of the cards, with an attribute ``name``.
    """
    found: dict[str, Card] = {}
    where: dict[str, str] = {}
    for module in sorted(info.name for info in iter_modules(sys.modules[package].__path__)):
        try:
            said = vars(import_module(f"{package}.{module}"))
            cards = [card for card in (*said.values(), *said.get("CARDS", {}).values()) if isinstance(card, kind)]
            twice = next((card.name for card in cards if found.get(card.name, card) is not card), None)
            if twice is not None:
                raise ValueError(f"{where[twice]}.py and {module}.py in {package}/ both describe {twice!r}; rename one of the two")
        except MISTAKES as error:
            BROKEN[f"{package}/{module}.py"] = " ".join(str(error).split()) or type(error).__name__
            continue
        for card in cards:
            found.setdefault(card.name, card)
            where.setdefault(card.name, module)
    return found

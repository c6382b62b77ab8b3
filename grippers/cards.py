"""Cards are found, not listed: a file in the folder is all that a new system needs."""

import sys
from importlib import import_module
from pkgutil import iter_modules
from typing import TypeVar

Card = TypeVar("Card")


def discover(package: str, kind: type[Card]) -> dict[str, Card]:
    """Every card of a kind in the modules of a package, by its name, modules in alphabetical order.

    Args:
        package: name of a package that is being imported.
        kind: class of the cards, with an attribute ``name``.

    Raises:
        ValueError: two cards have one name.
    """
    found: dict[str, Card] = {}
    where: dict[str, str] = {}
    for module in sorted(info.name for info in iter_modules(sys.modules[package].__path__)):
        for card in vars(import_module(f"{package}.{module}")).values():
            if isinstance(card, kind):
                name = card.name
                if found.setdefault(name, card) is not card:
                    raise ValueError(f"{where[name]}.py and {module}.py in {package}/ both describe {name!r}; rename one of the two")
                where.setdefault(name, module)
    return found

"""Tasks by name, one file each; looked for when they are asked for, so that the readers in this package need no robosuite."""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from tasks.pick import PickTask

    TASKS: dict[str, PickTask]

__all__ = ["TASKS"]


def __getattr__(name: str) -> Any:
    if name != "TASKS":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from grippers.cards import discover
    from tasks.pick import PickTask

    found = globals()["TASKS"] = discover(__name__, PickTask)
    return found

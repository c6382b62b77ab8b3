"""Tasks by name; loaded when they are asked for, so that the readers in this package need no robosuite."""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from tasks.pick import TASKS, PickTask

__all__ = ["TASKS", "PickTask"]


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from tasks import pick

    return getattr(pick, name)

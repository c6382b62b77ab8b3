"""Tasks by name, one file each; looked for when they are asked for, so that the readers in this package need no robosuite."""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from tasks.pick import PickTask
    from tasks.task import ModelTask

    TASKS: dict[str, PickTask]
    MODEL_TASKS: dict[str, ModelTask]

__all__ = ["MODEL_TASKS", "TASKS"]


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from grippers.cards import discover
    from tasks.pick import PickTask
    from tasks.task import ModelTask

    found = globals()[name] = discover(__name__, PickTask if name == "TASKS" else ModelTask)
    return found

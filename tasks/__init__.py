"""Tasks by name."""

from tasks.pick import TASKS, PickTask

__all__ = ["TASKS", "PickTask"]

"""Recorded steps of a task: what was observed, what was done. One file of plain arrays per task; see docs/demonstrations.md."""

from collections.abc import Sequence
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path

import numpy as np

from tasks.npz import ArrayError, Arrays
from tasks.task import Task
from toolkit.errors import ToolkitError
from toolkit.io.atomic import write_atomically

LARGEST = 1 << 30
"""[bytes] of a file of demonstrations."""
FLOATS = ("float32", "float64")
INTEGERS = ("int32", "int64")


@dataclass(frozen=True, eq=False)
class Recorded:
    """Episodes of a task, step by step.

    Attributes:
        observations: (N, n_obs) what was seen before each action, in the order of the task's record.
        actions: (N, n_act) what was done, unclipped.
        lengths: (E,) steps of each episode; they follow one another.
    """

    observations: np.ndarray
    actions: np.ndarray
    lengths: np.ndarray

    def episodes(self) -> list[tuple[np.ndarray, np.ndarray]]:
        """Observations (T, n_obs) and actions (T, n_act) of each episode."""
        cuts = np.cumsum(self.lengths)[:-1]
        return list(zip(np.split(self.observations, cuts), np.split(self.actions, cuts), strict=True))


def joined(path: Path, task: Task, episodes: Sequence[tuple[np.ndarray, np.ndarray]]) -> Recorded:
    """Episodes (observations (T, n_obs), actions (T, n_act)) of a task, checked; ``path`` is named in the error.

    Raises:
        ToolkitError: none, one without steps or of another task's layout, or numbers that are not finite.
    """
    wanted = (len(task.observation.names), len(task.action.names))
    if not episodes:
        raise ToolkitError(f"{path} holds no episode; record at least one")
    for k, (observations, actions) in enumerate(episodes):
        shapes = f"observations {observations.shape} and actions {actions.shape}"
        if observations.ndim != 2 or actions.ndim != 2 or len(observations) != len(actions) or not len(observations):
            raise ToolkitError(f"{path}: episode {k} has {shapes}; give (T, {wanted[0]}) and (T, {wanted[1]}), T at least 1")
        if (observations.shape[1], actions.shape[1]) != wanted:
            raise ToolkitError(f"{path}: episode {k} has {shapes}, but task {task.name} has {wanted[0]} and {wanted[1]} numbers a step; "
                               "give a file that was recorded in this task")
        for what, array in (("observations", observations), ("actions", actions)):
            if not np.isfinite(array).all():
                step, column = np.argwhere(~np.isfinite(array))[0]
                raise ToolkitError(f"{path}: {what}[{step}, {column}] of episode {k} is {array[step, column]}; leave that episode out")
    return Recorded(
        np.concatenate([seen for seen, _ in episodes]).astype(float), np.concatenate([done for _, done in episodes]).astype(float),
        np.array([len(seen) for seen, _ in episodes]),
    )


def save_recorded(path: Path, task: Task, recorded: Recorded) -> None:
    """Write demonstrations, whole or not at all.

    Raises:
        ToolkitError: the file cannot be written.
    """
    content = BytesIO()
    np.savez_compressed(
        content, observations=recorded.observations.astype(np.float32), actions=recorded.actions.astype(np.float32),
        lengths=recorded.lengths.astype(np.int64), observation_names=np.array(task.observation.names),
        action_names=np.array(task.action.names),
    )
    try:
        write_atomically(path, content.getvalue())
    except OSError as error:
        raise ToolkitError(f"{path} cannot be written ({error.strerror}); choose a writable place") from error


def read_recorded(path: Path, task: Task) -> Recorded:
    """Read a file that ``save_recorded`` wrote, or another of the same layout.

    Raises:
        ToolkitError: it is missing, damaged, of another task, or holds numbers that are not finite.
    """
    names = {"observation_names": task.observation.names, "action_names": task.action.names}
    try:
        with Arrays(path) as arrays:
            for key, expected in names.items():
                found = arrays.read(key, (None,), ("str",), largest=1 << 20).tolist()
                if found != expected:
                    pairs = zip(found, expected, strict=False)
                    odd, right = next((pair for pair in pairs if pair[0] != pair[1]), (len(found), len(expected)))
                    raise ToolkitError(f"{path} was recorded in another task than {task.name}: its {key} have {odd!r} where {right!r} "
                                       "belongs; give a file that was recorded in this task")
            lengths = arrays.read("lengths", (None,), INTEGERS, largest=1 << 20)
            observations = arrays.read("observations", (None, len(task.observation.names)), FLOATS, largest=LARGEST, finite=False)
            actions = arrays.read("actions", (None, len(task.action.names)), FLOATS, largest=LARGEST, finite=False)
    except ArrayError as error:
        raise ToolkitError(f"{path}: {error}; docs/demonstrations.md says what a file of demonstrations holds") from None
    if not (lengths >= 1).all() or lengths.sum() != len(observations) or len(actions) != len(observations):
        raise ToolkitError(f"{path}: its lengths add up to {lengths.sum():.0f} steps, but it holds {len(observations)} observations and "
                           f"{len(actions)} actions; write as many of each")
    return joined(path, task, Recorded(observations, actions, lengths.astype(int)).episodes() if len(lengths) else [])

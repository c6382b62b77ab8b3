"""Points files: source and targets as anybody's numbers, in JSON."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from toolkit.errors import ToolkitError
from toolkit.evolution.tree import Terminal, check_terminals, checked_vector
from toolkit.io.jsonfiles import content_of, parsed


def load_points(path: str | Path) -> tuple[Terminal, tuple[Terminal, ...]]:
    """Read source and targets from a JSON file.

    The file holds {"source": {"name": str, "alpha": [D floats]}, "targets": [{"name": ..., "alpha": ...}, ...]}
    with every alpha in [0, 1].

    Raises:
        ToolkitError: the file cannot be read, is not JSON, or breaks the form above.
    """
    path = Path(path)
    content = content_of(path, "check the path")
    return read_points(parsed(content, str(path), "write source and targets as one JSON object"), str(path))


def read_points(content: Any, where: str) -> tuple[Terminal, tuple[Terminal, ...]]:
    """Source and targets of a points file's content; ``where`` names it in errors (see `load_points`)."""
    if not isinstance(content, Mapping):
        raise ToolkitError(f"{where} holds a {type(content).__name__}; write an object with source and targets.")
    for key in ("source", "targets"):
        if key not in content:
            raise ToolkitError(f'{where} has no "{key}"; add it next to {sorted(map(str, content)) or "nothing"}.')
    if not isinstance(content["targets"], Sequence) or isinstance(content["targets"], str):
        raise ToolkitError(f'{where}: "targets" is a {type(content["targets"]).__name__}; write a list of robots.')
    if not content["targets"]:
        raise ToolkitError(f'{where}: "targets" is empty; list at least one robot.')
    source = _read_robot(content["source"], f"{where}: source")
    targets = tuple(_read_robot(t, f"{where}: targets[{i}]") for i, t in enumerate(content["targets"]))
    try:
        check_terminals(source, targets, "l1", "steiner")
    except ToolkitError as error:
        raise ToolkitError(f"{where}: {error}") from error
    return source, targets


def _read_robot(entry: Any, where: str) -> Terminal:
    if not isinstance(entry, Mapping):
        raise ToolkitError(f'{where} is a {type(entry).__name__}; write an object with "name" and "alpha".')
    for key in ("name", "alpha"):
        if key not in entry:
            raise ToolkitError(f'{where} has no "{key}"; give it a name and alpha.')
    numbers = entry["alpha"]
    if not isinstance(numbers, (list, tuple, np.ndarray)) or any(
        isinstance(number, (bool, str, list, tuple)) for number in numbers
    ):
        raise ToolkitError(f'{where}: "alpha" is not a list of numbers; give it D numbers in [0, 1].')
    if not isinstance(entry["name"], str) or not entry["name"]:
        raise ToolkitError(f'{where}: "name" is {entry["name"]!r}; give it a non-empty text.')
    robot = Terminal(entry["name"], checked_vector(where, numbers))
    outside = np.flatnonzero((robot.alpha < 0) | (robot.alpha > 1))
    if outside.size:
        raise ToolkitError(
            f"{where}: alpha[{outside[0]}] is {robot.alpha[outside[0]]:g}; evolution parameters lie in [0, 1]."
        )
    return robot

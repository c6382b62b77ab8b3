"""JSON: the one way in which it is read, whatever it holds, and what becomes of arrays and paths in it."""

import json
from pathlib import Path
from typing import Any

import numpy as np

from toolkit.errors import ToolkitError

BROKEN = (ValueError, RecursionError, MemoryError)
"""What Python's parser raises: no JSON, no text, a number of thousands of digits, levels without end."""
LARGEST = 1 << 28
"""[bytes] of a file that is read at once."""


def parsed(content: bytes | str, where: str, mend: str) -> Any:
    """What a JSON text says.

    Args:
        content: the text.
        where: its name, and ``mend``: what to do about it, for the message.

    Raises:
        ToolkitError: it is no JSON.
    """
    try:
        return json.loads(content)
    except BROKEN as error:
        why = str(error) or type(error).__name__
        raise ToolkitError(f"{where} is not JSON: truncated or damaged ({why[:120]}); {mend}") from None


def parsed_object(content: bytes | str, where: str, mend: str) -> dict[str, Any]:
    """As ``parsed``, of a text that must hold one object."""
    value = parsed(content, where, mend)
    if not isinstance(value, dict):
        raise ToolkitError(f"{where} holds no JSON object, so it is not ours; {mend}")
    return value


def content_of(file: Path, mend: str) -> bytes:
    """A file's content.

    Raises:
        ToolkitError: it is missing, cannot be read, or is too large.
    """
    try:
        size = file.stat().st_size
        if size > LARGEST:
            raise ToolkitError(f"{file} has {size} bytes, more than {LARGEST}; {mend}")
        return file.read_bytes()
    except FileNotFoundError:
        raise ToolkitError(f"{file} cannot be read (it does not exist); {mend}") from None
    except OSError as error:
        raise ToolkitError(f"{file} cannot be read ({error.strerror}); {mend}") from None


def read_object(file: Path, mend: str) -> dict[str, Any]:
    """The object that a JSON file holds; errors as of ``content_of`` and ``parsed_object``."""
    return parsed_object(content_of(file, mend), str(file), mend)


def require(value: Any, shape: Any, where: str, mend: str) -> Any:
    """The value, if it has a shape; more than the shape asks for is allowed.

    Args:
        value: from JSON.
        shape: str, bool, int or float (whole numbers are floats too, and floats finite); None for null; a tuple of shapes: one of
            them; [shape]: a list of such; {key: shape}: an object with these keys; {...: shape}: an object of such values.
        where: names the value, and ``mend`` says what to do, in the message.

    Raises:
        ToolkitError: it has another shape; the message names the place.
    """
    found = _misfit(value, shape, "")
    if found is not None:
        place, why = found
        raise ToolkitError(f"{where} is damaged, or of another version: {place.removeprefix('.') or 'all of it'} {why}; {mend}")
    return value


def _misfit(value: Any, shape: Any, place: str) -> tuple[str, str] | None:
    """Where a value differs from its shape, and how; None if it fits."""
    if isinstance(shape, tuple):
        odd = [_misfit(value, one, place) for one in shape]
        return None if None in odd else odd[0]
    if isinstance(shape, list):
        if not isinstance(value, list):
            return place, "is no list"
        return next((found for i, entry in enumerate(value) if (found := _misfit(entry, shape[0], f"{place}[{i}]"))), None)
    if isinstance(shape, dict):
        if not isinstance(value, dict):
            return place, "is no object"
        wanted = {key: shape[...] for key in value} if ... in shape else shape
        lacking = next((key for key in wanted if key not in value), None)
        if lacking is not None:
            return f"{place}.{lacking}", "is missing"
        return next((found for key, one in wanted.items() if (found := _misfit(value[key], one, f"{place}.{str(key)[:40]}"))), None)
    if shape is None:
        return None if value is None else (place, "is not null")
    if shape is float:
        good = isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < 1e300
    else:
        good = isinstance(value, shape) and (shape is bool or not isinstance(value, bool))
    return None if good else (place, f"is no {'text' if shape is str else 'number' if shape is float else shape.__name__}")


def json_value(value: Any) -> Any:
    """The value as JSON reads it back: tuples and arrays as lists, NumPy scalars as Python's, paths as text."""
    if isinstance(value, dict):
        return {str(key): json_value(entry) for key, entry in value.items()}
    if isinstance(value, (list, tuple)):
        return [json_value(entry) for entry in value]
    if isinstance(value, (np.ndarray, np.generic)):
        return value.tolist()
    if isinstance(value, Path):
        return str(value)
    return value

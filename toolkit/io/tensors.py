"""Safetensors files: the one reader of policies, checkpoints and phases."""

from pathlib import Path

import numpy as np
from safetensors import SafetensorError, safe_open

from toolkit.errors import ToolkitError
from toolkit.io.jsonfiles import parsed_object

BROKEN = (SafetensorError, OSError, KeyError, TypeError, ValueError, AttributeError, OverflowError, MemoryError, RuntimeError)
"""Whatever safetensors and NumPy raise on a file that is damaged, lies about its sizes, or holds types that NumPy does not have."""


def read_tensors(file: Path, what: str, key: str, mend: str) -> tuple[dict, dict[str, np.ndarray]]:
    """The JSON object under a key of a file's header, and its arrays.

    Args:
        file: that exists.
        what: it is, for messages.
        key: of the header.
        mend: what to do about a broken one.

    Raises:
        ToolkitError: it is truncated, damaged or foreign, or holds anything but numbers.
    """
    try:
        with safe_open(file, framework="np") as opened:
            header = opened.metadata() or {}
            arrays = {name: opened.get_tensor(name) for name in opened.keys()}
    except BROKEN as error:
        raise ToolkitError(f"{file} is damaged or is not a {what} (truncated or damaged: {str(error)[:120]}); {mend}") from None
    if key not in header or not all(array.dtype.kind in "fiu" for array in arrays.values()):
        raise ToolkitError(f"{file} is not a {what} of this toolkit, so it is not ours; {mend}")
    return parsed_object(header[key], f"the header of {file}", mend), arrays

"""Random generators that go on where they were left: their exact state as JSON, and back."""

from typing import Any

import numpy as np

from toolkit.errors import ToolkitError
from toolkit.io.jsonfiles import json_value

BIT_GENERATORS = ("PCG64", "PCG64DXSM", "MT19937", "Philox", "SFC64")


def generator_state(generator: np.random.Generator) -> dict[str, Any]:
    """The exact state of a random generator as JSON values."""
    return json_value(generator.bit_generator.state)


def generator_from_state(state: dict[str, Any]) -> np.random.Generator:
    """A generator that continues where `generator_state` was taken.

    Raises:
        ToolkitError: not the state of one of NumPy's generators.
    """
    name = state.get("bit_generator") if isinstance(state, dict) else state
    if name not in BIT_GENERATORS:
        raise ToolkitError(f"random generator {str(name)[:40]!r} is unknown; it must be one of {', '.join(BIT_GENERATORS)}")
    bits = getattr(np.random, name)()
    try:
        bits.state = _like(state, bits.state)
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise ToolkitError(f"the saved state of random generator {name} is damaged ({error}); use another checkpoint") from None
    return np.random.Generator(bits)


def _like(value: Any, example: Any) -> Any:
    """`value` from JSON with lists turned back into arrays of the example's dtype."""
    if isinstance(example, dict):
        return {key: _like(value[key], example[key]) for key in example}
    if isinstance(example, np.ndarray):
        return np.array(value, dtype=example.dtype)
    return value

"""Random generators go on where they were left."""

from pathlib import Path

import numpy as np
import pytest

from toolkit.errors import ToolkitError
from toolkit.runs.generators import generator_from_state, generator_state
from toolkit.runs.run import Run


@pytest.mark.parametrize("name", ["PCG64", "PCG64DXSM", "MT19937", "Philox", "SFC64"])
def test_generators_continue_exactly(tmp_path: Path, name: str) -> None:
    generator = np.random.Generator(getattr(np.random, name)(7))
    generator.normal(size=5)
    generator.integers(10, dtype=np.int32)  # leaves half a word behind
    run = Run.create(tmp_path / "a", {})
    run.save_checkpoint("c", {}, {"generator": generator_state(generator)})
    again = generator_from_state(run.load_checkpoint("c")[1]["generator"])
    np.testing.assert_array_equal(again.integers(2**31, size=9, dtype=np.int32), generator.integers(2**31, size=9, dtype=np.int32))
    np.testing.assert_array_equal(again.normal(size=9), generator.normal(size=9))


def test_damaged_generator_states_are_refused() -> None:
    for state in ({}, {"bit_generator": "os"}, {"bit_generator": "PCG64"}, {"bit_generator": "PCG64", "state": {"state": "x", "inc": 1}}):
        with pytest.raises(ToolkitError, match="random generator"):
            generator_from_state(state)

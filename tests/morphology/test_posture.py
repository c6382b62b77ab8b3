"""A start that an arm cannot take."""

from dataclasses import replace

import pytest

from robots import ROBOTS
from toolkit.errors import ToolkitError
from toolkit.morphology.posture import start_of


def test_a_base_out_of_reach_is_named_with_its_mend():
    far = replace(ROBOTS["kinova3"], name="far", base_position=(-3.0, 0.0, 0.0))
    with pytest.raises(ToolkitError, match=r"robot far: its grasp frame cannot reach .*; move base_position") as caught:
        start_of(far)
    assert "\n" not in str(caught.value), "the error is more than one sentence"

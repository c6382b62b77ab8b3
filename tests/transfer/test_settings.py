"""Settings of a transfer: what cannot be is refused by name."""

import math

import pytest

from toolkit.errors import ToolkitError
from toolkit.transfer.settings import TransferConfig


def test_the_search_goes_with_adaptive_steps():
    with pytest.raises(ToolkitError, match="give learner 'npg' for fixed ones"):
        TransferConfig(learner="search", step="fixed")


@pytest.mark.parametrize(
    "field, value",
    [("threshold", 0.0), ("threshold", 1.2), ("goal", 0.0), ("goal", 85), ("shrink", 0.0), ("shrink", 1.5), ("xi", 0.0),
     ("xi", -0.1), ("xi", math.nan), ("threshold", math.nan)],
)
def test_shares_and_lengths_are_checked(field, value):
    with pytest.raises(ToolkitError, match=rf"{field} is {value}; give a number in"):
        TransferConfig(**{field: value})


@pytest.mark.parametrize(
    "field, value",
    [("check_episodes", 0), ("goal_episodes", 0), ("check_every", 0), ("path_budget", -1), ("step", "leap"), ("seed", -1),
     ("kind", "star"), ("metric", "l3"), ("path", "winding"), ("pull", 0.0), ("pull", math.nan), ("jacobian_episodes", 1)],
)
def test_the_rest_is_checked_in_the_constructor_too(field, value):
    with pytest.raises(ToolkitError, match=field):
        TransferConfig(**{field: value})

"""Two robots whose pages and pictures are looked at, merged once for all tests of them."""

import pytest


@pytest.fixture(scope="session")
def small(task):
    """ADROIT and Jaco, merged."""
    from robots import ROBOTS
    from toolkit.morphology.lab import Lab

    return Lab(ROBOTS["adroit"], [ROBOTS["jaco"]], task)

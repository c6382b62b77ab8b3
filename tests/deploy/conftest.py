"""The bundle that most tests of a deployment play."""

import pytest


@pytest.fixture(scope="module")
def bundle():
    from toolkit.bundle.reading import load_bundle

    return load_bundle("kinova3")

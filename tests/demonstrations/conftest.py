"""One recording, made, read and retargeted for all tests of it: tests/conftest.py keeps these files together in one process."""

import pytest


@pytest.fixture(scope="session")
def root(tmp_path_factory):
    from tasks.dexycb.standin import write_standin

    root = tmp_path_factory.mktemp("standin") / "root"
    write_standin(root, ["061_foam_brick"], each=1, seed=0)
    return root


@pytest.fixture(scope="session")
def retargeter(root):
    from robots import ROBOTS
    from toolkit.demonstrations.replay import Retargeter

    return Retargeter(root, ROBOTS["adroit"])


@pytest.fixture(scope="session")
def demonstration(retargeter):
    return retargeter.demonstration(retargeter.read(retargeter.names[0]))

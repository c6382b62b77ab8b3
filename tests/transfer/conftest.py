"""A whole transfer of the toy by adaptive and by fixed steps, played once for all tests that look at it."""

import os
from functools import cache

import pytest
from toy_transfer import Toy, config, transfer_of


@pytest.fixture(scope="module")
def unhurried():
    """The disk need not have it before the next line: no test that asks for this cuts the power."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "fsync", lambda file: None)
        yield


@pytest.fixture(scope="session")
def whole_run(tmp_path_factory):
    """step -> (transfer, toy) after a whole run."""

    @cache
    def play(step):
        toy = Toy()
        transfer = transfer_of(tmp_path_factory.mktemp(step) / "run", config(step=step), toy)
        transfer.meta_evolve()
        return transfer, toy

    return play


@pytest.fixture(scope="module", params=["adaptive", "fixed"])
def finished(request, unhurried, whole_run):
    """(transfer, toy) after a whole run; a parameter of each file, since one of the session would play the files by turns."""
    return whole_run(request.param)

"""A bundle of each target, written once for all tests of bundles: the measuring that goes into one takes ten seconds and more.

A file to itself would measure it again: tests/conftest.py keeps these files together in one process.
"""

import json
from types import SimpleNamespace

import pytest


@pytest.fixture(scope="session")
def policy(restless):
    return restless(0)


@pytest.fixture(scope="session")
def says():
    """What a run says of the policy: its config, where it came from, how often it succeeded."""
    from toolkit.bundle.manifest import Lineage, Success

    return SimpleNamespace(
        config={"source": "adroit", "targets": ["kinova3"], "transfer": {"seed": 3}},
        lineage=Lineage("adroit", ("adroit", "meta", "kinova3"), (0.0, 0.5, 1.0), "steiner", "l1", 3, 120),
        label=Success(40, 30, 0.75, (0.59, 0.86), 10**9, "nowhere: a test"),
    )


@pytest.fixture(scope="session")
def exported(policy, says, task, tmp_path_factory):
    """Target -> (folder, manifest); nobody changes the folder."""
    from robots import ROBOTS
    from toolkit.export.packing import write_bundle

    done = {}

    def export(name):
        if name not in done:
            folder = tmp_path_factory.mktemp("bundles") / name
            done[name] = folder, write_bundle(policy, ROBOTS[name], task, says.config, says.lineage, says.label, folder, episodes=(1, 1))
        return done[name]

    return export


@pytest.fixture(scope="session")
def alone(exported):
    """name -> (folder, its manifest.json as plain JSON)."""

    def read(name):
        folder, _ = exported(name)
        return folder, json.loads((folder / "manifest.json").read_text())

    return read

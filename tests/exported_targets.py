"""Robots whose bundles are measured by tests: one always, the others where the slow tests run."""

import pytest

TARGET = "jaco"
# Grippers that are hinged, the first of three fingers that start half closed; one whose arm's base turns with joint 1; one that slides.
TARGETS = (TARGET, *(pytest.param(name, marks=pytest.mark.slow) for name in ("kinova3", "iiwa", "panda")))

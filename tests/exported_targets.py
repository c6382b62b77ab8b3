"""Robots whose bundles are measured by tests: one always, the others where the slow tests run; those that are shipped; their names."""

import pytest

TARGET = "jaco"
# Grippers that are hinged, the first of three fingers that start half closed; one whose arm's base turns with joint 1; one that slides.
TARGETS = (TARGET, *(pytest.param(name, marks=pytest.mark.slow) for name in ("kinova3", "iiwa", "panda")))
SHIPPED = ("jaco", "kinova3", "iiwa")
PREFIXES = ("robot0_", "gripper0_right_")


def plain(name):
    """robosuite's name of a joint, body or geom as a bundle has it."""
    for prefix in PREFIXES:
        name = name.removeprefix(prefix)
    return "object" if name == "object_main" else name

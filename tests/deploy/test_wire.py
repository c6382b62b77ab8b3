"""Commands as JSON, there and back."""

import json

import numpy as np
import pytest

from toolkit.deploy import wire
from toolkit.deploy.arm import Command
from toolkit.errors import ToolkitError


def test_commands_survive_the_wire_and_odd_ones_do_not():
    command = Command("joint", False, np.arange(7.0), np.ones(7), 1.0, 0.5, 0.04, np.ones((3, 7)))
    again = wire.command_from_json(json.loads(json.dumps(wire.command_to_json(command))))
    assert again.waypoints.tolist() == command.waypoints.tolist() and again.grip == 1.0
    for spoil in ({"form": "osc"}, {"form": "dance"}, {"grip": "x"}, {"rate": None}, {"target": [float("nan")] * 7}):
        with pytest.raises(ToolkitError):
            wire.command_from_json(wire.command_to_json(command) | spoil)

"""What stands around robots, and what fades into what."""

import numpy as np
import pytest

from toolkit.inspection.furniture import furniture, opacity


def test_a_robot_stands_on_its_pedestal_at_a_table_with_legs(small):
    """Between the floor and the arm's base, within 2 cm of both; four legs under the top."""
    meshes = {mesh.name: mesh.vertices for mesh in furniture(small.space.matching.systems[0].model)}
    table, pedestal = meshes["table"], meshes["fixed_mount0_pedestal"]
    base = small.space.matching.systems[0].robot.base_position
    assert abs(pedestal[:, 2].min()) < 0.2 and abs(pedestal[:, 2].max() - 0.912) < 0.02
    assert pedestal[:, 0].min() < base[0] < pedestal[:, 0].max()
    low = table[table[:, 2] < 0.1]
    assert table[:, 2].max() == pytest.approx(0.8) and abs(low[:, 2].min()) < 1e-6
    assert {(x > 0, y > 0) for x, y, _ in low} == {(a, b) for a in (False, True) for b in (False, True)}


def test_one_robot_is_always_solid():
    shares = np.linspace(0.0, 1.0, 21)
    pairs = np.stack([shares, 1.0 - shares], axis=1)
    shown = opacity(pairs, pairs.max(axis=1, keepdims=True))
    assert (shown.max(axis=1) == 1.0).all() and (shown[[0, -1]].sum(axis=1) == 1.0).all()
    assert (np.abs(np.diff(shown, axis=0)) < 0.4).all(), "it fades, and does not jump"
    assert (shown[5] == (0.0, 1.0)).all(), "a robot that shows a quarter is not there"

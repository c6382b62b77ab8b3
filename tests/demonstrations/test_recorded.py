"""Recorded steps: what is saved is read, and mistakes are named."""

import io

import numpy as np
import pytest
from recorded_steps import DOOR, recorded, refusal

from toolkit.demonstrations.reading import read_demonstrations
from toolkit.demonstrations.recorded import save_recorded


def resaved(path, **changes):
    save_recorded(path, DOOR, recorded())
    with np.load(path) as arrays:
        content = dict(arrays) | changes
    buffer = io.BytesIO()
    np.savez(buffer, **{key: value for key, value in content.items() if value is not None})
    path.write_bytes(buffer.getvalue())
    return path


def test_what_is_saved_is_read(tmp_path):
    save_recorded(tmp_path / "door.npz", DOOR, recorded())
    back = read_demonstrations(tmp_path / "door.npz", DOOR)
    np.testing.assert_array_equal(back.observations, recorded().observations.astype(np.float32))
    np.testing.assert_array_equal(back.actions, recorded().actions.astype(np.float32))
    assert [len(seen) for seen, _ in back.episodes()] == [5, 6, 7]


@pytest.mark.parametrize(("changes", "why"), [
    ({"actions": None}, "actions: expected this key"),
    ({"lengths": np.array([5, 6, 8])}, "its lengths add up to 19 steps, but it holds 18 observations and 18 actions"),
    ({"lengths": np.array([19, -1])}, "its lengths add up to"),
    ({"lengths": np.array([], int)}, "its lengths add up to 0 steps"),
    ({"observations": np.array([{}] * 18)}, "observations: expected dtype float32 or float64, found object"),
    ({"observations": np.full((18, 39), np.inf)}, "observations[0, 0] of episode 0 is inf"),
    ({"action_names": np.array(DOOR.action.names[::-1])}, "'servo/THJ0' where 'servo/ARTz' belongs"),
    ({"action_names": np.array(DOOR.action.names[:-1])}, "27 where 28 belongs"),
])
def test_mistakes_in_a_file_are_named(tmp_path, changes, why):
    assert why in refusal(resaved(tmp_path / "door.npz", **changes))

"""Which reader a file of demonstrations is for: by what it begins with, whatever its name."""

import pickle

import numpy as np
import pytest
from recorded_steps import DOOR, episodes, recorded, refusal

from toolkit.demonstrations.reading import read_demonstrations
from toolkit.demonstrations.recorded import save_recorded


def test_a_missing_file_is_said(tmp_path):
    assert "cannot be read (No such file or directory)" in refusal(tmp_path / "none.pickle")


@pytest.mark.parametrize("name", ["door.npz", "door.pickle", "door"])
def test_both_layouts_are_told_apart_by_their_first_bytes(tmp_path, name):
    """The same episodes in either layout, under a name that says nothing or the wrong thing."""
    path, shown = tmp_path / name, recorded()
    save_recorded(tmp_path / "saved.npz", DOOR, shown)
    for content in ((tmp_path / "saved.npz").read_bytes(), pickle.dumps(episodes(), 2)):
        path.write_bytes(content)
        back = read_demonstrations(path, DOOR)
        assert back.lengths.tolist() == [5, 6, 7]
        np.testing.assert_allclose(back.observations, shown.observations, rtol=1e-6)


def test_an_empty_file_is_neither(tmp_path):
    (tmp_path / "door.npz").write_bytes(b"")
    refusal(tmp_path / "door.npz")

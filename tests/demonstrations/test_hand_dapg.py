"""Demonstrations from files: both layouts are read to the number, and none of their mistakes passes or runs."""

import os
import pickle
import struct

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from recorded_steps import DOOR, episodes, recorded, refusal

from tasks.hand_suite import CARDS
from toolkit.demonstrations.hand_dapg import read_hand_dapg
from toolkit.demonstrations.reading import read_demonstrations
from toolkit.demonstrations.recorded import save_recorded
from toolkit.errors import ToolkitError


def written(path, content, protocol=2):
    path.write_bytes(pickle.dumps(content, protocol))
    return path


@pytest.mark.parametrize("protocol", range(2, pickle.HIGHEST_PROTOCOL + 1))
def test_arrays_come_out_of_a_pickle_as_they_went_in(tmp_path, protocol):
    shown = episodes()
    shown[1]["observations"] = np.asfortranarray(shown[1]["observations"])
    shown[2]["actions"] = shown[2]["actions"].astype(">f4")
    recorded = read_hand_dapg(written(tmp_path / "door.pickle", shown, protocol), DOOR)
    assert recorded.lengths.tolist() == [5, 6, 7]
    for (observations, actions), original in zip(recorded.episodes(), shown, strict=True):
        np.testing.assert_array_equal(observations, original["observations"])
        np.testing.assert_array_equal(actions, original["actions"])


def test_a_pickle_of_python_2_is_read(tmp_path):
    """hand_dapg's files are as old as that: their text and their arrays' bytes are both strings of bytes."""
    def text(said):
        return b"U" + bytes([len(said)]) + said

    def array(values):
        raw = values.astype("<f8").tobytes()
        shape = b"".join(b"K" + bytes([size]) for size in values.shape) + b"\x86"
        return (b"cnumpy.core.multiarray\n_reconstruct\ncnumpy\nndarray\nK\x00\x85" + text(b"b") + b"\x87R(K\x01" + shape
                + b"cnumpy\ndtype\n" + text(b"f8") + b"K\x00K\x01\x87R(K\x03" + text(b"<") + b"NNNJ\xff\xff\xff\xffJ\xff\xff\xff\xffK\x00tb"
                + b"\x89T" + struct.pack("<i", len(raw)) + raw + b"tb")

    (shown,) = episodes(count=1)
    program = b"\x80\x02](}(" + b"".join(text(key.encode()) + array(shown[key]) for key in ("observations", "actions")) + b"ue."
    (tmp_path / "door.pickle").write_bytes(program)
    recorded = read_hand_dapg(tmp_path / "door.pickle", DOOR)
    np.testing.assert_array_equal(recorded.observations, shown["observations"])
    np.testing.assert_array_equal(recorded.actions, shown["actions"])


class Harmful:
    def __reduce__(self):
        return os.mkdir, ("harmed",)


class Built:
    def __init__(self):
        self.observations = np.zeros(3)


@pytest.mark.parametrize("protocol", range(pickle.HIGHEST_PROTOCOL + 1))
def test_nothing_in_a_pickle_is_run(tmp_path, monkeypatch, protocol):
    monkeypatch.chdir(tmp_path)
    for content in (Harmful(), [Harmful()], [{"observations": Harmful()}], Built(), [np.dtype(object)], np.array([Harmful()], object)):
        why = refusal(written(tmp_path / "door.pickle", content, protocol))
        assert "is a pickle with" in why or "nor a whole pickle" in why, why
    assert not (tmp_path / "harmed").exists(), "a pickle was run"


def test_what_a_pickle_would_run_is_named(tmp_path):
    why = refusal(written(tmp_path / "door.pickle", [{"observations": Harmful()}]))
    assert "is a pickle with a call of posix.mkdir, which could run code when it is loaded" in why


def test_an_array_that_lies_about_its_size_is_refused(tmp_path):
    content = pickle.dumps(episodes(count=1), 2)
    path = tmp_path / "door.pickle"
    path.write_bytes(content.replace(b"K\x05K'", b"K\x06K'", 1))
    assert "an array of shape (6, 39) with 195 numbers" in refusal(path)


@pytest.mark.parametrize("content", [{}, 3.0, "text", None, [3.0], [[]], [{"observations": np.zeros((2, 39))}], np.zeros(3)])
def test_what_is_no_list_of_episodes_is_said(tmp_path, content):
    assert "has no arrays 'observations' and 'actions'" in refusal(written(tmp_path / "door.pickle", content))


def test_mistakes_in_the_numbers_are_named(tmp_path):
    path = tmp_path / "door.pickle"
    assert "holds no episode" in refusal(written(path, []))
    shown = episodes()
    shown[1]["actions"][2, 3] = np.nan
    assert "actions[2, 3] of episode 1 is nan; leave that episode out" in refusal(written(path, shown))
    shown = episodes()
    shown[2]["actions"] = shown[2]["actions"][:-1]
    assert "episode 2 has observations (7, 39) and actions (6, 28)" in refusal(written(path, shown))


@pytest.mark.parametrize("task", [CARDS["hammer"], CARDS["relocate"]], ids=lambda task: task.name)
def test_another_tasks_layout_is_refused(tmp_path, task):
    """Door and relocate observe as many numbers, but have other servos."""
    assert f"but task {task.name} has" in refusal(written(tmp_path / "door.pickle", episodes()), task)
    save_recorded(tmp_path / "door.npz", DOOR, recorded())
    assert f"was recorded in another task than {task.name}" in refusal(tmp_path / "door.npz", task)


@pytest.mark.parametrize("share", [0.0, 0.01, 0.3, 0.7, 0.999])
@pytest.mark.parametrize("kind", ["door.pickle", "door.npz"])
def test_a_truncated_file_is_refused(tmp_path, share, kind):
    path = written(tmp_path / "door.pickle", episodes())
    if kind == "door.npz":
        path = tmp_path / kind
        save_recorded(path, DOOR, recorded())
    path.write_bytes(path.read_bytes()[: int(share * path.stat().st_size)])
    refusal(path)


@settings(max_examples=200)
@given(st.binary(max_size=60))
def test_no_bytes_bring_the_reader_down(tmp_path_factory, content):
    path = tmp_path_factory.mktemp("fuzz") / "x.pickle"
    for program in (content, b"\x80\x02](}(U\x0cobservations" + content, pickle.dumps(episodes(count=1), 2)[:-20] + content):
        path.write_bytes(program)
        try:
            read_demonstrations(path, DOOR)
        except ToolkitError as error:
            assert "\n" not in str(error)

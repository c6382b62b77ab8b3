"""Which reader a file of demonstrations is for."""

from recorded_steps import refusal


def test_a_missing_file_is_said(tmp_path):
    assert "cannot be read (No such file or directory)" in refusal(tmp_path / "none.pickle")

"""What a run ran on, where there is a checkout and where there is none."""

from pathlib import Path

import pytest

from toolkit.runs import provenance


def test_git_is_null_outside_a_checkout(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(provenance, "__file__", str(tmp_path / "provenance.py"))
    assert provenance.git_state() is None

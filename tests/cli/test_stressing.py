"""stress: what the command prints is what it leaves, and a test that was stopped goes on."""

import json

import pytest

from toolkit.cli import main


@pytest.mark.slow
def test_the_command(tmp_path, capsys):
    options = ["stress", "kinova3", "--episodes", "1", "--conditions", "delay", "--pairs", "0", "--workers", "1", "--out", str(tmp_path),
               "--plot", str(tmp_path / "p.png"), "--json"]
    main(options)
    found = json.loads(capsys.readouterr().out)
    assert [row["conditions"] for row in found["alone"]] == [{}, *({"delay": float(n)} for n in (1, 2, 3, 4))]
    assert found["alone"][0]["success_rate"] == 1.0 and found["ranges"]["delay"]["low"] == 0.0
    assert (tmp_path / "p.png").read_bytes()[:4] == b"\x89PNG" and json.loads((tmp_path / "result.json").read_text()) == found
    lines = (tmp_path / "episodes.jsonl").read_text()
    main(options)
    assert json.loads(capsys.readouterr().out) == found and (tmp_path / "episodes.jsonl").read_text() == lines, "nothing is played twice"
    with pytest.raises(SystemExit):
        main(["stress", "kinova3", "--target", "jaco"])
    assert "leave --target jaco out" in capsys.readouterr().err

"""A deployment's log as curves."""

import itertools

import numpy as np
import pytest

from toolkit.bundle.reading import load_bundle
from toolkit.deploy.arm import State
from toolkit.deploy.runtime import TickLog, rehearse
from toolkit.deploy.safety import Fault
from toolkit.errors import ToolkitError
from toolkit.inspection.recording import viewer
from toolkit.inspection.recording.deployment import record_deployment


def test_a_log_becomes_curves(tmp_path):
    """Faults, warnings, states that could not be read and a torn last line included."""
    bundle = load_bundle("kinova3")
    log = TickLog(tmp_path / "log.jsonl", {"robot": "kinova3", "task": "t", "form": "osc", "pace": "real"})
    state = State(0.0, np.arange(7.0), np.array([0, 0, 0.9]), np.array([1.0, 0, 0, 0]), np.zeros(3))
    for number, tick in enumerate(itertools.islice(rehearse(bundle, "osc"), 5)):
        done = tick()
        done.times |= {"read": 0.001, "send": 0.002}
        fault = Fault("driver", "the state could not be read")
        done.fault = fault if number == 3 else None
        log.tick(0, number, fault if number == 3 else state, done, done.command, late=number == 4, now=0.05 * number)
    log.note(0, "stop", "driver: gone")
    log.close()
    with (tmp_path / "log.jsonl").open("a") as file:
        file.write('{"episode": 0, "tick"')
    told = {}
    for chunk in viewer.reader_of(record_deployment(tmp_path / "log.jsonl")).stream():
        rows = chunk.to_record_batch().to_pylist()
        told.setdefault(chunk.entity_path, []).extend(row for row in rows if row.get("Scalars:scalars") or row.get("TextDocument:text"))
    assert len(told["/time/own"]) == len(told["/arm/joints"]) == len(told["/object/height"]) == 5
    assert [row["Scalars:scalars"] for row in told["/state/held"]] == [[0, 0]] * 4 + [[0, 1]]
    assert told["/time/arm"][0]["Scalars:scalars"] == [1.0, 2.0] and told["/object/height"][0]["Scalars:scalars"] == [0.9]
    assert np.isnan(told["/arm/joints"][3]["Scalars:scalars"]).all()
    text = told["/summary"][0]["TextDocument:text"][0]
    assert "5 ticks of 1 episodes" in text and "held for driver: 1 ticks" in text and "episode 0 stopped: driver: gone" in text
    for content in ("", "{}", "[1]\n", '{"format": "meta-evolve deployment log"}\n'):
        (tmp_path / "log.jsonl").write_text(content)
        if content.startswith('{"format"'):
            record_deployment(tmp_path / "log.jsonl")  # begun, and no tick yet
        else:
            with pytest.raises(ToolkitError, match="is no deployment log"):
                record_deployment(tmp_path / "log.jsonl")

"""No unsafe command: whatever policy and world do, commands stay within the manifest, and a lie holds the arm; and who checks it sees."""

import json

import numpy as np
import pytest

from toolkit.benchmarks.hostile import FAULTS, hostile_ticks
from toolkit.bundle.reading import load_bundle
from toolkit.cli import main
from toolkit.deploy.motion import Track, _Base
from toolkit.deploy.safety import Fault, Guard


@pytest.fixture(scope="module")
def bundle():
    return load_bundle("kinova3")


@pytest.mark.parametrize("form", ["osc", "pose", "joint"])
def test_no_hostile_tick_leaves_the_limits_and_every_lie_holds(bundle, form):
    told = []
    found = hostile_ticks(bundle, form, 1500, 7, told.append)
    assert not found.breaches and found.first == "", found
    assert found.ticks == 1500 and told == [1000] and found.episodes > 10 and found.lies > len(FAULTS)
    wanted = {"not_finite", "stale_state", "observation_jump", "joint_speed", "effort", "arm", "object_lost", "state_shape"}
    assert wanted <= set(found.faults), f"never seen: {wanted - set(found.faults)}"


def test_the_same_seed_is_the_same_world(bundle):
    first, again, other = (hostile_ticks(bundle, "osc", 300, seed) for seed in (3, 3, 4))
    assert first == again and first.faults != other.faults


def runs_away(self, wanted):
    self.rate = np.where(np.isfinite(wanted), wanted, 0.0)
    self.place = self.place + self.period * self.rate


@pytest.mark.parametrize("form, where, name, broken, what", [
    ("osc", _Base, "limited", lambda self, action: np.clip(action, self.low, self.high), "steps too far"),
    ("osc", Guard, "action", lambda self, action: None, "a command without an action"),
    ("osc", Fault, "passing", property(lambda self: True), "went on after a fault"),
    ("pose", Track, "advance", runs_away, "outside the workspace box"),
    ("joint", Track, "advance", runs_away, "acceleration is beyond the limit"),
])
def test_the_checker_sees_a_runtime_that_is_broken(bundle, monkeypatch, form, where, name, broken, what):
    monkeypatch.setattr(where, name, broken)
    never = (lambda observation: np.full(7, np.nan)) if where is Guard else None  # a wild policy is so once in 200 ticks
    found = hostile_ticks(bundle, form, 400, 7, policy=never)
    assert any(what in breach for breach in found.breaches) and found.first, found


def test_the_command_counts_and_fails_where_a_limit_is_passed(capsys, monkeypatch):
    main(["bench", "hostile", "kinova3", "--form", "osc", "--ticks", "200", "--json"])
    found = json.loads(capsys.readouterr().out)
    assert [(row["form"], row["ticks"], row["breaches"]) for row in found["forms"]] == [("osc", 200, {})]
    monkeypatch.setattr(_Base, "limited", lambda self, action: np.clip(action, self.low, self.high))
    with pytest.raises(SystemExit) as stop:
        main(["bench", "hostile", "kinova3", "--form", "osc", "--ticks", "200"])
    assert stop.value.code == 1 and "steps too far" in capsys.readouterr().out

"""Laboratory conditions: each changes what it says, nominal ones change nothing, and a test that was stopped goes on."""


import numpy as np
import pytest

from robots import ROBOTS
from toolkit.errors import ToolkitError
from toolkit.evaluation.stress import CONDITIONS, Ledger, StressedRobot, Tried, pair_trials, ranges_of, single_trials

UP = np.array([0, 0, 0.3, 0, 0, 0, -1.0])


@pytest.fixture(scope="module")
def stressed(task):
    return StressedRobot(ROBOTS["kinova3"], task)


def moved(robot, seed=3, steps=5, action=UP, **conditions):
    """Observations (steps + 1, n_obs) under conditions."""
    robot.conditions = conditions
    rows = [robot.begin(seed)]
    rows += [robot.apply(action) for _ in range(steps)]
    return np.array(rows)


def test_nominal_conditions_are_robosuites_own(stressed, native):
    moved(stressed, steps=1, **{name: condition.values[-1] for name, condition in CONDITIONS.items()})  # which leave nothing behind
    plain = native("kinova3")
    wanted = np.array([plain.begin(3), *(plain.apply(UP) for _ in range(5))])
    np.testing.assert_allclose(moved(stressed), wanted, atol=1e-12)


@pytest.fixture(scope="module")
def nominal(stressed):
    """Observations, and what the simulator holds of the object: mass, friction, size."""
    rows, model, geoms = moved(stressed), stressed.model, stressed._geoms
    return rows, (float(model.body_mass[stressed._object]), model.geom_friction[geoms].copy(), model.geom_size[geoms].copy())


@pytest.mark.parametrize("name", CONDITIONS)
def test_every_condition_changes_something(stressed, nominal, name):
    """At the start, or in the motion; of mass, friction and size, what the simulator holds."""
    before, held = nominal
    model, geoms = stressed.model, stressed._geoms
    after = moved(stressed, **{name: CONDITIONS[name].values[-1]})
    now = model.body_mass[stressed._object], model.geom_friction[geoms].copy(), model.geom_size[geoms].copy()
    told = {"object_mass": 0, "object_friction": 1, "friction": 1, "object_size": 2}
    if name in told:
        ratio = np.ravel(now[told[name]])[0] / np.ravel(held[told[name]])[0]
        assert ratio == pytest.approx(CONDITIONS[name].values[-1])
    else:
        assert np.abs(after - before).max() > 1e-4


def test_what_is_seen_late_is_what_was_seen_before(stressed):
    now, late = moved(stressed, steps=8), moved(stressed, steps=8, delay=3.0)
    np.testing.assert_allclose(late[3:], now[:-3], atol=1e-12)
    np.testing.assert_allclose(late[:3], np.repeat(now[:1], 3, axis=0), atol=1e-12)


def test_a_camera_errs_where_it_says(stressed):
    """Three numbers of the object from the grasp, the same three the other way round of the goal from the object."""
    plain, biased = moved(stressed, steps=1), moved(stressed, steps=1, pose_bias=0.01)
    shift = biased[:, -9:-6] - plain[:, -9:-6]
    assert np.linalg.norm(shift, axis=1) == pytest.approx([0.01, 0.01])
    np.testing.assert_allclose(biased[:, -3:] - plain[:, -3:], -shift, atol=1e-12)
    np.testing.assert_allclose(moved(stressed, steps=0, yaw_error=0.3)[0, -4], np.sin(0.3), atol=1e-3)


def test_the_table_stands_where_it_is_put(stressed):
    stressed.conditions = {"table_height": -0.03}
    stressed.begin(0)
    low = float(stressed.env.object_position[2])
    for _ in range(10):
        stressed.apply(np.array([0, 0, 0, 0, 0, 0, -1.0]))
    settled = float(stressed.env.object_position[2])
    stressed.conditions = {}
    stressed.begin(0)
    assert low == pytest.approx(stressed.env.object_position[2] - 0.03) and settled == pytest.approx(low, abs=2e-3)


def test_an_unknown_payload_pulls_the_hand_down(stressed):
    still = np.zeros(7)
    empty, loaded = (moved(stressed, steps=10, action=still, **c)[-1] for c in ({}, {"payload": 1.0}))
    names = slice(-15, -12)  # the grasp frame from its start
    assert loaded[names][2] < empty[names][2] - 1e-3


def tried(rates, name="object_mass"):
    return [Tried({}, 10, 10), *(Tried({name: value}, 10, round(10 * rate)) for value, rate in rates.items())]


def test_a_range_ends_where_success_does():
    assert ranges_of(tried({0.25: 1.0, 0.5: 0.8, 2.0: 0.9, 3.0: 0.5, 5.0: 1.0})) == {"object_mass": (1.0, 2.0)}
    assert ranges_of([Tried({}, 10, 8), Tried({"delay": 1.0}, 10, 10)]) == {"delay": (0.0, 0.0)}, "what fails at home holds nowhere"
    found = pair_trials({"object_mass": (0.5, 2.0), "delay": (0.0, 3.0), "payload": (0.0, 0.0)}, 20)
    assert len(found) == 20 and all(set(pair) == {"object_mass", "delay"} for pair in found)
    assert all(0.5 <= pair["object_mass"] <= 2.0 and pair["delay"] in (0, 1, 2, 3) for pair in found)
    assert pair_trials({"object_mass": (0.5, 2.0)}, 5) == []
    with pytest.raises(ToolkitError, match="no condition is named 'weight'; there are: object_mass"):
        single_trials(["weight"])


def test_a_ledger_goes_on_after_a_torn_line_and_refuses_anothers(tmp_path):
    file, about = tmp_path / "x" / "episodes.jsonl", {"policy": "a"}
    ledger = Ledger(file, about)
    ledger.add({"delay": 1.0}, 7, True)
    ledger.close()
    with file.open("a") as torn:
        torn.write('{"conditions": {"de')
    again = Ledger(file, about)
    assert list(again.known.values()) == [True]
    again.add({"delay": 2.0}, 7, False)
    again.close()
    assert list(Ledger(file, about).known.values()) == [True, False]
    with pytest.raises(ToolkitError, match="is of another stress test"):
        Ledger(file, {"policy": "b"})

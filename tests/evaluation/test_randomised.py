"""Conditions of a laboratory for the fast engine: the same as the stress test's on robosuite's own step, drawn anew per episode."""

import json

import numpy as np
import pytest

from robots import ROBOTS
from tasks.pick import OBSERVATION
from toolkit.cli import main
from toolkit.errors import ToolkitError
from toolkit.evaluation.randomised import TRAINABLE, RandomisedEngine, RandomisedRobot, evaluate_randomised, read_ranges
from toolkit.evaluation.stress import CONDITIONS, StressedRobot
from toolkit.expert.shelf import load_expert
from toolkit.learning.policy import MeanActor
from toolkit.simulation.laws import native_plant

SIZES = np.cumsum([0, *OBSERVATION.values()])
ENTRY = {name: slice(SIZES[i], SIZES[i + 1]) for i, name in enumerate(OBSERVATION)}


@pytest.fixture(scope="module")
def plant(task):
    return native_plant(ROBOTS["kinova3"], task)


@pytest.mark.parametrize("ranges", [
    {"yaw_error": (0.3, 0.3)}, {"delay": (2.0, 2.0)}, {"object_mass": (3.0, 3.0), "friction": (0.5, 0.5), "object_friction": (0.5, 0.5)},
])
def test_it_is_what_the_stress_test_does_on_robosuites_step(plant, task, ranges):
    """What needs no random number is the same by both: two engines, two pieces of code."""
    stressed = StressedRobot(ROBOTS["kinova3"], task)
    stressed.conditions = {name: low for name, (low, _) in ranges.items()}
    ours = RandomisedRobot(plant, ranges)
    actor = np.zeros(sum(task.action.values()))
    actor[2], actor[4] = -0.4, 0.1
    rows, theirs = [ours.begin(5)], [stressed.begin(5)]
    for _ in range(20):
        rows.append(ours.step(actor))
        theirs.append(stressed.step(actor))
    np.testing.assert_allclose(rows, theirs, atol=2e-6)
    plain = [plant.begin(5), *(plant.step(actor) for _ in range(20))]
    if "object_mass" not in ranges:
        assert np.abs(np.array(rows) - plain).max() > 1e-3, "it is disturbed"


def test_noise_and_bias_move_what_is_seen_and_nothing_that_is(plant, task):
    robot = RandomisedRobot(plant, {"pose_noise": (0.02, 0.02), "pose_bias": (0.05, 0.05)})
    seen, shifts = [], []
    for seed in range(60):
        row, truth = robot.begin(seed), plant.observe()
        shifts.append(row[ENTRY["object_from_grasp"]] - truth[ENTRY["object_from_grasp"]])
        np.testing.assert_allclose(row[ENTRY["goal_from_object"]] - truth[ENTRY["goal_from_object"]], -shifts[-1], atol=1e-12)
        seen.append(np.delete(row - truth, np.r_[ENTRY["object_from_grasp"], ENTRY["goal_from_object"]]))
    assert not np.any(seen)
    lengths = np.linalg.norm(shifts, axis=1)  # a bias of 5 cm in a random direction, and noise of 2 cm an axis
    assert np.sqrt((lengths**2).mean()) == pytest.approx(np.sqrt(0.05**2 + 3 * 0.02**2), rel=0.12)
    assert np.abs(np.mean(shifts, axis=0)).max() < 0.03, "in every direction"


def test_every_episode_draws_by_its_seed_and_leaves_nothing_behind(plant, task):
    ranges = {"object_mass": (0.5, 2.0), "delay": (0.0, 3.0), "start_posture": (0.0, 0.05), "friction": (0.5, 1.0)}
    mass, friction = plant.model.body_mass.copy(), plant.model.geom_friction.copy()
    robot, drawn = RandomisedRobot(plant, ranges), []
    first = robot.begin(0).copy()
    for seed in range(40):
        robot.begin(seed)
        drawn.append(tuple(robot.drawn.values()))
        item = plant.object_body
        assert plant.model.body_mass[item] == pytest.approx(mass[item] * robot.drawn["object_mass"])
        assert plant.model.geom_friction[0, 0] == pytest.approx(friction[0, 0] * robot.drawn["friction"])
    assert np.array_equal(robot.begin(0), first)
    low, high = np.array(list(ranges.values())).T
    assert len(set(drawn)) == 40 and (np.array(drawn) >= low).all() and (np.array(drawn) <= high).all()
    assert {row[1] for row in drawn} == {0.0, 1.0, 2.0, 3.0}, "a delay is a number of steps"


@pytest.mark.slow
def test_the_policy_of_a_known_robot_fares_worse_the_worse_it_is(task):
    policy, _ = load_expert("adroit", task, "adroit-061_foam_brick")
    rates = [evaluate_randomised(policy, ROBOTS["kinova3"], task, {"pose_noise": (noise, noise)}, 12).success_rate for noise in (0.0, 0.03)]
    assert rates[0] >= 0.9 > rates[1] + 0.2, rates


def test_threads_change_nothing(task):
    policy, _ = load_expert("adroit", task, "adroit-061_foam_brick")
    ranges, found = {"pose_noise": (0.0, 0.02), "delay": (0.0, 2.0)}, []
    for threads in (1, 2):
        engine = RandomisedEngine(ROBOTS["kinova3"], task, ranges, threads)
        found.append([episode.observations for episode in engine.play(MeanActor(policy), [np.zeros(1)] * 4, list(range(4)))])
        engine.close()
    assert all(np.array_equal(a, b) for a, b in zip(*found, strict=True))


@pytest.mark.parametrize("content, sentence", [
    ({"delay": [0, 4], "wind": [0, 1]}, "names 'wind', under which nothing can be trained; there are: object_mass"),
    ({"payload": [0, 1]}, "names 'payload'"),
    ({"delay": [0, 1.5]}, "counts whole policy steps"), ({"pose_noise": [0.02, 0]}, "gives pose_noise the range"),
    ({"pose_noise": 0.02}, "gives pose_noise the range 0.02"), ({"pose_noise": [-0.1, 0]}, "cannot be negative"),
    ({"object_mass": [0, 2]}, "cannot be zero"), ({}, "names no condition"), ({"delay": [0, float("nan")]}, "gives delay the range"),
])
def test_a_file_of_nonsense_is_refused_by_a_sentence(tmp_path, content, sentence):
    file = tmp_path / "lab.json"
    file.write_text(json.dumps(content))
    with pytest.raises(ToolkitError, match=sentence):
        read_ranges(file)


def test_every_condition_that_can_be_trained_under_is_one_of_the_stress_tests():
    assert set(TRAINABLE) < set(CONDITIONS)


@pytest.mark.slow
def test_a_last_hop_under_noise_is_trained_measured_and_told(tmp_path, capsys):
    file, run = tmp_path / "lab.json", tmp_path / "run"
    file.write_text(json.dumps({"pose_noise": [0.0, 0.01]}))
    main(["transfer", "--targets", "kinova3", "--expert", "adroit-061_foam_brick", "--episodes", "4", "--budget", "48", "--randomise",
          str(file), "--run", str(run), "--json"])
    report = json.loads(capsys.readouterr().out)
    assert json.loads((run / "config.json").read_text())["randomise"] == {"pose_noise": [0.0, 0.01]}
    found = report["randomised"]["kinova3"]
    assert found["conditions"] == {"pose_noise": [0.0, 0.01]} and found["untrained"]["episodes"] == found["trained"]["episodes"] == 4
    assert "under pose_noise 0 to 0.01" in (run / "summary.md").read_text()

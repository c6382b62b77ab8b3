"""robots and match: systems with their tasks, changes of one model checked by compiling them, and the merge with its figures."""

import json

import numpy as np
import pytest
from command_line import answer
from toys import CRAWL, CRAWLER_ROBOTS, HAND_ROBOTS

import robots
import tasks
from robots.model_robot import ModelRobot
from toolkit.cli import main

pytestmark = pytest.mark.usefixtures("at_home")


def test_robots(capsys):
    from robots import ROBOTS
    from tasks import MODEL_TASKS, TASKS

    found = answer(capsys, "robots")
    assert {row["name"] for row in found["robots"]} == set(ROBOTS) and set(found["tasks"]) == {*TASKS, *MODEL_TASKS}
    assert {row["name"] for row in found["robots"] if row["role"] == "source"} == {"adroit"}
    main(["robots"])
    out, _ = capsys.readouterr()
    assert all(name in out for name in ROBOTS)


@pytest.fixture
def crawlers(monkeypatch):
    """The toy family, and a robot of it that lacks a leg."""

    def legless(spec):
        spec.delete(spec.body("front"))

    cards = (*CRAWLER_ROBOTS, ModelRobot("legless", CRAWLER_ROBOTS[0].family, legless, "made up"), HAND_ROBOTS[0])
    monkeypatch.setattr(robots, "MODEL_ROBOTS", {robot.name: robot for robot in cards})
    monkeypatch.setattr(tasks, "MODEL_TASKS", {CRAWL.name: CRAWL})


def test_changes_of_a_model_are_listed_with_their_tasks(crawlers, capsys):
    main(["robots", "--json"])
    found = {row["name"]: row for row in json.loads(capsys.readouterr().out)["model_robots"]}
    assert found["long"] == {"name": "long", "role": "target", "family": "crawler", "tasks": ["crawl"]}
    assert found["crawler"]["role"] == "source" and found["toy-hand"]["tasks"] == []


def test_a_change_is_checked_where_it_plays(crawlers, capsys):
    main(["robots", "--check", "long", "--json"])
    assert json.loads(capsys.readouterr().out) == {"name": "long", "findings": [], "dimensions": {"crawl": 1}}


@pytest.mark.parametrize("name, why", [("legless", "crawl"), ("toy-hand", "no task is for robots of the family toy-hand")])
def test_what_is_wrong_with_a_change_is_said(crawlers, capsys, name, why):
    with pytest.raises(SystemExit) as stop:
        main(["robots", "--check", name, "--json"])
    told = capsys.readouterr()
    assert stop.value.code == 2 and any(why in sentence for sentence in json.loads(told.out)["findings"])
    assert f"robot {name}: 1 thing to mend" in told.err


@pytest.mark.slow
def test_the_match_of_the_robots(capsys, lab):
    """Parity is measured, 4 s per robot, so here for two of them; test_parity.py holds the figures of all."""
    lab.targets = lab.targets[:1]
    found = answer(capsys, "match", "--theta", "--episodes", "2")
    assert [(row["env"], row["episodes"]) for row in found["expert"]] == [("merged", 2), ("native-compiled", 2)]
    assert found["expert"][0]["seed"] == found["expert"][1]["seed"]
    assert found["dropped_meshes"]["kinova3"] > 0 == found["dropped_meshes"]["adroit"] and 0.0 < found["become_ms"] < 1e3
    assert found["source"] == "adroit" and found["D"] == lab.space.size
    assert [row["name"] for row in found["robots"]] == list(lab.space.matching.names[:2])
    figures = {
        "arm_fk_error_m", "arm_mass_matrix_rel_error", "pad_position_error_m", "pad_angle_error_deg", "pad_force_rel_error",
    }
    for row in found["robots"]:
        assert figures <= row.keys(), figures - row.keys()
        assert all(isinstance(row[key], float) and np.isfinite(row[key]) for key in figures), row
    assert len(found["theta"]) == found["parameters"]

"""robots: those that are changes of one model are listed with their tasks, and checked by compiling them."""

import json

import pytest
from toys import CRAWL, CRAWLER_ROBOTS, HAND_ROBOTS

import robots
import tasks
from robots.model_robot import ModelRobot
from toolkit.cli import main


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

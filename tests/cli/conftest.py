"""What several commands are tried on: an empty folder, a run with a policy, points, and the robots merged once."""

import json
from pathlib import Path

import pytest
from command_line import POINTS

import toolkit.morphology.lab
from toolkit import cli
from toolkit.cli.names import TASK, find_task
from toolkit.runs.run import Run


@pytest.fixture
def at_home(tmp_path, monkeypatch):
    """The command runs in a folder of its own."""
    monkeypatch.chdir(tmp_path)


@pytest.fixture
def learner(monkeypatch):
    """An untrained learner instead of the shipped expert, which these tests do not need."""
    from toolkit.expert.training import new_learner
    from toolkit.transfer import pipeline

    monkeypatch.setattr(pipeline, "load_expert", lambda source, task, name: new_learner(task, 0))


@pytest.fixture
def trained(tmp_path):
    """A run folder with a policy for kinova3, as `evaluate` and `export` want it."""
    from toolkit.expert.training import new_learner

    run = Run.create(tmp_path / "trained", {"source": "adroit", "targets": ["kinova3", "iiwa"], "task": TASK})
    new_learner(find_task(TASK), 0)[0].save(run.path / "kinova3.policy.safetensors")
    return "trained"


@pytest.fixture
def importable(monkeypatch):
    """Child processes find the packages also when they are not installed."""
    monkeypatch.setenv("PYTHONPATH", str(Path(cli.__file__).parents[2]))


@pytest.fixture
def points(tmp_path):
    (tmp_path / "points.json").write_text(json.dumps(POINTS))
    return "points.json"


@pytest.fixture
def lab(monkeypatch, space, merged, task):
    """The tests' own merged robot, for commands that would merge the same robots again."""
    from robots import ROBOTS
    from toolkit.morphology.lab import Lab

    made = Lab.__new__(Lab)
    made.source, *targets = (ROBOTS[name] for name in space.matching.names)
    made.targets, made.task, made.space, made.merged = tuple(targets), task, space, merged

    def same(source, targets, what):
        assert [source.name, *(robot.name for robot in targets)] == list(space.matching.names) and what == task
        return made

    monkeypatch.setattr(toolkit.morphology.lab, "Lab", same)
    return made

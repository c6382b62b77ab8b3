"""The suites: what is committed of their runs was played as they say, and nothing that they name is missing."""

import json
from pathlib import Path

import pytest

from toolkit.benchmarks.paper import PAPER
from toolkit.cli.names import find_robot, find_task
from toolkit.cli.suites import SUITES, Entry
from toolkit.expert.shelf import shipped_experts

ROOT = Path(__file__).parents[2]
PLAYED = [(suite, file.parent.name) for suite, own in SUITES.items() for file in sorted((ROOT / own.folder).glob("*/config.json"))]


def test_each_suite_stands_beside_a_table_of_the_papers():
    assert set(SUITES) == set(PAPER)


@pytest.mark.parametrize("suite", SUITES)
def test_robots_tasks_and_experts_are_there(suite):
    entries = SUITES[suite].entries
    for name, entry in entries.items():
        robots = [find_robot(robot).name for robot in (entry.source, *entry.targets)]
        assert len(set(robots)) == len(robots) and find_task(entry.task).name == entry.task, name
        assert entry.expert is None or entry.expert in shipped_experts(), f"{name}: no expert {entry.expert}"
    twice = [name for name, entry in entries.items() if list(entries.values()).count(entry) > 1]
    assert not twice, f"{twice} play the same"


@pytest.mark.parametrize("suite, name", PLAYED)
def test_a_committed_run_was_played_as_its_entry_says(suite, name):
    """By the configuration that the run itself has written; before there was a search, all learned by NPG."""
    entry = SUITES[suite].entries[name]
    told = json.loads((ROOT / SUITES[suite].folder / name / "config.json").read_bytes())
    played = {"learner": "npg"} | told["transfer"] | told
    wanted = {key: getattr(entry, key) for key in ("source", "task", "kind", "metric", "step", "seed")} | {"targets": list(entry.targets)}
    wanted |= {key: value for key in ("expert", "learner", "exploration", "xi", "enough", "path")
               if (value := getattr(entry, key)) is not None}
    wanted |= {"evaluation_episodes": entry.episodes} | ({"path_budget": entry.budget} if entry.budget else {})
    assert {key: played[key] for key in wanted} == wanted


def test_runs_of_every_suite_but_the_hands_are_committed():
    assert {suite for suite, _ in PLAYED} >= {"real-robots", "ant"} and len(PLAYED) > 30


def test_an_entry_plays_what_it_says_and_leaves_the_rest_to_the_preset():
    entry = Entry(kind="independent", metric="l2", seed=3, xi=0.7, budget=99, learner="npg", targets=("iiwa", "jaco"), episodes=7)
    job, plain = entry.job("full"), Entry().job("full")
    assert (job.source.name, [robot.name for robot in job.targets], job.task.name) == ("adroit", ["iiwa", "jaco"], "061_foam_brick")
    config = job.transfer
    assert (config.kind, config.metric, config.seed, config.xi, config.path_budget, config.learner) == (
        "independent", "l2", 3, 0.7, 99, "npg")
    assert job.evaluation_episodes == 7 and config.exploration == plain.transfer.exploration and plain.transfer.seed == 0


def test_a_paper_s_row_is_the_paper_s_whatever_the_preset():
    papers = {name: entry.job("quick").transfer for suite in SUITES.values() for name, entry in suite.entries.items() if "paper" in name}
    assert len(papers) == 4
    for name, config in papers.items():
        assert (config.step, config.xi, config.learner, config.path, config.joints) == ("fixed", 0.03, "npg", "straight", "measured"), name
        assert (config.npg.step_size, config.npg.batch_size) == (1e-4, 12) and config.path_budget == 60_000, name

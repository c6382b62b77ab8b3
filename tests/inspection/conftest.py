"""What is looked at, made once for all tests of it: two robots merged, a run that is played and drawn on them, and a family.

A file to itself would play and draw the run again: tests/conftest.py keeps these files together in one process.
"""

import numpy as np
import pytest
from rerun_rows import entities


@pytest.fixture(scope="session")
def small(task):
    """ADROIT and Jaco, merged."""
    from robots import ROBOTS
    from toolkit.morphology.lab import Lab

    return Lab(ROBOTS["adroit"], [ROBOTS["jaco"]], task)


@pytest.fixture(scope="session")
def crawlers():
    """Three crawlers, merged: robots that are changes of one model."""
    from toys import CRAWL, CRAWLER_ROBOTS

    from toolkit.morphology.lab import Lab

    return Lab(CRAWLER_ROBOTS[0], CRAWLER_ROBOTS[1:], CRAWL)


@pytest.fixture(scope="session")
def policy(task):
    """The source's shipped expert."""
    from toolkit.expert.shelf import load_expert

    return load_expert("adroit", task)[0]


@pytest.fixture(scope="session")
def run(small, policy, tmp_path_factory):
    """A run folder as a transfer leaves it: two real episodes on the way, one on the native robot."""
    from robots import ROBOTS
    from toolkit.learning.policy import MeanActor
    from toolkit.runs.phases import PhaseRecorder
    from toolkit.runs.run import Run
    from toolkit.simulation.laws import merged_plant, native_plant
    from toolkit.simulation.rollout import play

    folder = tmp_path_factory.mktemp("runs") / "run"
    made = Run.create(folder, {"source": "adroit", "targets": ["jaco"], "task": small.task.name})
    made.write_json("tree", small.tree("l1", "steiner").to_json())
    start, end = small.space.betas
    half = start + 0.5 * (end - start)
    cost = {"train_iterations": 0, "sim_epochs": 0, "check_episodes": 2, "diverged": 0}
    recorder = PhaseRecorder(folder, small.task.miss)
    mean = MeanActor(policy)
    plants = {"evolve": lambda alpha: merged_plant(small.merged, alpha, *small.merged.new()),
              "settle": lambda alpha: native_plant(ROBOTS["jaco"], small.task)}
    for second, (event, stage, before, after, seeds) in enumerate(
        [("moved", "evolve", start, half, (11, 12)), ("moved", "evolve", half, end, (11,)), ("arrived", "settle", end, end, (11,))]
    ):
        played = [play(plants[stage](after), mean, seed, after) for seed in seeds]
        recorder.record("path 1", stage, ["jaco"], before, [policy] * len(played), played, False, 0)
        success = float(np.mean([episode.success for episode in played]))
        record = {"path": "path 1", "stage": stage, **cost, "seconds": 10.0 * second}
        made.append_metrics({"event": "check", "success": success, "checked": len(played), **record})
        made.append_metrics({"event": event, "target": "jaco", "distance": 0.0, **record})
        recorder.end("path 1", stage, ["jaco"], before, after)
    policy.save(folder / "jaco.policy.safetensors")
    return folder


@pytest.fixture(scope="session")
def stored(run, small, policy):
    """That run, to be drawn or filmed."""
    from robots import ROBOTS
    from toolkit.inspection.recording.recordings import StoredRun
    from toolkit.simulation.laws import native_plant

    native = lambda name: native_plant(ROBOTS[name], small.task)  # noqa: E731
    return StoredRun(run, small.merged, policy, native, {"jaco": policy})


@pytest.fixture(scope="session")
def rebuilt(stored):
    """(file, cost) of its recording."""
    from toolkit.inspection.recording.recordings import rebuild

    cost = rebuild(stored)
    return stored.folder / "recording.rrd", cost


@pytest.fixture(scope="session")
def rows(rebuilt):
    """Entity -> rows of that recording."""
    return entities(rebuilt[0])

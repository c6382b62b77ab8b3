"""What the tests share: the robots merged once, and each unmodified robosuite robot loaded once."""

import logging

import pytest
from hypothesis import settings

# No deadlines: they would time the first call's compilation.
settings.register_profile("repeatable", deadline=None, derandomize=True)
settings.load_profile("repeatable")
logging.getLogger("robosuite_logs").addFilter(lambda record: False)  # robosuite warns of parts that no arm here has


@pytest.fixture(scope="session")
def task():
    from tasks import TASKS

    return TASKS["061_foam_brick"]


@pytest.fixture(scope="session")
def matching():
    """Every registered robot, the source first."""
    from robots import ROBOTS
    from toolkit.morphology.matching import match

    return match(list(ROBOTS.values()))


@pytest.fixture(scope="session")
def space(matching):
    from toolkit.morphology.space import EvolutionSpace

    return EvolutionSpace(matching)


@pytest.fixture(scope="session")
def merged(space, task):
    from toolkit.morphology.build import MergedRobot

    return MergedRobot(space, task)


@pytest.fixture(scope="session")
def native(task):
    """name -> the unmodified robosuite robot in its own environment; whoever uses it begins an episode of its own."""
    from robots import ROBOTS
    from toolkit.evaluation import NativeRobot

    loaded = {}

    def load(name):
        if name not in loaded:
            loaded[name] = NativeRobot(ROBOTS[name], task)
        loaded[name].begin(0)
        return loaded[name]

    return load


@pytest.fixture(scope="session")
def native_fast(task):
    """name -> the unmodified robosuite robot under the compiled control step."""
    from robots import ROBOTS
    from toolkit.simulation.plant import native_plant

    loaded = {}

    def load(name):
        if name not in loaded:
            loaded[name] = native_plant(ROBOTS[name], task)
        loaded[name].begin(0)
        return loaded[name]

    return load


@pytest.fixture(scope="session")
def engine(merged):
    """Plays on the merged robot, on two threads."""
    from toolkit.simulation.rollout import RolloutEngine

    made = RolloutEngine(merged, threads=2)
    yield made
    made.close()


@pytest.fixture
def log_elsewhere(tmp_path, monkeypatch):
    """MuJoCo writes its warnings to MUJOCO_LOG.TXT where it runs."""
    monkeypatch.chdir(tmp_path)

"""Control laws by name: every task's is there, and what it makes can be driven."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from toys import CRAWL, CRAWLER_ROBOTS, HAND_ROBOTS, LIFT

from tasks import MODEL_TASKS, TASKS
from toolkit.errors import ToolkitError
from toolkit.morphology.lab import Lab
from toolkit.simulation.laws import LAWS, Drivable, Playable, law_of, merged_plant, native_plant, native_robot


def lacking(made, protocol):
    """What a protocol names and an object lacks."""
    wanted = {*protocol.__annotations__, *(name for name in vars(protocol) if not name.startswith("_"))}
    return {name for name in wanted if not hasattr(made, name)}


def test_every_task_names_a_law_that_there_is():
    assert {law_of(task) for task in (*TASKS.values(), *MODEL_TASKS.values())} == set(LAWS.values()), "and no law is there for nobody"


def test_an_unknown_law_is_named_with_those_that_there_are():
    odd = SimpleNamespace(name="bend", control_law="telepathy")
    for make in (law_of, lambda odd: native_plant(None, odd), lambda odd: native_robot(None, odd)):
        with pytest.raises(ToolkitError, match="task 'bend' asks for the control law 'telepathy'; there are: osc, actuators"):
            make(odd)


def test_what_a_law_makes_has_all_that_players_ask_for(pair, native, native_fast):
    lab = Lab(HAND_ROBOTS[0], HAND_ROBOTS[1:], LIFT)
    driven = [native_fast("kinova3"), native_plant(HAND_ROBOTS[0], LIFT),
              *(merged_plant(own.merged, own.space.betas[0], *own.merged.new()) for own in (pair, lab))]
    for plant in driven:
        plant.begin(0)
        assert not lacking(plant, Drivable), type(plant).__name__
    for robot in (native("kinova3"), native_robot(HAND_ROBOTS[0], LIFT)):
        assert not lacking(robot, Playable), type(robot).__name__


def test_f_is_played_by_the_law_that_its_task_names(monkeypatch):
    task = replace(CRAWL, name="crawl-spied")
    lab, asked = Lab(CRAWLER_ROBOTS[0], CRAWLER_ROBOTS[1:], task), []

    def spy(*given):
        asked.append(given)
        return LAWS["actuators"].merged(*given)

    monkeypatch.setitem(LAWS, "spied", replace(LAWS["actuators"], merged=spy))
    object.__setattr__(lab.merged.task, "control_law", "spied")
    alpha = lab.space.betas[1]
    merged_plant(lab.merged, alpha, *lab.merged.new()).begin(0)
    assert len(asked) == 1 and asked[0][0] is lab.merged and np.array_equal(asked[0][1], alpha)

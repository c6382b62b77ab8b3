"""Whoever plays an episode tells a watcher the same, in the same order."""

import numpy as np
import pytest
from toys import HAND_ROBOTS, LIFT

from tasks.pick import ACTION_SIZE
from toolkit.simulation.laws import native_plant, native_robot
from toolkit.simulation.rollout import play
from toolkit.simulation.watching import Watcher


class Log(Watcher):
    """Keeps what it is told, and the simulation's time then."""

    def __init__(self):
        self.said, self.times, self.actions = [], [], []

    def _note(self, what, plant):
        self.said.append(what)
        self.times.append(float(plant.data.time))

    def begun(self, plant):
        self._note("begun", plant)

    def acting(self, plant, action):
        self._note("acting", plant)
        self.actions.append(np.array(action))

    def acted(self, plant):
        self._note("acted", plant)

    def ended(self, plant, diverged):
        self._note("diverged" if diverged else "ended", plant)


STEPS = 5


def actor(size):
    """Plays a few steps, then no number, at which every player must stop."""
    count = iter(range(STEPS + 1))
    return lambda observation, rng=None: np.full(size, 0.1 if next(count) < STEPS else np.nan)


@pytest.mark.parametrize("player", ["engine", "robosuite", "engine of a model", "gymnasium"])
def test_players_tell_every_step(player, native, native_fast):
    log = Log()
    if player == "engine":
        play(native_fast("kinova3"), actor(ACTION_SIZE), 0, np.zeros(1), log)
    elif player == "robosuite":
        native("kinova3").play(actor(ACTION_SIZE), 0, log)
    elif player == "gymnasium":
        native_robot(HAND_ROBOTS[0], LIFT).play(actor(LIFT.action.size), 0, log)
    else:
        play(native_plant(HAND_ROBOTS[0], LIFT), actor(LIFT.action.size), 0, np.zeros(1), log)
    steps = log.said.count("acted")
    assert steps in (STEPS, STEPS + 1), "the compiled engine plays the broken action, which breaks it; an environment never sees it"
    assert log.said == ["begun", *["acting", "acted"] * steps, "diverged"]
    assert all(np.array_equal(action, np.full(len(action), 0.1)) for action in log.actions[:STEPS])
    times = np.array(log.times[: 2 * STEPS + 1])
    assert (np.diff(times[::2]) > 0).all() and (times[1:-1:2] == times[:-2:2]).all(), "a step was told before or after its time"

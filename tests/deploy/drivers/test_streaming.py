"""A streamer feeds an arm with the newest command, holds it once, and says why it is fed no more; its thread is led by the test."""

import threading
from types import SimpleNamespace

import pytest
from toy_commands import joint_command

from toolkit.deploy.drivers.streaming import WATCHDOG, Streamer
from toolkit.errors import ToolkitError


def played(script, refuses=None):
    """(what the arm was told: the age of the command it was fed with, or "hold"; the streamer), for (time, command or None) in a script."""
    clock, told, done = SimpleNamespace(at=0.0), [], threading.Event()
    streamer = Streamer(SimpleNamespace(now=lambda: clock.at))

    def cycles():
        for clock.at, command in script:
            if command is not None:
                streamer.send(command)
            yield
        done.set()

    def feed(command, age):
        if clock.at == refuses:
            done.set()
            raise ToolkitError("no more")
        told.append(round(age, 6))

    streamer.begin(cycles(), feed, lambda: told.append("hold"))
    assert done.wait(5.0)
    return told, streamer


def test_the_newest_command_is_fed_with_its_age():
    go = joint_command()
    told, streamer = played([(0.0, None), (1.0, go), (1.1, None), (1.15, go), (1.2, None)])
    assert told == [0.0, 0.1, 0.0, 0.05] and streamer.trouble == ""


def test_an_arm_is_held_once_where_commands_cease_or_ask_for_it():
    go, hold = joint_command(), joint_command(hold=True)
    late = 1.0 + WATCHDOG + 1e-3
    told, _ = played([(1.0, go), (late, None), (late + 1, None), (5.0, go), (5.1, hold), (5.2, hold), (5.3, go)])
    assert told == [0.0, "hold", 0.0, "hold", 0.0]
    assert played([(0.0, None), (1.0, hold)])[0] == [], "what never moved is not held"


def test_an_arm_that_refuses_is_fed_no_more(wait_for):
    go = joint_command()
    told, streamer = played([(1.0, go), (1.1, None), (1.2, None)], refuses=1.1)
    wait_for(lambda: streamer.trouble)
    assert told == [0.0] and streamer.trouble == "no more"
    with pytest.raises(ToolkitError, match="the arm has stopped: no more"):
        streamer.send(go)
    assert streamer.end("enough") and streamer.trouble == "no more", "the first reason stays"


def test_a_streamer_ends_once_and_begins_anew():
    _, streamer = played([(0.0, None)])
    assert streamer.end("enough") and not streamer.end("again") and streamer.trouble == "enough"
    told = threading.Event()
    streamer.begin(iter([None]), lambda command, age: None, told.set)
    assert streamer.trouble == ""
    streamer.send(joint_command())
    assert streamer.end("over")

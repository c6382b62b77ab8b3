"""Who can play which task, and by which law."""

from dataclasses import replace

import pytest
from toys import CRAWLER_ROBOTS, HAND_ROBOTS, LIFT

from toolkit.errors import ToolkitError
from toolkit.morphology.lab import Lab
from toolkit.simulation.laws import LAWS, law_of


def test_who_cannot_play_is_named():
    from robots import ROBOTS
    from tasks import TASKS

    with pytest.raises(ToolkitError, match="'kinova3' cannot play task 'lift'.*family toy-hand"):
        Lab(HAND_ROBOTS[0], [ROBOTS["kinova3"]], LIFT)
    with pytest.raises(ToolkitError, match="'crawler' cannot play task 'lift'"):
        Lab(CRAWLER_ROBOTS[0], HAND_ROBOTS[1:], LIFT)
    with pytest.raises(ToolkitError, match="'short' cannot play task '061_foam_brick'.*arms with grippers"):
        Lab(ROBOTS["adroit"], [HAND_ROBOTS[1]], TASKS["061_foam_brick"])
    odd = replace(LIFT, name="odd")
    object.__setattr__(odd, "control_law", "telepathy")
    with pytest.raises(ToolkitError, match=f"'telepathy'; there are: {', '.join(LAWS)}"):
        law_of(odd)

"""Episodes of the door in the form of hand_dapg, and how a file of them is refused."""

import numpy as np
import pytest

from tasks.hand_suite import CARDS
from toolkit.demonstrations.reading import read_demonstrations
from toolkit.demonstrations.recorded import Recorded
from toolkit.errors import ToolkitError

DOOR = CARDS["door"]


def episodes(task=DOOR, count=3, steps=5):
    rng = np.random.default_rng(0)
    return [{"observations": rng.standard_normal((steps + k, len(task.observation.names))),
             "actions": rng.standard_normal((steps + k, len(task.action.names))), "rewards": rng.standard_normal(steps + k),
             "init_state_dict": {"qpos": rng.standard_normal(30), "door_body_pos": np.float64(0.5)}}
            for k in range(count)]


def refusal(path, task=DOOR):
    with pytest.raises(ToolkitError) as caught:
        read_demonstrations(path, task)
    assert "\n" not in str(caught.value) and str(caught.value).startswith(str(path)), caught.value
    return str(caught.value)


def recorded():
    shown = episodes()
    joined = {key: np.concatenate([episode[key] for episode in shown]) for key in ("observations", "actions")}
    return Recorded(joined["observations"], joined["actions"], np.array([5, 6, 7]))

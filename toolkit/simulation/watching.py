"""How one is told of every policy step of a simulated episode, by whoever plays it: the engine, robosuite's environment, gymnasium's.

A demonstration's replay, the datasheet of a bundle, a film and a divergence's last state are each a Watcher; ``States`` is the plainest.
"""

from typing import Any

import numpy as np


class Watcher:
    """Told of an episode. What it does not care about it need not define; it may read the robot, and must leave it as it is.

    The robot (``plant``) is what is played: a Drivable or a Playable, with ``model`` and ``data``.
    """

    def begun(self, plant: Any) -> None:
        """The robot stands at its start."""

    def acting(self, plant: Any, action: np.ndarray) -> None:
        """A policy step with an action (n_act,) comes next."""

    def acted(self, plant: Any) -> None:
        """That policy step was played."""

    def ended(self, plant: Any, diverged: bool) -> None:
        """No other step comes; whether the simulation has blown up."""


class States(Watcher):
    """Keeps configurations.

    Attributes:
        qpos: (nq,) at the start and after every step; T + 1 of them.
    """

    def __init__(self) -> None:
        self.qpos: list[np.ndarray] = []

    def begun(self, plant: Any) -> None:
        """See Watcher."""
        self.qpos.append(np.array(plant.data.qpos))

    def acted(self, plant: Any) -> None:
        """See Watcher."""
        self.qpos.append(np.array(plant.data.qpos))

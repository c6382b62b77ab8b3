"""Control laws by name: what turns a task's actions into controls, on F(alpha), on the unmodified robot, and where success is claimed."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol, overload

import mujoco
import numpy as np

from robots.robot import Robot
from tasks.pick import PickTask
from tasks.task import Task
from toolkit.errors import ToolkitError
from toolkit.morphology.build import MergedRobot
from toolkit.simulation.actuators import GymnasiumRobot, merged_model_plant, native_model_plant
from toolkit.simulation.native import NativeRobot
from toolkit.simulation.plant import Plant, merged_arm_plant, native_arm_plant
from toolkit.simulation.watching import Watcher


class Drivable(Protocol):
    """One robot in its task, ready to be reset and stepped by the fast engine.

    Attributes:
        model, data: the compiled scene.  task: the task.
        command: what its law integrates (n,).  goal: (3,) [m], world, where the task has one.
        before: (n_state,) STATE before the last policy step.  substeps: of physics per policy step.
        at_goal, lost, diverged: of the state now.  torque_share: largest share of its limit that a torque takes.
    """

    model: mujoco.MjModel
    data: mujoco.MjData
    command: np.ndarray
    goal: np.ndarray
    before: np.ndarray
    substeps: int

    @property
    def task(self) -> Task: ...

    @property
    def at_goal(self) -> bool: ...

    @property
    def lost(self) -> bool: ...

    @property
    def diverged(self) -> bool: ...

    @property
    def torque_share(self) -> float: ...

    def begin(self, seed: int) -> np.ndarray: ...

    def step(self, action: np.ndarray) -> np.ndarray: ...

    def set_command(self, action: np.ndarray) -> None: ...

    def play_substeps(self, action: np.ndarray, count: int, sets_goal: bool) -> None: ...

    def observe(self) -> np.ndarray: ...


class Playable(Protocol):
    """The unmodified robot in its own environment.

    Attributes:
        robot: its card.  model, data: of the environment's simulation.
        diverged: whether the simulation of the episode last played blew up.
    """

    robot: Any
    diverged: bool
    model: mujoco.MjModel
    data: mujoco.MjData

    def begin(self, seed: int) -> np.ndarray: ...

    def play(
        self, act: Callable[[np.ndarray], np.ndarray], seed: int, watcher: Watcher | None = None, native: bool = False
    ) -> bool: ...


@dataclass(frozen=True)
class ControlLaw:
    """How a robot is driven.

    Attributes:
        merged: (merged robot, alpha (D,), its model, its data) -> F(alpha), ready to be played.
        native: (robot, task) -> the unmodified robot, ready to be played by the fast engine.
        environment: (robot, task) -> the unmodified robot in its own environment.
    """

    merged: Callable[[Any, np.ndarray, mujoco.MjModel, mujoco.MjData], Drivable]
    native: Callable[[Any, Any], Drivable]
    environment: Callable[[Any, Any], Playable]


LAWS: dict[str, ControlLaw] = {
    "osc": ControlLaw(merged_arm_plant, native_arm_plant, NativeRobot),
    "actuators": ControlLaw(merged_model_plant, native_model_plant, GymnasiumRobot),
}
"""Operational-space control of an arm with closing commands of its gripper, and actions that span the actuators' own control ranges."""


def law_of(task: Task) -> ControlLaw:
    """The law that a task names.

    Raises:
        ToolkitError: there is none of that name.
    """
    if task.control_law not in LAWS:
        raise ToolkitError(f"task {task.name!r} asks for the control law {task.control_law!r}; there are: {', '.join(LAWS)}")
    return LAWS[task.control_law]


@overload
def merged_plant(merged: MergedRobot, alpha: np.ndarray, model: mujoco.MjModel, data: mujoco.MjData) -> Plant: ...


@overload
def merged_plant(merged: Any, alpha: np.ndarray, model: mujoco.MjModel, data: mujoco.MjData) -> Drivable: ...


def merged_plant(merged: Any, alpha: np.ndarray, model: mujoco.MjModel, data: mujoco.MjData) -> Drivable:
    """F(alpha) of a merged robot (MergedRobot, MergedModel) in its task; patches ``model`` in place."""
    return law_of(merged.task).merged(merged, alpha, model, data)


@overload
def native_plant(robot: Robot, task: PickTask) -> Plant: ...


@overload
def native_plant(robot: Any, task: Task) -> Drivable: ...


def native_plant(robot: Any, task: Task) -> Drivable:
    """The unmodified robot in its task, for the fast engine."""
    return law_of(task).native(robot, task)


@overload
def native_robot(robot: Robot, task: PickTask) -> NativeRobot: ...


@overload
def native_robot(robot: Any, task: Task) -> Playable: ...


def native_robot(robot: Any, task: Task) -> Playable:
    """The unmodified robot in its own environment, on whose step success is claimed."""
    return law_of(task).environment(robot, task)

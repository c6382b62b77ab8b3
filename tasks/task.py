"""What a task is to the rest of the toolkit, whatever its robots and its simulator.

Two kinds are played today: the pick, whose robots are robosuite's arms with grippers (tasks/pick.py), and tasks whose scene, robot
included, is one MuJoCo model (``ModelTask``). Both say which records they observe and act by, when they succeed, and which control law
drives their robots, by name.
"""

from abc import ABC, abstractmethod
from typing import TYPE_CHECKING, Any, ClassVar, Protocol

import numpy as np

from tasks.record import Record

if TYPE_CHECKING:
    import mujoco

    from robots.model_robot import ModelRobot


class Judge:
    """Counts the steps at the goal: the one judge of an episode, whoever plays it.

    Args:
        hold_steps, consecutive: of the task.

    Attributes:
        held: steps at the goal that count so far.
    """

    def __init__(self, hold_steps: int, consecutive: bool = True) -> None:
        self._needed, self._consecutive = hold_steps, consecutive
        self.held = 0

    def tell(self, at_goal: bool) -> bool:
        """One more policy step was played, and ended at the goal or not; whether the task has succeeded."""
        self.held = self.held + 1 if at_goal else 0 if self._consecutive else self.held
        return self.succeeded

    @property
    def succeeded(self) -> bool:
        """Whether the steps told so far are a success."""
        return self.held >= self._needed


class Task(ABC):
    """A task: what is observed and done, for how long, and what counts as success.

    Attributes:
        name: on the command line.
        control_law: name of the law that turns actions into controls.
        observation, action: the records; the same for every robot that plays the task.
        horizon: policy steps of an episode.
        control_frequency: policy rate [Hz].
        hold_steps: policy steps at the goal that make a success.
        consecutive: whether these have to follow one another.
        kin: names of tasks with the same records, whose experts serve where this one has none of its own.
    """

    control_law: ClassVar[str]
    consecutive: ClassVar[bool] = True
    kin: tuple[str, ...] = ()
    name: str
    observation: Record
    action: Record
    horizon: int
    control_frequency: float
    hold_steps: int

    def miss(self, observation: np.ndarray) -> float:
        """How far from success an episode ended that did not succeed, by its last observation (n_obs,); 0 where a task cannot tell."""
        return 0.0

    def reward(self, data: "mujoco.MjData", succeeded: bool, left: int) -> float:
        """Reward of a policy step, for its completion alone: 1 on the step that succeeds, 0 on every other.

        A task that pays more must never pay less than 0, which is what a simulation that blew up gets.

        Args:
            data: of the scene, as the step left it.
            succeeded: whether this step completed the task, which ends the episode.
            left: policy steps that the horizon would still have had.
        """
        return float(succeeded)

    def judge(self) -> Judge:
        """A judge for one episode."""
        return Judge(self.hold_steps, self.consecutive)


class Scene(Protocol):
    """A task's compiled model with its data, read and placed through indices that were looked up once.

    The models of all robots between source and targets have the same elements, so one scene serves while its model's numbers change.
    """

    def begin(self, rng: np.random.Generator) -> None:
        """Place everything for an episode, on data that was just reset (mj_resetData), and compute it (mj_forward)."""

    def observe(self) -> np.ndarray:
        """The observation (n_obs,)."""

    def at_goal(self) -> bool:
        """Whether the goal is met now."""

    def lost(self) -> bool:
        """Whether success has become impossible, so that the episode may end."""


class ModelTask(Task):
    """A task whose scene, robot included, is one MuJoCo model; any robot of one family plays it.

    Attributes:
        family: name of the family of robots (robots/model_robot.py).
        substeps: of physics per policy step.
    """

    control_law = "actuators"
    family: ClassVar[str]
    substeps: int

    @abstractmethod
    def spec(self, robot: "ModelRobot") -> "mujoco.MjSpec":
        """The unmodified robot in the task's scene, ready to be compiled."""

    @abstractmethod
    def scene(self, model: "mujoco.MjModel", data: "mujoco.MjData") -> Scene:
        """The scene of a model from ``spec``, or of any robot in between."""

    @abstractmethod
    def environment(self, robot: "ModelRobot") -> Any:
        """The unmodified robot in its own gymnasium environment, on whose ``step`` success is claimed."""


class PractisedTask(ModelTask):
    """A task whose expert learns from nothing, by reward: an easier task first, then this one."""

    @abstractmethod
    def practice(self) -> "PractisedTask":
        """The easier task, with the same records."""

    @abstractmethod
    def scattered(self) -> "PractisedTask":
        """This task with starts all over the way to success."""

    @abstractmethod
    def gains(self, observations: np.ndarray) -> np.ndarray:
        """How much nearer to success each step (T,) of an episode came, by its observations (T + 1, n_obs), the last one included."""

"""One episode, as the rollouts hand it to the learner."""

from dataclasses import dataclass, fields

import numpy as np

from toolkit.errors import ToolkitError


@dataclass(frozen=True, eq=False)
class Episode:
    """What one robot did in one attempt at one task. T steps, D evolution dimensions.

    Arrays are stored as read-only float64.

    Raises:
        ToolkitError: shapes that do not fit together, no steps, a success of a diverged simulation, or a number
            that is not finite in an episode that does not say it diverged.
    """

    observations: np.ndarray
    """(T, n_obs) what the policy saw before each action."""
    actions: np.ndarray
    """(T, n_act) what the policy sampled, before any clipping."""
    rewards: np.ndarray
    """(T,) reward of each action."""
    success: bool
    """The task counted this attempt as a success."""
    diverged: bool
    """The simulation blew up. Never a success, never rewarded; only here may arrays hold NaN."""
    terminated: bool
    """True: the last state is terminal and has no future. False: the horizon cut the episode there."""
    last_observation: np.ndarray
    """(n_obs,) what the policy would have seen next."""
    alpha: np.ndarray
    """(D,) the evolution parameters of the robot that played."""
    seed: int
    """Seed of the reset and of the policy's noise."""

    def __post_init__(self) -> None:
        for name in ("observations", "actions", "rewards", "last_observation", "alpha"):
            array = np.ascontiguousarray(getattr(self, name), dtype=np.float64).view()
            array.flags.writeable = False
            object.__setattr__(self, name, array)
        self._check_shapes()
        self._check_values()

    def _check_shapes(self) -> None:
        dimensions = {"observations": 2, "actions": 2, "rewards": 1, "last_observation": 1, "alpha": 1}
        for name, dimension in dimensions.items():
            shape = getattr(self, name).shape
            if len(shape) != dimension:
                raise ToolkitError(f"Episode.{name} has shape {shape}; give it {dimension} dimension(s).")
        steps, n_obs = self.observations.shape
        if steps == 0:
            raise ToolkitError("Episode.observations has 0 rows; an episode needs at least one step.")
        if len(self.actions) != steps or len(self.rewards) != steps:
            raise ToolkitError(
                f"Episode has {steps} observations, {len(self.actions)} actions and {len(self.rewards)} rewards; "
                "give one of each per step."
            )
        if len(self.last_observation) != n_obs:
            raise ToolkitError(
                f"Episode.last_observation has {len(self.last_observation)} entries but observations have {n_obs}; "
                "give both the same."
            )

    def _check_values(self) -> None:
        if self.diverged and self.success:
            raise ToolkitError("Episode.success is True although diverged is True; a simulation that blew up fails.")
        for field in fields(self):
            value = getattr(self, field.name)
            if isinstance(value, np.ndarray) and not self.diverged and not np.isfinite(value).all():
                raise ToolkitError(f"Episode.{field.name} is not finite (seed {self.seed}); mark it diverged.")

    @property
    def steps(self) -> int:
        """Number of actions taken, T."""
        return len(self.rewards)

    @property
    def total_reward(self) -> float:
        """Undiscounted sum of rewards; 0 if the simulation diverged."""
        return 0.0 if self.diverged else float(self.rewards.sum())

    def discounted_return(self, gamma: float) -> float:
        """Sum of gamma^t r_t (the paper's rho); 0 if the simulation diverged."""
        return 0.0 if self.diverged else float(self.rewards @ gamma ** np.arange(self.steps))

"""How a policy that is taken along sees a robot that it was not made for."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np


@dataclass(frozen=True, eq=False)
class Sight:
    """An affine map of the robot's observation: what the policy sees instead.

    Attributes:
        matrix: (n_obs, n_obs), invertible.
        constant: (n_obs,), each in its entry's unit.
    """

    matrix: np.ndarray
    constant: np.ndarray

    @classmethod
    def plain(cls, size: int) -> "Sight":
        """Of a robot whose observations (size,) are seen as they are."""
        return cls(np.eye(size), np.zeros(size))

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        """What the policy sees (..., n_obs) of observations (..., n_obs)."""
        return observation @ self.matrix.T + self.constant

    @cached_property
    def is_plain(self) -> bool:
        """Whether nothing is seen otherwise than it is."""
        return not self.constant.any() and np.array_equal(self.matrix, np.eye(len(self.constant)))

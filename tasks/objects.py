"""YCB objects of the pick tasks: primitive shapes with the scans' sizes and the published masses."""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class PickObject:
    """A graspable object.

    Attributes:
        name: YCB's name.
        shape: "box" or "cylinder".
        half_size: box: half extents (x, y, z) [m], narrow side along y, where the jaws close; cylinder: (radius,
            half height) [m], upright.
        mass: [kg].
        friction: sliding, spinning and rolling; MuJoCo's defaults, which robosuite's objects have. Of two that touch the larger
            one counts.
    """

    name: str
    shape: str
    half_size: tuple[float, ...]
    mass: float
    friction: tuple[float, float, float] = (1.0, 0.005, 0.0001)

    def __post_init__(self) -> None:
        wanted = {"box": 3, "cylinder": 2}.get(self.shape)
        if wanted is None or len(self.half_size) != wanted or min(self.half_size) <= 0 or self.mass <= 0:
            raise ValueError(f"object {self.name}: bad shape {self.shape!r}, size {self.half_size} or mass {self.mass}")
        if len(self.friction) != 3 or min(self.friction) < 0:
            raise ValueError(f"object {self.name}: bad friction {self.friction}; it has three values, none below zero")

    @property
    def half_height(self) -> float:
        """Half of the upright height [m]."""
        return self.half_size[-1]

    @property
    def width(self) -> float:
        """Extent [m] along the closing axis at zero yaw."""
        return 2 * (self.half_size[1] if self.shape == "box" else self.half_size[0])

    @property
    def volume(self) -> float:
        """[m^3]."""
        if self.shape == "box":
            x, y, z = self.half_size
            return 8 * x * y * z
        radius, half_height = self.half_size
        return 2 * np.pi * radius**2 * half_height

    def distance(self, points: np.ndarray) -> np.ndarray:
        """Signed distance (N,) [m] of points (N, 3), in the object's axes, from its surface; negative inside."""
        if self.shape == "box":
            outside = np.abs(points) - np.array(self.half_size)
        else:
            radius, half_height = self.half_size
            outside = np.stack([np.hypot(points[:, 0], points[:, 1]) - radius, np.abs(points[:, 2]) - half_height], axis=1)
        return np.linalg.norm(np.maximum(outside, 0.0), axis=1) + np.minimum(outside.max(axis=1), 0.0)


# Sizes: upright minimum-area boxes of the Google-16k scans of the YCB object set; masses: YCB object list
# (Calli et al. 2015). The soup can is a cylinder; the others are boxes lying as they stand in the scans.
_FOAM_BRICK = PickObject("061_foam_brick", "box", (0.039, 0.026, 0.0255), 0.028)

OBJECTS: dict[str, PickObject] = {
    item.name: item
    for item in (
        _FOAM_BRICK,
        PickObject("008_pudding_box", "box", (0.0565, 0.045, 0.0195), 0.187),
        PickObject("010_potted_meat_can", "box", (0.051, 0.0285, 0.042), 0.370),
        PickObject("009_gelatin_box", "box", (0.0445, 0.0365, 0.015), 0.097),
        PickObject("005_tomato_soup_can", "cylinder", (0.034, 0.051), 0.349),
    )
}

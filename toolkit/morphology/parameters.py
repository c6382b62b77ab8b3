"""The evolution space: robots as vectors theta of named physical parameters, and alpha in [0, 1]^D (paper, section 3.2).

Parameters that differ between the robots are the space. Within one element, parameters whose normalised values agree on every robot move
together as one dimension of alpha; this is how the paper comes to 65 and 105 independent parameters. Which fields there are, and what an
element is, say those who read the robots: ``space`` for arms with grippers, ``family`` for changes of one model.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from toolkit.errors import ToolkitError


@dataclass(frozen=True)
class Field:
    """A named array of parameters: one row per item (slot, shape, coupling, ...), one column per component.

    Attributes:
        name: of the quantity.
        items: name of each row.
        elements: arm joint, finger or "gripper" that each row belongs to.
        components: name of each column ("" for a single one).
        unit: of every component.
        values: (n_robots, rows, columns).
    """

    name: str
    items: tuple[str, ...]
    elements: tuple[str, ...]
    components: tuple[str, ...]
    unit: str
    values: np.ndarray


@dataclass(frozen=True)
class Parameter:
    """One entry of theta that differs between robots.

    Attributes:
        name: "item.quantity.component".
        unit: of its value.
        element: what it belongs to.
        dimension: index of the dimension of alpha that moves it.
        flipped: True if theta falls as that alpha rises.
        low, high: bounds over the robots.
        values: (n_robots,).
    """

    name: str
    unit: str
    element: str
    dimension: int
    flipped: bool
    low: float
    high: float
    values: np.ndarray


class ParameterSpace:
    """Named parameters of a set of robots and the map alpha -> theta.

    Args:
        names: of the robots, the source first.
        fields: all parameter arrays, differing or not.
        unit: of a field's row; default: the field's.

    Attributes:
        names: of the robots.
        fields: the fields, by name.
        parameters: the entries that differ, in a fixed order.
        size: D, the number of dimensions of alpha.
        betas: (n_robots, D), the robots' own alphas.

    Raises:
        ToolkitError: the robots do not differ at all.
    """

    def __init__(self, names: Sequence[str], fields: Sequence[Field], unit: Callable[[Field, int], str] = lambda f, row: f.unit) -> None:
        self.names = list(names)
        self.fields = {f.name: f for f in fields}
        self.parameters = self._parameters(unit)
        if not self.parameters:
            raise ToolkitError(f"robots {', '.join(self.names)} do not differ in any parameter, so there is no way from one to another")
        self.size = 1 + max(p.dimension for p in self.parameters)
        self.betas = np.empty((len(self.names), self.size))
        for p in self.parameters:
            normalised = (p.values - p.low) / (p.high - p.low)
            self.betas[:, p.dimension] = 1.0 - normalised if p.flipped else normalised
        self._low = np.array([p.low for p in self.parameters])
        self._span = np.array([p.high - p.low for p in self.parameters])
        self._dimension = np.array([p.dimension for p in self.parameters])
        flipped = np.array([p.flipped for p in self.parameters])
        self._offset, self._sense = np.where(flipped, 1.0, 0.0), np.where(flipped, -1.0, 1.0)
        self._places = np.array(self._positions)
        self._flat = np.concatenate([f.values[0].ravel() for f in self.fields.values()])
        self._cuts, start = [], 0
        for f in self.fields.values():
            self._cuts.append((f.name, start, start + f.values[0].size, f.values.shape[1:]))
            start += f.values[0].size

    def _parameters(self, unit: Callable[[Field, int], str]) -> list[Parameter]:
        """The differing entries, each with the dimension that moves it."""
        dimensions: dict[tuple, int] = {}
        out: list[Parameter] = []
        self._positions: list[int] = []
        offset = 0
        for f in self.fields.values():
            rows, columns = f.values.shape[1:]
            for row in range(rows):
                for column in range(columns):
                    values = f.values[:, row, column]
                    low, high = float(values.min()), float(values.max())
                    if high - low > 1e-9 * max(1.0, abs(low), abs(high)):
                        normalised = (values - low) / (high - low)
                        flipped = bool(normalised[0] > 0.5)
                        pattern = tuple(np.round(1.0 - normalised if flipped else normalised, 9))
                        dimension = dimensions.setdefault((f.elements[row], pattern), len(dimensions))
                        name = ".".join(part for part in (f.items[row], f.name, f.components[column]) if part)
                        out.append(Parameter(name, unit(f, row), f.elements[row], dimension, flipped, low, high, values))
                        self._positions.append(offset + row * columns + column)
            offset += rows * columns
        return out

    def theta(self, alpha: np.ndarray) -> dict[str, np.ndarray]:
        """Physical parameters at an evolution parameter (paper, section 3.2): field name -> (rows, columns).

        Args:
            alpha: (D,), each in [0, 1].

        Raises:
            ToolkitError: wrong size, not finite, or outside [0, 1].
        """
        flat = self._flat.copy()
        flat[self._places] = self._low + (self._offset + self._sense * self.checked(alpha)[self._dimension]) * self._span
        return {name: flat[start:stop].reshape(shape) for name, start, stop, shape in self._cuts}

    def checked(self, alpha: np.ndarray) -> np.ndarray:
        """``alpha`` as float64, refused if it is no point of the space."""
        alpha = np.asarray(alpha, float)
        if alpha.shape != (self.size,):
            raise ToolkitError(f"alpha has shape {alpha.shape}; this evolution space has {self.size} dimensions")
        if not (alpha.min() >= 0 and alpha.max() <= 1):  # nan is neither
            worst = int(np.argmax(np.where(np.isfinite(alpha), np.abs(alpha - 0.5), np.inf)))
            raise ToolkitError(f"alpha[{worst}] = {alpha[worst]} lies outside [0, 1]")
        return alpha

    def beta(self, name: str) -> np.ndarray:
        """Evolution parameter (D,) of a robot of the space, by name."""
        if name not in self.names:
            raise ToolkitError(f"robot {name!r} is not in this evolution space; it has {', '.join(self.names)}")
        return self.betas[self.names.index(name)].copy()

    def describe(self) -> list[dict]:
        """One record per parameter: name, unit, element, dimension and value per robot."""
        return [
            {"name": p.name, "unit": p.unit, "element": p.element, "dimension": p.dimension, "low": p.low,
             "high": p.high, "values": dict(zip(self.names, map(float, p.values), strict=True))}
            for p in self.parameters
        ]

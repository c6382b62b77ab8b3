"""The record that describes a robot as a change of its family's own MuJoCo model: no arm, no gripper, any number of limbs, any root."""

import re
from collections.abc import Callable
from dataclasses import dataclass

import mujoco


@dataclass(frozen=True)
class Family:
    """Robots that evolve into one another: the same bodies, joints, geoms and actuators, of other sizes.

    Attributes:
        name: a task says by it which robots it takes.
        element: (name of a body, quantity) -> what that quantity belongs to. Parameters of one element that agree on every robot are one
            dimension of the evolution space. Quantities: "size" of its geoms and where they lie in it, "mount" where the body hangs on
            its parent, "joint" its joints and what drives them, "mass", "contact", "site".
        root: the source's own root body.
    """

    name: str
    element: Callable[[str, str], str]
    root: str


@dataclass(frozen=True, eq=False)
class ModelRobot:
    """A robot of a family.

    Attributes:
        name: the toolkit's name of it.
        family: whose bodies and joints it has.
        change: edits a scene that holds the family's own robot until it holds this one; the source's own does nothing.
        datasheet: where its numbers come from.
        source_of_policy: True for a robot that experts are trained on.
    """

    name: str
    family: Family
    change: Callable[[mujoco.MjSpec], None]
    datasheet: str
    source_of_policy: bool = False

    def __post_init__(self) -> None:
        if not re.fullmatch(r"[a-z][a-z0-9_-]*", self.name):
            raise ValueError(f"robot name {self.name!r} is no name for a folder; use small letters, digits, '_' and '-'")

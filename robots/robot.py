"""The record that describes a system: an arm with a gripper on it, standing at the task's table."""

from collections.abc import Mapping
from dataclasses import dataclass, field

from grippers.gripper import Gripper


@dataclass(frozen=True, eq=False)
class Robot:
    """A robosuite arm with a gripper.

    Attributes:
        name: the toolkit's name of the system.
        arm: robosuite's name of the arm.
        gripper: what is mounted on it.
        base_position: of the arm's mount (x, y, z) [m] in the task's frame, whose origin is on the floor under the
            table's centre.
        posture_seed: arm configuration [rad] near which the start posture is sought (robosuite's own start).
        arm_friction: own arm joint -> friction torque [N m] that holds it in robosuite beyond the joint's own, where two of
            the arm's collision shapes touch: the merged robot has no collision shapes on arms. Empty for most arms.
        arm_roles: own arm joint (without robosuite's prefix) -> joint "arm1".. of the source that it shall be matched
            with; overrides what the geometry proposes. Empty for most arms.
        source_of_policy: True for a robot that experts are trained on.
        datasheet: where the arm's numbers come from.
        joint_speeds: highest joint speeds [rad/s] of the real arm, base to flange, rounded down, the maker's file named beside
            them; None: not known. robosuite has none.
    """

    name: str
    arm: str
    gripper: Gripper
    base_position: tuple[float, float, float]
    posture_seed: tuple[float, ...]
    datasheet: str
    source_of_policy: bool = False
    arm_friction: Mapping[str, float] = field(default_factory=dict)
    arm_roles: Mapping[str, str] = field(default_factory=dict)
    joint_speeds: tuple[float, ...] | None = None

    def __post_init__(self) -> None:
        if not self.name.isidentifier():
            raise ValueError(f"robot name {self.name!r} is not an identifier")

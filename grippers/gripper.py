"""The record that describes a gripper or hand to the toolkit.

A *role* names a joint of the merged hand. The roles are ADROIT's own finger joints, the slide on which a jaw travels
towards the other, and the passive inner knuckles that four-bar grippers add; a gripper says which of its joints plays
which role. Roles that it does not name are absent: in its merged robot they are frozen, massless and without shape.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field

# role -> parent role (None: the palm). Fingers: FF index, MF middle, RF ring, LF little, TH thumb.
# J-numbers are ADROIT's, distal joints have the small ones; S is a jaw's slide, which carries the whole finger; K is the
# inner knuckle of a four-bar linkage.
ROLE_PARENT: dict[str, str | None] = {
    "FFS": None, "FFJ3": "FFS", "FFJ2": "FFJ3", "FFJ1": "FFJ2", "FFJ0": "FFJ1",
    "MFJ3": None, "MFJ2": "MFJ3", "MFJ1": "MFJ2", "MFJ0": "MFJ1",
    "RFJ3": None, "RFJ2": "RFJ3", "RFJ1": "RFJ2", "RFJ0": "RFJ1",
    "LFJ4": None, "LFJ3": "LFJ4", "LFJ2": "LFJ3", "LFJ1": "LFJ2", "LFJ0": "LFJ1",
    "THS": None, "THJ4": "THS", "THJ3": "THJ4", "THJ2": "THJ3", "THJ1": "THJ2", "THJ0": "THJ1",
    "FFK": None, "THK": None,
}
ROLES: tuple[str, ...] = tuple(ROLE_PARENT)
"""Roles, parents first."""

COMMANDED_ROLES: tuple[str, ...] = tuple(role for role in ROLES if role[2] == "J")
"""Roles that the policy commands: one action entry each, -1 open, +1 closed (robosuite's sign)."""

ROLE_COMMAND: dict[str, str] = {role: role for role in COMMANDED_ROLES} | {"FFS": "FFJ2", "THS": "THJ4"}
"""Role that an actuator can drive -> commanded role that it follows: a jaw slides by what flexes its finger."""


def slides(role: str) -> bool:
    """Whether a role's joint is a slide [m] rather than a hinge [rad]."""
    return role.endswith("S")


ROLE_SENSE: dict[str, tuple[float, float, float]] = {
    "FFJ1": (1, 0, 0), "MFJ1": (1, 0, 0), "RFJ1": (1, 0, 0), "THJ1": (1, 0, 0), "FFK": (1, 0, 0), "THK": (-1, 0, 0),
}
"""Positive sense of roles that no actuator closes: the world direction, at the start posture, on whose side the joint's
axis lies when its angle counts as positive. Driven roles count positive in the closing sense."""

CLOSING_ROLES: tuple[str, ...] = ("FFJ2", "FFJ1", "THJ4", "THJ1")
"""Roles whose mean command is the one closing command of a gripper: the flexion of index and thumb."""


@dataclass(frozen=True, eq=False)
class Gripper:
    """A gripper or hand that robosuite can mount.

    Attributes:
        name: the toolkit's name.
        robosuite_type: key in robosuite's gripper registry.
        joints: role -> joint name in the gripper's MJCF, without robosuite's prefix.
        targets: role -> (open, closed) position target [rad, m for a slide] of the actuator on that role's joint, in
            the gripper's own joint coordinate. Roles without an actuator are left out.
        rate: change of the closing command per policy step [command/step], robosuite's own (its gripper class's
            ``speed``); None: every role follows its own target at once, as a hand does.
        preshape: closing command at the start of an episode, in [-1, 1]; the task's choice, not robosuite's.
        four_bar: True for jaws on four-bar linkages that robosuite keeps in shape by mesh against mesh. The merged
            robot replaces each by an elastic open chain, measured on the gripper itself: the driven knuckle and the
            pad joint on springs (toolkit/morphology/linkage.py), the inner knuckle as dead weight.
        welded: role -> body (without robosuite's prefix) that plays it without a joint of its own: a jaw's pad. Its
            shapes then belong to the same link as the fingertips of other hands, into which they evolve.
        source: where rate, targets and preshape come from.
    """

    name: str
    robosuite_type: str
    joints: Mapping[str, str]
    targets: Mapping[str, tuple[float, float]]
    rate: float | None
    preshape: float
    source: str
    four_bar: bool = False
    welded: Mapping[str, str] = field(default_factory=dict)
    notes: str = field(default="")

    def __post_init__(self) -> None:
        unknown = [role for role in (*self.joints, *self.targets, *self.welded) if role not in ROLE_PARENT]
        if unknown:
            raise ValueError(f"gripper {self.name}: unknown role {unknown[0]!r}; the roles are {', '.join(ROLES)}")
        idle = [role for role in self.targets if role not in self.joints]
        if idle:
            raise ValueError(f"gripper {self.name}: role {idle[0]!r} has a target but no joint")
        undriven = [role for role in self.targets if role not in ROLE_COMMAND]
        if undriven:
            raise ValueError(f"gripper {self.name}: role {undriven[0]!r} is passive and cannot have a target; name a driven role")
        twice = [role for role in self.welded if role in self.joints]
        if twice:
            raise ValueError(f"gripper {self.name}: role {twice[0]!r} names both a joint and a welded body; keep one")
        if not -1.0 <= self.preshape <= 1.0:
            raise ValueError(f"gripper {self.name}: preshape {self.preshape} lies outside [-1, 1]")
        if self.rate is not None and not 0.0 < self.rate <= 2.0:
            raise ValueError(f"gripper {self.name}: rate {self.rate} lies outside (0, 2] command/step")

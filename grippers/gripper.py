"""The record that describes a gripper or hand to the toolkit.

A *role* names a joint of the merged hand. The roles are ADROIT's own finger joints, the slide on which a jaw travels
towards the other, and the passive inner knuckles that four-bar grippers add; a gripper says which of its joints plays
which role. Roles that it does not name are absent: in its merged robot they are frozen, massless and without shape.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field


@dataclass(frozen=True)
class Digit:
    """A finger or the thumb of the merged hand, and which of its roles does what.

    Attributes:
        name: its element in the evolution space.  title: in words, as people's fingers are called.
        joints: commanded roles, base to tip; the policy has one action entry for each, -1 open, +1 closed (robosuite's sign).
        flexion: of these, what closes it most.
        pad: of these, the joint of the link whose shapes face the object: a jaw's pad, a finger's last link but one.
        slide: role on whose axis [m] a jaw travels, carrying the whole digit.  knuckle: role of a four-bar linkage's passive inner
            knuckle. None: no gripper here has it.
        opposes: whether it closes against the others.
    """

    name: str
    title: str
    joints: tuple[str, ...]
    flexion: str
    pad: str
    slide: str | None = None
    knuckle: str | None = None
    opposes: bool = False

    @property
    def tip(self) -> str:
        """Role of the outermost joint."""
        return self.joints[-1]

    @property
    def chain(self) -> tuple[str, ...]:
        """Its roles one upon another, from the palm to the tip; the inner knuckle stands beside them."""
        return self.joints if self.slide is None else (self.slide, *self.joints)


DIGITS: tuple[Digit, ...] = (
    Digit("FF", "index", ("FFJ3", "FFJ2", "FFJ1", "FFJ0"), flexion="FFJ2", pad="FFJ1", slide="FFS", knuckle="FFK"),
    Digit("MF", "middle", ("MFJ3", "MFJ2", "MFJ1", "MFJ0"), flexion="MFJ2", pad="MFJ1"),
    Digit("RF", "ring", ("RFJ3", "RFJ2", "RFJ1", "RFJ0"), flexion="RFJ2", pad="RFJ1"),
    Digit("LF", "little", ("LFJ4", "LFJ3", "LFJ2", "LFJ1", "LFJ0"), flexion="LFJ2", pad="LFJ1"),
    Digit("TH", "thumb", ("THJ4", "THJ3", "THJ2", "THJ1", "THJ0"), flexion="THJ4", pad="THJ1", slide="THS", knuckle="THK", opposes=True),
)
"""The merged hand: ADROIT's digits and their joints by its names."""
INDEX, THUMB = DIGITS[0], DIGITS[-1]
KNUCKLES: tuple[str, ...] = tuple(digit.knuckle for digit in DIGITS if digit.knuckle is not None)
"""Passive roles."""
SLIDES: tuple[str, ...] = tuple(digit.slide for digit in DIGITS if digit.slide is not None)
"""Roles that are slides [m] rather than hinges [rad]."""

ROLE_PARENT: dict[str, str | None] = {
    role: parent for digit in DIGITS for role, parent in zip(digit.chain, (None, *digit.chain[:-1]), strict=True)
} | dict.fromkeys(KNUCKLES)
"""Role -> the role that carries it; None: the palm."""
ROLES: tuple[str, ...] = tuple(ROLE_PARENT)
"""Roles, parents first."""
DIGIT_OF: dict[str, Digit] = {role: digit for digit in DIGITS for role in (*digit.chain, digit.knuckle) if role is not None}
"""Role -> its digit."""

COMMANDED_ROLES: tuple[str, ...] = tuple(role for digit in DIGITS for role in digit.joints)
"""Roles that the policy commands."""

ROLE_COMMAND: dict[str, str] = {role: role for role in COMMANDED_ROLES} | {
    digit.slide: digit.flexion for digit in DIGITS if digit.slide is not None
}
"""Role that an actuator can drive -> commanded role that it follows: a jaw slides by what flexes its finger."""

ROLE_SENSE: dict[str, tuple[float, float, float]] = {
    "FFJ1": (1, 0, 0), "MFJ1": (1, 0, 0), "RFJ1": (1, 0, 0), "THJ1": (1, 0, 0), "FFK": (1, 0, 0), "THK": (-1, 0, 0),
}
"""Positive sense of roles that no actuator closes: the world direction, at the start posture, on whose side the joint's
axis lies when its angle counts as positive. Driven roles count positive in the closing sense."""

CLOSING_ROLES: tuple[str, ...] = tuple(role for digit in (INDEX, THUMB) for role in (digit.flexion, digit.pad))
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
        grasp_offset: where along the closing axis an object comes to lie as the gripper closes on it [m], from robosuite's grasp site
            towards the thumb: 0 between jaws that meet in the middle. It is measured (tests/grippers/test_grasp_offset.py); a policy
            that is taken to the gripper sees the object from there.
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
    grasp_offset: float = 0.0
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
        if not abs(self.grasp_offset) < 0.1:
            raise ValueError(f"gripper {self.name}: grasp_offset {self.grasp_offset} m is no place between its fingers; give metres")

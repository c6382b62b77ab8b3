"""The ADROIT hand on its own virtual mount, as gymnasium-robotics has it, and hands of two, three and four fingers made of it.

No arm carries it: position servos move the forearm. Which of the mount's joints there are is the task's affair; the changes below touch
the hand alone. Every hand has the same bodies, joints, shapes and motors; on the targets fingers shrink to nothing and joints freeze:

- the thumb and each finger that stays keep one moving joint, which turns them by 45 to 135 degrees against the palm's plane; they are
  straight rods of 7 mm radius, of which the thumb is a little shorter and stands in the middle of the palm's foot;
- the two-finger hand keeps the index, opposite to the thumb; the three-finger hand keeps index and little finger to the palm's left and
  right, inclined so that they close towards the thumb; the four-finger hand the middle finger between them as well;
- all other fingers draw back into a narrower palm, and shapes, lengths and masses vanish with them.

The measures are those of the targets in Meta-Evolve's appendix and released code (Liu, Pathak, Zhao, ICLR 2024), but for what that leaves
wrong or open: fingers that vanish take their masses along, freeze whole, and end inside the palm, apart from one another and from those
that stay (there they end where others move).
"""

from collections.abc import Iterable
from functools import partial

import mujoco
import numpy as np

from grippers.gripper import DIGITS, THUMB
from robots.model_robot import Family, ModelRobot

FINGERS = {digit.name.lower(): digit for digit in DIGITS if digit is not THUMB}
"""What the names of a finger's bodies begin with -> the finger, index to little."""
LINKS = ("proximal", "middle", "distal")
ROD_RADIUS = 0.007
"""[m] of every link that stays: that of the fingertips of ADROIT, which are as thin already."""
THUMB_SWINGS = "THJ3"
"""The one joint that the thumb keeps: across the palm, towards the fingers."""
THUMB_SHORTER = 0.88
"""Length of the thumb's links on the targets, of its own."""
SWING = (np.pi / 4, 3 * np.pi / 4)
"""Range [rad] of the joint that moves: 0 lies in the palm's plane, pi/2 stands upright on it."""
SERVO_MARGIN = 0.01
"""[rad] by which its servo may be asked to go beyond that range, so that it can press against the stop."""
FROZEN = 1e-10
"""Half range [rad] of a joint that moves no more; MuJoCo wants a range."""
NOTHING = 1e-6
"""Radius and half length [m] of a shape that has vanished."""
REMNANT = 1e-4
"""Share of its own mass and inertia that a vanished link keeps; armatures of its joints, far larger, keep the simulation well posed."""
INCLINED = np.arctan2(0.033, 0.061)
"""Angle [rad] by which index and little finger stand outwards, seen on the palm: bent over, both point to 19 mm above the palm's foot."""
PALM_NARROWER = 0.01
"""[m] by which half the palm's width shrinks, on either side."""

DRAWN_BACK = {"mf": (-0.011, 0.0, 0.050), "rf": (-0.011, 0.0, 0.030), "lf": (-0.001, 0.0, -0.024)}
"""Where the knuckle of a vanished finger lies in its parent [m]: in the palm, 2 cm from the others. The middle finger goes aside so that it
is out of the index's way."""
KNUCKLES = {"mf": (0.0, 0.0, 0.08), "lf": (-0.016, 0.0, 0.036)}
"""Where it lies [m] if the finger stays: in line with the index."""


def _capsules(body: mujoco.MjsBody) -> list[mujoco.MjsGeom]:
    return [geom for geom in body.geoms if geom.type == mujoco.mjtGeom.mjGEOM_CAPSULE]


def _shorten(body: mujoco.MjsBody, share: float) -> None:
    """Shrink a link along its own z axis, with all that is on it."""
    for element in (*_capsules(body), *body.sites, *body.bodies):
        element.pos = element.pos * (1.0, 1.0, share)
    body.ipos = body.ipos * (1.0, 1.0, share)
    for capsule in _capsules(body):
        capsule.size[1] = max(capsule.size[1] * share, NOTHING)


def _thin(body: mujoco.MjsBody, radius: float) -> None:
    for capsule in _capsules(body):
        capsule.size[0] = radius


def _freeze(spec: mujoco.MjSpec, joints: Iterable[str]) -> None:
    """Hold joints at zero; their servos stay and push in vain."""
    for name in joints:
        spec.joint(name).range = (-FROZEN, FROZEN)


def _swing(spec: mujoco.MjSpec, joint: str) -> None:
    spec.joint(joint).range = SWING
    spec.actuator(f"A_{joint}").ctrlrange = (SWING[0] - SERVO_MARGIN, SWING[1] + SERVO_MARGIN)


def _tilt(body: mujoco.MjsBody, angle: float) -> None:
    """Turn a body [rad] about its parent's y axis, the palm's normal, from straight along the palm."""
    body.quat = (np.cos(angle / 2), 0.0, np.sin(angle / 2), 0.0)


def _vanish(spec: mujoco.MjSpec, finger: str) -> None:
    """Shrink a finger to nothing, inside the palm."""
    for link in LINKS:
        _shorten(spec.body(finger + link), 0.0)
        _thin(spec.body(finger + link), NOTHING)
    for part in ("knuckle", *LINKS):
        body = spec.body(finger + part)
        body.mass, body.inertia = body.mass * REMNANT, body.inertia * REMNANT
    spec.body(f"{finger}knuckle").pos = DRAWN_BACK[finger]
    _freeze(spec, FINGERS[finger].joints)


def _stay(spec: mujoco.MjSpec, finger: str) -> None:
    """Make a finger a straight rod that only swings."""
    digit = FINGERS[finger]
    for link in LINKS:
        _thin(spec.body(finger + link), ROD_RADIUS)
    _freeze(spec, [joint for joint in digit.joints if joint != digit.flexion])
    _swing(spec, digit.flexion)
    if finger in KNUCKLES:
        spec.body(f"{finger}knuckle").pos = KNUCKLES[finger]


def _simplify_thumb(spec: mujoco.MjSpec) -> None:
    base = spec.body("thbase")
    base.pos, base.quat = (0.0, -0.01, 0.0), (1.0, 0.0, 0.0, 0.0)
    for link in LINKS:
        _shorten(spec.body(f"th{link}"), THUMB_SHORTER)
        _thin(spec.body(f"th{link}"), ROD_RADIUS)
    _freeze(spec, [joint for joint in THUMB.joints if joint != THUMB_SWINGS])
    _swing(spec, THUMB_SWINGS)


def _narrow_palm(spec: mujoco.MjSpec) -> None:
    """Bring the palm's two sides nearer by 2 cm each: the middle box loses its thumb side, those beside it all but their edge."""
    for name, side in (("C_palm0", -1.0), ("C_palm1", 1.0), ("C_lfmetacarpal", 1.0)):
        box = spec.geom(name)
        shrunk = min(PALM_NARROWER, box.size[0] - 0.001)  # MuJoCo wants a width
        box.size[0] -= shrunk
        box.pos[0] += side * shrunk
    _freeze(spec, ["LFJ4"])


def unchanged(spec: mujoco.MjSpec) -> None:
    """Leave ADROIT as it is."""


def become(spec: mujoco.MjSpec, fingers: tuple[str, ...]) -> None:
    """Make ADROIT in a scene a hand of the thumb and these fingers, "ff" among them.

    Raises:
        ValueError: no index finger, or what is no finger.
    """
    if "ff" not in fingers or not set(fingers) <= set(FINGERS):
        raise ValueError(f"fingers are {', '.join(fingers) or 'none'}; name the index, ff, which meets the thumb, and any of mf, rf and lf")
    _simplify_thumb(spec)
    _narrow_palm(spec)
    for finger in FINGERS:
        (_stay if finger in fingers else _vanish)(spec, finger)
    index = spec.body("ffknuckle")
    alone = "lf" not in fingers
    index.pos = (0.0 if alone else index.pos[0], 0.0, 0.08)
    if not alone:
        _tilt(index, INCLINED)
        _tilt(spec.body("lfknuckle"), -INCLINED)


def _part(body: str) -> tuple[str, str]:
    """What the names of a finger's or the thumb's bodies begin with ("" if the body belongs to none), and the rest of its name."""
    finger = next((name for digit in DIGITS if body.startswith(name := digit.name.lower())), "")
    return finger, body[len(finger) :]


def element(body: str, quantity: str) -> str:
    """What a quantity of a body belongs to (``Family.element``).

    A link is as long as its shape and as what hangs on it is far away; the palm's three boxes are one; a knuckle's mass goes with the
    link that it carries. The evolution space of two, three and four fingers then has 65 dimensions, as many as the paper gives (its
    released code has 59). Of those 59, these are not dimensions of their own here: lengths and widths that shrink on all targets alike
    (thumb, ring finger), the thumb's place and angle. These are: the masses of vanishing links (9), the two stops of a joint that swings
    on some targets and is frozen on the others (middle and little finger), and the places into which fingers draw back.
    """
    finger, part = _part(body)
    if not finger:
        return f"{body}.{quantity}"
    if quantity == "joint":
        return f"{body}.joint"
    before = {"middle": "proximal", "distal": "middle", "hub": "proximal"}
    if quantity == "mount" and part in before and not (finger == "th" and part == "middle"):
        return f"{finger}{before[part]}.link"
    if part == "metacarpal":
        return "palm.size" if quantity == "size" else f"{body}.{quantity}"
    if quantity in ("size", "site") or (finger == "th" and quantity == "mass"):
        return f"{body}.link"
    if quantity == "mass":
        return f"{finger}{'proximal' if part == 'knuckle' else part}.mass"
    return f"{body}.{quantity}"


FAMILY = Family(name="adroit-free", element=element, root="forearm")
"""Hands that are changes of the ADROIT of gymnasium-robotics."""

_MEASURES = "targets of the Hand Manipulation Suite in Meta-Evolve (ICLR 2024), appendix and released code"

ADROIT_FREE = ModelRobot(
    name="adroit-free",
    family=FAMILY,
    change=unchanged,
    datasheet="gymnasium-robotics 1.4 adroit_hand, unchanged (model by Vikash Kumar)",
    source_of_policy=True,
)
TWO_FINGER = ModelRobot("two-finger", FAMILY, partial(become, fingers=("ff",)), _MEASURES)
THREE_FINGER = ModelRobot("three-finger", FAMILY, partial(become, fingers=("ff", "lf")), _MEASURES)
FOUR_FINGER = ModelRobot("four-finger", FAMILY, partial(become, fingers=("ff", "mf", "lf")), _MEASURES)

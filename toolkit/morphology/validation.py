"""What is wrong with a card or with the models that it names, each in a sentence that says how to mend it.

The models are read as robosuite parses them, before MuJoCo compiles them, so that a mistake is named by the words that
its author wrote; what only the compiler sees is translated by ``compiler_complaint``.
"""

import os
from collections.abc import Iterator
from xml.etree.ElementTree import Element

import numpy as np
from robosuite.models.base import MujocoXML
from robosuite.models.grippers import GRIPPER_MAPPING
from robosuite.models.robots.robot_model import REGISTERED_ROBOTS

from grippers.gripper import ROLE_COMMAND, slides
from robots.robot import Robot
from toolkit.errors import ToolkitError

LARGEST_ANGLE = 2 * np.pi + 0.01
"""Largest angle [rad] that a card is believed: beyond a turn it was written in degrees."""
LARGEST_TRAVEL = 0.5
"""Largest travel [m] of a jaw that a card is believed: beyond it was written in millimetres."""
LARGEST_PLACE = 5.0
"""Largest coordinate [m] of a base that a card is believed: beyond it was written in millimetres or centimetres."""
BASE_SITE, GRIP_SITE, FLANGE = "right_center", "grip_site", "right_hand"


def findings(robot: Robot) -> list[str]:
    """What is wrong with a system, one sentence each; empty if nothing is."""
    out = list(_of_the_card(robot))
    for kind, name, registry in (
        ("arm", robot.arm, REGISTERED_ROBOTS), ("gripper_types", robot.gripper.robosuite_type, GRIPPER_MAPPING)
    ):  # fmt: skip
        if name not in registry:
            known = ", ".join(sorted(key for key in registry if key))
            out.append(f"robot {robot.name}: robosuite knows no {kind.removesuffix('_types')} {name!r}; it has {known}")
    if robot.arm in REGISTERED_ROBOTS:
        arm = REGISTERED_ROBOTS[robot.arm]()
        out += [*_of_a_model(f"arm {robot.arm}", arm), *_of_the_arm(robot, arm)]
    if robot.gripper.robosuite_type in GRIPPER_MAPPING:
        gripper = GRIPPER_MAPPING[robot.gripper.robosuite_type]()
        out += [*_of_a_model(f"gripper {robot.gripper.name}", gripper), *_of_the_gripper(robot, gripper)]
    return out


def require_valid(robot: Robot) -> None:
    """Refuse a system with the first of its ``findings``.

    Raises:
        ToolkitError: there is one; the sentence counts the others.
    """
    found = findings(robot)
    if found:
        more = f" (and {len(found) - 1} more: meta-evolve robots --check {robot.name})" if len(found) > 1 else ""
        raise ToolkitError(found[0] + more)


def compiler_complaint(robot: Robot, error: ValueError) -> ToolkitError:
    """MuJoCo's refusal of a system's scene as one sentence in the words of its models."""
    text = " ".join(str(error).replace("gripper0_right_", "").replace("robot0_", "").split())
    if "mass and inertia of moving bodies" in text:
        body = text.split("name '")[1].split("'")[0] if "name '" in text else "a link"
        return ToolkitError(f"robot {robot.name}: link {body!r} moves but has no mass or no inertia; give it an <inertial> of a real body")
    return ToolkitError(f"robot {robot.name}: MuJoCo refuses its model: {text}")


def _of_the_card(robot: Robot) -> Iterator[str]:
    for index, angle in enumerate(robot.posture_seed):
        if not abs(angle) <= LARGEST_ANGLE:
            yield (f"robot {robot.name}: posture_seed[{index}] = {angle} is no angle in radians; "
                   f"{angle} degrees are {np.deg2rad(angle):.4f} rad")  # fmt: skip
    for axis, place in zip("xyz", robot.base_position, strict=True):
        if not abs(place) <= LARGEST_PLACE:
            yield f"robot {robot.name}: base_position {axis} = {place} lies metres away from the table; write metres, not millimetres"
    for role, pair in robot.gripper.targets.items():
        unit, large = ("m", LARGEST_TRAVEL) if slides(role) else ("rad", LARGEST_ANGLE)
        if not max(map(abs, pair)) <= large:
            other = "millimetres" if slides(role) else "degrees"
            yield f"gripper {robot.gripper.name}: target {pair} of role {role} is no value in {unit}; it looks like {other}"


def _own(model: MujocoXML, element: Element, key: str = "name") -> str:
    """An element's name (or another reference) as its author wrote it."""
    return (element.get(key) or "unnamed").removeprefix(model.naming_prefix)


def _numbers(element: Element, key: str) -> np.ndarray:
    return np.array([float(word) for word in (element.get(key) or "").split()])


def _of_a_model(label: str, model: MujocoXML) -> Iterator[str]:
    """Meshes, joint axes and joint limits."""
    used = {geom.get("mesh") for geom in model.root.iter("geom")}
    first: dict[str | None, Element] = {}
    for mesh in model.asset.iter("mesh"):
        first.setdefault(mesh.get("name"), mesh)  # as robosuite does when it merges models
    for mesh in first.values():
        path = mesh.get("file")
        if mesh.get("name") in used and path and not os.path.isfile(path):
            yield f"{label}: mesh {_own(model, mesh)!r} is missing: there is no file {path}"
    for joint in model.worldbody.iter("joint"):
        name, axis, limits = _own(model, joint), _numbers(joint, "axis"), _numbers(joint, "range")
        length = float(np.linalg.norm(axis))
        if len(axis) and abs(length - 1.0) > 1e-3:
            mend = f"write {' '.join(f'{v:g}' for v in axis / length)}" if length > 0 else "say about which direction it moves"
            yield f"{label}: joint {name!r} has the axis {axis.tolist()} of length {length:g}, not 1; {mend}"
        if len(limits) == 2 and limits[0] >= limits[1]:
            yield f"{label}: joint {name!r} has the limits {limits[0]:g} to {limits[1]:g}; swap them, the lower one comes first"


def _of_the_arm(robot: Robot, arm: MujocoXML) -> Iterator[str]:
    joints = [_own(arm, joint) for joint in arm.worldbody.iter("joint")]
    if len(joints) != len(robot.posture_seed):
        yield (f"robot {robot.name}: posture_seed has {len(robot.posture_seed)} angles, its arm {len(joints)} joints: "
               f"{', '.join(joints)}")  # fmt: skip
    if BASE_SITE not in [_own(arm, site) for site in arm.worldbody.iter("site")]:
        yield f"arm {robot.arm}: it has no site {BASE_SITE!r}, the frame that OSC commands refer to; add one at its base"
    driven = {_own(arm, motor, "joint") for motor in arm.actuator}
    idle = [joint for joint in joints if joint not in driven]
    if idle:
        yield f"arm {robot.arm}: no motor drives joint {idle[0]!r}; operational-space control needs one on every joint"
    for field, named in (("arm_friction", robot.arm_friction), ("arm_roles", robot.arm_roles)):
        for joint in named:
            if joint not in joints:
                yield f"robot {robot.name}: {field} names joint {joint!r}, which its arm lacks; it has {', '.join(joints)}"


def _of_the_gripper(robot: Robot, model: MujocoXML) -> Iterator[str]:
    card, label = robot.gripper, f"gripper {robot.gripper.name}"
    if GRIP_SITE not in [_own(model, site) for site in model.worldbody.iter("site")]:
        yield (f"{label}: its model has no site {GRIP_SITE!r}, the grasp frame; add one between the pads, z towards the object "
               "and x along the closing axis")  # fmt: skip
    joints = [_own(model, joint) for joint in model.worldbody.iter("joint")]
    kinds = {_own(model, joint): joint.get("type", "hinge") for joint in model.worldbody.iter("joint")}
    for role, joint in card.joints.items():
        if joint not in joints:
            yield f"{label}: role {role} names joint {joint!r}, which its model lacks; it has {', '.join(joints)}"
        elif (kinds[joint] == "slide") != slides(role):
            fit = "FFS or THS" if kinds[joint] == "slide" else "a role that ends in a number, or FFK or THK"
            yield f"{label}: joint {joint!r} is a {kinds[joint]} and cannot play {role}; give it {fit}"
    bodies = [_own(model, body) for body in model.worldbody.iter("body") if body.find("joint") is None]
    for role, body in card.welded.items():
        if body not in bodies:
            yield f"{label}: role {role} is welded to body {body!r}, which its model has not without joints; it has {', '.join(bodies)}"
    yield from _of_the_actuators(card.targets, {joint: role for role, joint in card.joints.items()}, label, model)


def _of_the_actuators(targets: dict, role_of: dict[str, str], label: str, model: MujocoXML) -> Iterator[str]:
    driven = {_own(model, actuator, "joint"): actuator for actuator in model.actuator}
    for joint, actuator in driven.items():
        role = role_of.get(joint)
        if role is not None and role not in ROLE_COMMAND:
            yield (f"{label}: actuator {_own(model, actuator)!r} drives joint {joint!r}, which plays {role}, a passive role; "
                   "drive the outer knuckle, or give the joint a role that is driven")  # fmt: skip
        elif role is not None and role not in targets:
            yield f"{label}: actuator {_own(model, actuator)!r} drives role {role}, which has no target; add its open and closed position"
    for role, pair in targets.items():
        joint = next((joint for joint, other in role_of.items() if other == role), None)
        if joint not in driven:
            names = ", ".join(driven) or "no joint"
            yield f"{label}: role {role} has a target, but joint {joint!r} has no actuator; its model drives {names}"
            continue
        limits = _numbers(driven[joint], "ctrlrange")
        outside = [v for v in pair if len(limits) == 2 and not limits[0] - 1e-6 <= v <= limits[1] + 1e-6]
        if outside:
            yield f"{label}: target {outside[0]:g} of role {role} lies outside its actuator's range {limits[0]:g} to {limits[1]:g}"

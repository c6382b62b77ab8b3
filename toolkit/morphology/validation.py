"""What is wrong with a card or with the models that it names, each in a sentence that says how to mend it.

The models are read as robosuite parses them, before MuJoCo compiles them, so that a mistake is named by the words that
its author wrote; what only the compiler sees is translated by ``compiler_complaint``.
"""

import os
from collections.abc import Callable, Iterator, Mapping
from xml.etree.ElementTree import Element

import numpy as np
from robosuite.models.base import MujocoXML
from robosuite.models.grippers import GRIPPER_MAPPING
from robosuite.models.robots.robot_model import REGISTERED_ROBOTS

from grippers.gripper import KNUCKLES, ROLE_COMMAND, SLIDES
from robots.robot import Robot
from toolkit.errors import ToolkitError
from toolkit.morphology.native_scene import ARM_PREFIX, BASE_SITE, GRIP_SITE, GRIPPER_PREFIX, plain_name

LARGEST_ANGLE = 2 * np.pi + 0.01
"""Largest angle [rad] that a card is believed: beyond a turn it was written in degrees."""
LARGEST_TRAVEL = 0.5
"""Largest travel [m] of a jaw that a card is believed: beyond it was written in millimetres."""
LARGEST_SPEED = 15.0
"""Largest joint speed [rad/s] that a card is believed: beyond it was written in degrees per second."""
LEAST_TORQUE, LARGEST_TORQUE = 0.1, 2000.0
"""[N m] between which an arm's torque limits lie."""
LARGEST_TURNS = 2
"""Turns either way beyond which a joint's limits were written in degrees."""
LARGEST_PLACE = 5.0
"""Largest coordinate [m] of a base that a card is believed: beyond it was written in millimetres or centimetres."""
OSC_SITE, GRASP_SITE, FLANGE = plain_name(BASE_SITE), plain_name(GRIP_SITE), "right_hand"


def findings(robot: Robot) -> list[str]:
    """What is wrong with a system, one sentence each; empty if nothing is."""
    out = list(_of_the_card(robot))
    for kind, name, registry in (
        ("arm", robot.arm, REGISTERED_ROBOTS), ("gripper_types", robot.gripper.robosuite_type, GRIPPER_MAPPING)
    ):
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
    text = " ".join(str(error).replace(GRIPPER_PREFIX, "").replace(ARM_PREFIX, "").split())
    if "mass and inertia of moving bodies" in text:
        body = text.split("name '")[1].split("'")[0] if "name '" in text else "a link"
        return ToolkitError(f"robot {robot.name}: link {body!r} moves but has no mass or no inertia; give it an <inertial> of a real body")
    return ToolkitError(f"robot {robot.name}: MuJoCo refuses its model: {text}")


def _of_the_card(robot: Robot) -> Iterator[str]:
    for index, angle in enumerate(robot.posture_seed):
        if not abs(angle) <= LARGEST_ANGLE:
            yield (f"robot {robot.name}: posture_seed[{index}] = {angle} is no angle in radians; "
                   f"{angle} degrees are {np.deg2rad(angle):.4f} rad")
    for axis, place in zip("xyz", robot.base_position, strict=True):
        if not abs(place) <= LARGEST_PLACE:
            yield f"robot {robot.name}: base_position {axis} = {place} lies metres away from the table; write metres, not millimetres"
    for index, speed in enumerate(robot.joint_speeds or ()):
        if not 0 < speed <= LARGEST_SPEED:
            yield (f"robot {robot.name}: joint_speeds[{index}] = {speed} is no highest speed in rad/s; "
                   f"{speed} degrees per second are {np.deg2rad(speed):.4f} rad/s")
    for role, pair in robot.gripper.targets.items():
        unit, large = ("m", LARGEST_TRAVEL) if role in SLIDES else ("rad", LARGEST_ANGLE)
        if not max(map(abs, pair)) <= large:
            other = "millimetres" if role in SLIDES else "degrees"
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
        if len(limits) == 2 and joint.get("type", "hinge") == "hinge" and np.abs(limits).max() > LARGEST_TURNS * 2 * np.pi:
            yield (f"{label}: joint {name!r} has the limits {limits[0]:g} to {limits[1]:g} rad, many turns; write radians, not degrees: "
                   f"{np.deg2rad(limits[0]):.4f} to {np.deg2rad(limits[1]):.4f}")
        if len(limits) == 2 and limits[0] >= limits[1]:
            yield f"{label}: joint {name!r} has the limits {limits[0]:g} to {limits[1]:g}; swap them, the lower one comes first"


def _of_the_arm(robot: Robot, arm: MujocoXML) -> Iterator[str]:
    joints = [_own(arm, joint) for joint in arm.worldbody.iter("joint")]
    if len(joints) != len(robot.posture_seed):
        yield (f"robot {robot.name}: posture_seed has {len(robot.posture_seed)} angles, its arm {len(joints)} joints: "
               f"{', '.join(joints)}")
    if robot.joint_speeds is not None and len(robot.joint_speeds) != len(joints):
        yield f"robot {robot.name}: joint_speeds has {len(robot.joint_speeds)} numbers, its arm {len(joints)} joints: {', '.join(joints)}"
    if OSC_SITE not in [_own(arm, site) for site in arm.worldbody.iter("site")]:
        yield f"arm {robot.arm}: it has no site {OSC_SITE!r}, the frame that OSC commands refer to; add one at its base"
    driven = {_own(arm, motor, "joint") for motor in arm.actuator}
    yield from _of_the_motors(f"arm {robot.arm}", arm, joints)
    idle = [joint for joint in joints if joint not in driven]
    if idle:
        yield f"arm {robot.arm}: no motor drives joint {idle[0]!r}; operational-space control needs one on every joint"
    for field, named in (("arm_friction", robot.arm_friction), ("arm_roles", robot.arm_roles)):
        for joint in named:
            if joint not in joints:
                yield f"robot {robot.name}: {field} names joint {joint!r}, which its arm lacks; it has {', '.join(joints)}"


def _law(actuator: Element) -> str:
    """What an actuator makes of its control: "motor" (a force or torque), "position servo", or what else it is."""
    if actuator.tag != "general":
        return {"motor": "motor", "position": "position servo"}.get(actuator.tag, f"<{actuator.tag}> actuator")
    gain, bias = _numbers(actuator, "gainprm"), _numbers(actuator, "biasprm")
    if actuator.get("gaintype", "fixed") != "fixed" or actuator.get("dyntype", "none") != "none":
        return "actuator with dynamics or a gain of its own"
    if actuator.get("biastype", "none") == "none":
        return "motor" if len(gain) == 0 or gain[0] == 1.0 else f"motor with a gain of {gain[0]:g}"
    return "position servo" if len(bias) > 1 and bias[1] < 0 else "velocity servo or an actuator with a bias"


def _article(noun: str) -> str:
    return f"{'an' if noun[0] in 'aeiou' else 'a'} {noun}"


def _of_the_motors(label: str, arm: MujocoXML, joints: list[str]) -> Iterator[str]:
    """Operational-space control writes torques [N m] to an arm's actuators; each mistake is named by the first that makes it."""
    mine = [actuator for actuator in arm.actuator if _own(arm, actuator, "joint") in joints]

    def first(bad: list[Element], why: Callable[[Element], str]) -> Iterator[str]:
        if bad:
            more = f", and so are {len(bad) - 1} more" if len(bad) > 1 else ""
            yield f"{label}: actuator {_own(arm, bad[0])!r} of joint {_own(arm, bad[0], 'joint')!r} {why(bad[0])}{more}"

    other = [actuator for actuator in mine if _law(actuator) != "motor"]
    yield from first(other, lambda a: f"is {_article(_law(a))}, but operational-space control writes torques in N m to it; make it a "
                                      "<motor> with its torque limit as ctrlrange")
    motors = [actuator for actuator in mine if actuator not in other]
    geared = [actuator for actuator in motors if len(_numbers(actuator, "gear")) and _numbers(actuator, "gear")[0] != 1.0]
    yield from first(geared, lambda a: f"has a gear of {_numbers(a, 'gear')[0]:g}, so its control is no torque of the joint; take the gear "
                                       "out and give ctrlrange in N m of the joint")
    torques = {actuator: _numbers(actuator, "ctrlrange") for actuator in motors}
    odd = [a for a, t in torques.items() if len(t) != 2 or not (t[0] < 0 < t[1] and LEAST_TORQUE <= max(-t[0], t[1]) <= LARGEST_TORQUE)]
    yield from first(odd, lambda a: f"has the ctrlrange {a.get('ctrlrange') or 'of none'}, which is no torque limit from "
                                    f"{LEAST_TORQUE:g} to {LARGEST_TORQUE:g} N m either way")


def _of_the_gripper(robot: Robot, model: MujocoXML) -> Iterator[str]:
    card, label = robot.gripper, f"gripper {robot.gripper.name}"
    if GRASP_SITE not in [_own(model, site) for site in model.worldbody.iter("site")]:
        yield (f"{label}: its model has no site {GRASP_SITE!r}, the grasp frame; add one between the pads, z towards the object "
               "and x along the closing axis")
    joints = [_own(model, joint) for joint in model.worldbody.iter("joint")]
    kinds = {_own(model, joint): joint.get("type", "hinge") for joint in model.worldbody.iter("joint")}
    for role, joint in card.joints.items():
        if joint not in joints:
            yield f"{label}: role {role} names joint {joint!r}, which its model lacks; it has {', '.join(joints)}"
        elif (kinds[joint] == "slide") != (role in SLIDES):
            fit = " or ".join(SLIDES) if kinds[joint] == "slide" else f"a role that ends in a number, or {' or '.join(KNUCKLES)}"
            yield f"{label}: joint {joint!r} is a {kinds[joint]} and cannot play {role}; give it {fit}"
    bodies = [_own(model, body) for body in model.worldbody.iter("body") if body.find("joint") is None]
    for role, body in card.welded.items():
        if body not in bodies:
            yield f"{label}: role {role} is welded to body {body!r}, which its model has not without joints; it has {', '.join(bodies)}"
    if not card.targets and not len(model.actuator):
        yield f"{label}: its model drives no joint, so no finger closes on an object; take one whose fingers have a <position> servo each"
    yield from _of_the_actuators(card.targets, {joint: role for role, joint in card.joints.items()}, label, model)


def _of_the_actuators(
    targets: Mapping[str, tuple[float, float]], role_of: dict[str, str], label: str, model: MujocoXML
) -> Iterator[str]:
    driven = {_own(model, actuator, "joint"): actuator for actuator in model.actuator}
    for joint, actuator in driven.items():
        role = role_of.get(joint)
        if role is not None and role not in ROLE_COMMAND:
            yield (f"{label}: actuator {_own(model, actuator)!r} drives joint {joint!r}, which plays {role}, a passive role; "
                   "drive the outer knuckle, or give the joint a role that is driven")
        elif role is not None and role not in targets:
            yield f"{label}: actuator {_own(model, actuator)!r} drives role {role}, which has no target; add its open and closed position"
    for role, pair in targets.items():
        moved = next((joint for joint, other in role_of.items() if other == role), None)
        if moved is None or moved not in driven:
            names = ", ".join(driven) or "no joint"
            yield f"{label}: role {role} has a target, but joint {moved!r} has no actuator; its model drives {names}"
            continue
        if _law(driven[moved]) != "position servo":
            law = _article(_law(driven[moved]))
            yield f"{label}: actuator {_own(model, driven[moved])!r} is {law}, but targets are positions; make it a <position> servo"
        limits = _numbers(driven[moved], "ctrlrange")
        outside = [v for v in pair if len(limits) == 2 and not limits[0] - 1e-6 <= v <= limits[1] + 1e-6]
        if outside:
            yield f"{label}: target {outside[0]:g} of role {role} lies outside its actuator's range {limits[0]:g} to {limits[1]:g}"

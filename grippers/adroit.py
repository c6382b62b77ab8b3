"""The ADROIT hand as a robosuite gripper.

Bodies, joints, actuators and meshes are read from the installed gymnasium-robotics package (adroit_hand, Apache-2.0
model by Vikash Kumar); nothing of it is copied here. What is changed, and why:

- the forearm and its virtual arm (ART*, ARR*) are left out: a robosuite arm carries the hand;
- the wrist joints (WRJ1, WRJ0) are welded at zero: the arm turns the hand, and two series wrists would fight;
- the 44 limited tendons, the 65 sensors and the 19 finger-finger contact pairs are left out, as the task needs
  none of them and they cost constraint rows; so is the joints' friction loss of 0.001 N m, a thousandth of what the
  servos give, whose 22 rows cost a quarter of the simulation's speed;
- the hand hangs palm down on a bracket: its palm normal lies along the flange's approach axis (z) and its fingers
  along the flange's y, the direction along which robosuite's two-jaw grippers close.
"""

import os
import tempfile
import xml.etree.ElementTree as ET
from functools import cache
from pathlib import Path

import mujoco
import numpy as np
from robosuite.models.grippers import GripperModel, register_gripper

from grippers.gripper import COMMANDED_ROLES, Gripper

GRASP_FRAME_IN_WRIST = np.array([0.020, -0.037, 0.101])
"""Grasp frame origin [m] in the wrist body's axes: where the object's centre lies in the grasp below, found with it."""
GRASP_FRAME_IN_FLANGE = np.array([0.0, 0.0, 0.145])
"""Grasp frame origin [m] in flange axes: where robosuite's Robotiq 2F-85 has its own, so that the arm postures of source
and targets agree. The bracket is as long as that asks."""
WRIST_IN_FLANGE_QUAT = np.array([np.sqrt(0.5), -np.sqrt(0.5), 0.0, 0.0])
"""Wrist axes in flange axes (w first): -90 degrees about x, so that the palm normal (-y) becomes the flange's z."""
BRACKET_MASS = 0.1
"""Mass [kg] of the bracket: a guess for an aluminium angle 0.1 m long."""


def asset_path() -> Path:
    """Folder of ADROIT's MJCF files inside the installed gymnasium-robotics package.

    Raises:
        FileNotFoundError: the package is missing or ships no ADROIT model.
    """
    from importlib.util import find_spec

    spec = find_spec("gymnasium_robotics")
    if spec is None or spec.origin is None:
        raise FileNotFoundError("gymnasium-robotics is not installed; ADROIT's model is read from it")
    path = Path(spec.origin).parent / "envs" / "assets" / "adroit_hand"
    if not (path / "adroit_relocate.xml").is_file():
        raise FileNotFoundError(f"{path} holds no adroit_relocate.xml; install gymnasium-robotics 1.4")
    return path


def _numbers(values: np.ndarray | float) -> str:
    return " ".join(repr(float(v)) for v in np.atleast_1d(values))


def _geom_element(geom: "mujoco.MjsGeom", name: str) -> ET.Element:
    visual = geom.type == mujoco.mjtGeom.mjGEOM_MESH
    element = ET.Element("geom", name=name, pos=_numbers(geom.pos), quat=_numbers(geom.quat))
    if visual:
        element.set("type", "mesh")
        element.set("mesh", f"adroit_{geom.meshname}")
        element.set("rgba", "0.45 0.47 0.5 1")
        element.set("group", "1")
        element.set("contype", "0")
        element.set("conaffinity", "0")
        return element
    capsule = geom.type == mujoco.mjtGeom.mjGEOM_CAPSULE
    element.set("type", "capsule" if capsule else "box")
    element.set("size", _numbers(geom.size[: 2 if capsule else 3]))
    element.set("friction", _numbers(geom.friction))
    element.set("condim", str(geom.condim))
    element.set("margin", _numbers(geom.margin))
    element.set("group", "0")
    # The original leaves conaffinity 0, so that fingers touch objects but never each other.
    element.set("contype", "1")
    element.set("conaffinity", "0")
    return element


def _body_element(body: "mujoco.MjsBody", welded: bool) -> ET.Element:
    element = ET.Element("body", name=body.name, pos=_numbers(body.pos), quat=_numbers(body.quat))
    ET.SubElement(
        element, "inertial", pos=_numbers(body.ipos), mass=_numbers(body.mass), diaginertia=_numbers(body.inertia)
    )
    for joint in [] if welded else body.joints:
        ET.SubElement(
            element, "joint", name=joint.name, type="hinge", pos=_numbers(joint.pos), axis=_numbers(joint.axis),
            limited="true", range=_numbers(joint.range), damping=_numbers(joint.damping[0]),
            armature=_numbers(joint.armature), margin=_numbers(joint.margin),
        )
    for index, geom in enumerate(body.geoms):
        if geom.type != mujoco.mjtGeom.mjGEOM_BOX or max(geom.size) > 0.002:  # drops two 1 mm marker boxes
            element.append(_geom_element(geom, geom.name or f"{body.name}_geom{index}"))
    for child in body.bodies:
        element.append(_body_element(child, welded=False))
    return element


def _mount_element(wrist: "mujoco.MjsBody") -> ET.Element:
    """Bracket with the wrist on it, the force sensor's site and robosuite's end-effector frame."""
    mount = ET.Element("body", name="adroit_mount", pos="0 0 0")
    ET.SubElement(mount, "inertial", pos=_numbers(GRASP_FRAME_IN_FLANGE / 2), mass=_numbers(BRACKET_MASS),
                  diaginertia=_numbers(BRACKET_MASS * np.array([1, 1, 0.25]) * 0.1**2 / 12))
    ET.SubElement(mount, "site", name="ft_frame", pos="0 0 0", size="0.01", rgba="1 0 0 0", group="1")
    rotation = np.empty(9)
    mujoco.mju_quat2Mat(rotation, WRIST_IN_FLANGE_QUAT)
    wrist_in_flange = GRASP_FRAME_IN_FLANGE - rotation.reshape(3, 3) @ GRASP_FRAME_IN_WRIST
    wrist_element = _body_element(wrist, welded=True)
    wrist_element.set("pos", _numbers(wrist_in_flange))
    wrist_element.set("quat", _numbers(WRIST_IN_FLANGE_QUAT))
    mount.append(wrist_element)
    # robosuite's grip sites have x along the closing axis: a quarter turn about the approach axis.
    quarter_turn = np.array([np.sqrt(0.5), 0.0, 0.0, -np.sqrt(0.5)])
    eef = ET.SubElement(
        mount, "body", name="eef", pos=_numbers(GRASP_FRAME_IN_FLANGE), quat=_numbers(quarter_turn)
    )
    for site, size, pos in (
        ("grip_site", "0.01", "0 0 0"),
        ("ee_x", "0.005", "0.1 0 0"),
        ("ee_y", "0.005", "0 0.1 0"),
        ("ee_z", "0.005", "0 0 0.1"),
    ):
        ET.SubElement(eef, "site", name=site, pos=pos, size=size, rgba="1 0 0 0", type="sphere", group="1")
    ET.SubElement(eef, "site", name="grip_site_cylinder", size="0.005 10", rgba="0 1 0 0", type="cylinder", group="1")
    return mount


@cache
def adroit_mjcf() -> str:
    """MJCF of the mounted hand, as robosuite's gripper classes read it; mesh paths are absolute."""
    folder = asset_path()
    source = mujoco.MjSpec.from_file(str(folder / "adroit_relocate.xml"))
    root = ET.Element("mujoco", model="adroit_hand")
    asset = ET.SubElement(root, "asset")
    for mesh in source.meshes:
        file = folder / source.meshdir / mesh.file
        ET.SubElement(asset, "mesh", name=f"adroit_{mesh.name}", file=str(file), scale=_numbers(mesh.scale))
    actuators = ET.SubElement(root, "actuator")
    for role in COMMANDED_ROLES:
        motor = source.actuator(f"A_{role}")
        ET.SubElement(actuators, "position", name=f"A_{role}", joint=role, kp=_numbers(motor.gainprm[0]),
                      ctrllimited="true", ctrlrange=_numbers(motor.ctrlrange))
    worldbody = ET.SubElement(root, "worldbody")
    # The palm hangs on the wrist by WRJ0, which is welded as well.
    wrist = source.body("wrist")
    for joint in source.body("palm").joints:
        source.delete(joint)
    worldbody.append(_mount_element(wrist))
    sensors = ET.SubElement(root, "sensor")
    ET.SubElement(sensors, "force", name="force_ee", site="ft_frame")
    ET.SubElement(sensors, "torque", name="torque_ee", site="ft_frame")
    return ET.tostring(root, encoding="unicode")


@register_gripper
class AdroitHand(GripperModel):
    """ADROIT with 22 finger joints under position targets; action: 22 targets in [-1, 1] over the control ranges."""

    def __init__(self, idn: int | str = 0) -> None:
        # robosuite reads grippers from files only; the model is complete in memory once it is parsed.
        handle, path = tempfile.mkstemp(suffix=".xml")
        try:
            with os.fdopen(handle, "w") as file:
                file.write(adroit_mjcf())
            super().__init__(path, idn=idn)
        finally:
            os.unlink(path)

    def format_action(self, action: np.ndarray) -> np.ndarray:
        """Targets (22,) in [-1, 1], one per finger joint, unchanged."""
        return np.clip(action, -1.0, 1.0)

    @property
    def init_qpos(self) -> np.ndarray:
        """Open posture (22,) [rad]."""
        return np.array([ADROIT.targets[role][0] for role in COMMANDED_ROLES])

    @property
    def _important_geoms(self) -> dict[str, list[str]]:
        fingers = [f"C_{f}{part}" for f in ("ff", "mf", "rf", "lf") for part in ("proximal", "middle", "distal")]
        return {
            "left_finger": [f"C_th{part}" for part in ("proximal", "middle", "distal")],
            "right_finger": fingers,
            "left_fingerpad": ["C_thdistal"],
            "right_fingerpad": ["C_ffdistal", "C_mfdistal", "C_rfdistal"],
        }


def _finger(role_prefix: str, spread: float, flexion: tuple[tuple[float, float], ...]) -> dict[str, tuple[float, float]]:
    targets = {f"{role_prefix}J3": (spread, spread)}
    targets |= {f"{role_prefix}J{number}": pair for number, pair in zip((2, 1, 0), flexion, strict=True)}
    return targets


_FLEXION = ((0.111, 0.625), (0.0, 1.229), (0.032, 0.835))

ADROIT = Gripper(
    name="adroit",
    robosuite_type="AdroitHand",
    joints={role: role for role in COMMANDED_ROLES},
    targets=(
        _finger("FF", 0.0, _FLEXION)
        | _finger("MF", 0.0, _FLEXION)
        | _finger("RF", 0.0, _FLEXION)
        | {"LFJ4": (0.0, 0.0)}
        | _finger("LF", 0.0, _FLEXION)
        | {
            "THJ4": (-1, 0.257), "THJ3": (1.174, 1.3), "THJ2": (-0.001, 0.26),
            "THJ1": (0.338, 0.52), "THJ0": (-0.703, -0.798),
        }
    ),
    rate=None,
    preshape=-1.0,
    source="gymnasium-robotics 1.4 adroit_model.xml; open and closed postures by random search on the pick task",
)

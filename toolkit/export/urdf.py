"""The robot as URDF, for everything that speaks it (ROS, Pinocchio, cuRobo): frames, joints, limits, inertias, enclosing shapes.

Made from the compiled robot.xml, whose root is the task frame. A URDF has no reference angle and puts a joint's axis through its link's
origin: links begin at their joints, and reference angles are turned into the joints' origins, so that joint angles are the same numbers.
"""

import warnings
import xml.etree.ElementTree as ET
from collections.abc import Mapping

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from toolkit.bundle.manifest import Manifest
from toolkit.errors import ToolkitError
from toolkit.export.robot_xml import text

ROOT, GRASP = "task", "grasp"
"""Links without mass: the task frame, from which all hangs, and the grasp frame."""


def robot_urdf(mjcf: str, manifest: Manifest, coupled: Mapping[str, tuple[str, float, float]]) -> str:
    """The robot of robot.xml as URDF.

    Args:
        mjcf: robot.xml.
        manifest: of the same robot; says limits of the arm, and how fast the gripper closes.
        coupled: finger joint -> (joint that leads it, multiplier, offset in its own unit).

    Raises:
        ToolkitError: a link with several joints, or a joint that neither turns nor slides.
    """
    model = mujoco.MjModel.from_xml_string(mjcf)
    root = ET.Element("robot", name=manifest.robot.name)
    ET.SubElement(root, "link", name=ROOT)
    arm = {joint.name: joint for joint in manifest.joints}
    # Fingers are as fast as their targets move; robosuite limits no finger's speed.
    share = 0.5 * manifest.gripper.rate * manifest.policy_hz
    closing = {name: share * abs(ends[1] - ends[0]) for name, ends in manifest.gripper.targets.items()}
    shift = {0: np.zeros(3)}
    for body in range(1, model.nbody):
        name, parent = model.body(body).name, int(model.body_parentid[body])
        joints = np.flatnonzero(model.jnt_bodyid == body)
        if len(joints) > 1:
            raise ToolkitError(f"link {name} hangs on {len(joints)} joints, but a URDF has one for each; put a body between them")
        shift[body] = model.jnt_pos[joints[0]].copy() if len(joints) else np.zeros(3)
        _link(root, model, body, shift[body])
        turn = _rotation(model.body_quat[body])
        place = model.body_pos[body] + turn.apply(shift[body]) - shift[parent]
        above = model.body(parent).name if parent else ROOT
        if not len(joints):
            _joint(root, f"{name} fixed", "fixed", above, name, place, turn)
            continue
        joint = int(joints[0])
        called, axis, ref = model.joint(joint).name, model.jnt_axis[joint], float(model.qpos0[model.jnt_qposadr[joint]])
        slides = model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_SLIDE
        if not slides and model.jnt_type[joint] != mujoco.mjtJoint.mjJNT_HINGE:
            raise ToolkitError(f"joint {called} neither turns nor slides, and a URDF has no word for it; leave the robot out of exports")
        place, turn = (place - turn.apply(ref * axis), turn) if slides else (place, turn * Rotation.from_rotvec(-ref * axis))
        limited = bool(model.jnt_limited[joint])
        kind = "prismatic" if slides else "revolute" if limited else "continuous"
        element = _joint(root, called, kind, above, name, place, turn)
        ET.SubElement(element, "axis", xyz=_text(axis))
        own = arm.get(called)
        speed, effort = (own.speed, own.effort) if own else (max(closing.values()), _force(manifest, called))
        limit = {"lower": _text(model.jnt_range[joint, 0]), "upper": _text(model.jnt_range[joint, 1])} if limited else {}
        ET.SubElement(element, "limit", limit | {"effort": _text(effort), "velocity": _text(speed)})
        dof = model.jnt_dofadr[joint]
        ET.SubElement(element, "dynamics", damping=_text(model.dof_damping[dof]), friction=_text(model.dof_frictionloss[dof]))
        if called in coupled:
            leader, multiplier, offset = coupled[called]
            ET.SubElement(element, "mimic", joint=leader, multiplier=_text(multiplier), offset=_text(offset))
    site = model.site(GRASP).id
    body = int(model.site_bodyid[site])
    ET.SubElement(root, "link", name=GRASP)
    _joint(root, "grasp fixed", "fixed", model.body(body).name, GRASP, model.site_pos[site] - shift[body], _rotation(model.site_quat[site]))
    ET.indent(root)
    return '<?xml version="1.0"?>\n' + ET.tostring(root, encoding="unicode") + "\n"


def couplings(model: mujoco.MjModel, driven: set[str], plain: Mapping[str, str]) -> dict[str, tuple[str, float, float]]:
    """What the scene's couplings say of one finger joint by another: follower -> (leader, multiplier, offset).

    Motors lead, then what they lead; a coupling of several motors, or of none, has no place in a URDF. MuJoCo's are soft: under load a
    follower gives way.

    Args:
        model: of the scene.
        driven: joints with a motor, by their plain names.
        plain: joint in the model -> its plain name.
    """
    out: dict[str, tuple[str, float, float]] = {}
    left = [int(e) for e in np.flatnonzero(model.eq_type == mujoco.mjtEq.mjEQ_TENDON) if model.eq_obj2id[e] < 0]
    while True:
        leads = driven | set(out)
        for equality in left:
            tendon = int(model.eq_obj1id[equality])
            wraps = range(model.tendon_adr[tendon], model.tendon_adr[tendon] + model.tendon_num[tendon])
            parts = {plain[model.joint(model.wrap_objid[w]).name]: float(model.wrap_prm[w]) for w in wraps}
            follower = [name for name in parts if name not in leads]
            if len(parts) == 2 and len(follower) == 1:
                leader, length = next(name for name in parts if name in leads), float(model.tendon_length0[tendon])
                share = parts.pop(follower[0])
                out[follower[0]] = leader, 0.0 - parts[leader] / share, (length + float(model.eq_data[equality, 0])) / share
                left.remove(equality)
                break
        else:
            return out


def _link(root: ET.Element, model: mujoco.MjModel, body: int, shift: np.ndarray) -> None:
    element = ET.SubElement(root, "link", name=model.body(body).name)
    if model.body_mass[body] > 0:
        inertial = ET.SubElement(element, "inertial")
        _origin(inertial, model.body_ipos[body] - shift, _rotation(model.body_iquat[body]))
        ET.SubElement(inertial, "mass", value=_text(model.body_mass[body]))
        x, y, z = model.body_inertia[body]
        ET.SubElement(inertial, "inertia", ixx=_text(x), iyy=_text(y), izz=_text(z), ixy="0", ixz="0", iyz="0")
    for geom in np.flatnonzero((model.geom_bodyid == body) & (model.geom_contype != 0)):
        size, kind = model.geom_size[geom], mujoco.mjtGeom(model.geom_type[geom])
        if kind == mujoco.mjtGeom.mjGEOM_BOX:
            shape = ("box", {"size": _text(2.0 * size)})
        elif kind == mujoco.mjtGeom.mjGEOM_SPHERE:
            shape = ("sphere", {"radius": _text(size[0])})
        elif kind in (mujoco.mjtGeom.mjGEOM_CYLINDER, mujoco.mjtGeom.mjGEOM_CAPSULE):  # URDF has no capsule: what encloses it
            round_ends = size[0] if kind == mujoco.mjtGeom.mjGEOM_CAPSULE else 0.0
            shape = ("cylinder", {"radius": _text(size[0]), "length": _text(2.0 * (size[1] + round_ends))})
        else:
            continue
        collision = ET.SubElement(element, "collision")
        _origin(collision, model.geom_pos[geom] - shift, _rotation(model.geom_quat[geom]))
        ET.SubElement(ET.SubElement(collision, "geometry"), shape[0], shape[1])


def _joint(root: ET.Element, name: str, kind: str, parent: str, child: str, place: np.ndarray, turn: Rotation) -> ET.Element:
    element = ET.SubElement(root, "joint", name=name, type=kind)
    ET.SubElement(element, "parent", link=parent)
    ET.SubElement(element, "child", link=child)
    _origin(element, place, turn)
    return element


def _origin(element: ET.Element, place: np.ndarray, turn: Rotation) -> None:
    with warnings.catch_warnings():  # at a pitch of 90 degrees any roll will do
        warnings.simplefilter("ignore", UserWarning)
        angles = turn.as_euler("xyz")  # about fixed axes, as URDF's
    ET.SubElement(element, "origin", xyz=_text(place), rpy=_text(angles))


def _force(manifest: Manifest, joint: str) -> float:
    """Largest force of a finger joint's motor; 0 where it has none, or one without a limit."""
    motors = manifest.simulation.actuators if manifest.simulation else ()
    return next((max(map(abs, motor.force)) for motor in motors if motor.joint == joint and motor.force), 0.0)


def _rotation(quaternion: np.ndarray) -> Rotation:
    return Rotation.from_quat(np.roll(quaternion, -1))


def _text(values: np.ndarray | float) -> str:
    return text(np.asarray(values) + 0.0)  # no "-0.0"

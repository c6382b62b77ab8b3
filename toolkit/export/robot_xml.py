"""The robot of a bundle as MJCF that MuJoCo alone loads: frames, joints, limits, and shapes that enclose its own."""

import xml.etree.ElementTree as ET

import mujoco
import numpy as np
from scipy.spatial import ConvexHull, QhullError

from toolkit.deploy.kinematics import HULL
from toolkit.morphology.native_scene import GRIP_SITE, GRIPPER_PREFIX, NativeScene, plain_name, robot_bodies
from toolkit.simulation.plant import Plant


def robot_mjcf(plant: Plant, name: str) -> str:
    """The robot on its mount beside the table, as MJCF that MuJoCo alone loads, in the task frame.

    Frames, joints, limits and inertias are the simulated robot's own. Its meshes are replaced by the smaller of the
    enclosing box and capsule, so a shape never ends inside the real one; those of the gripper are there as convex hulls, too,
    which touch nothing and tell how high it hangs over the table. Couplings of finger joints and actuators are left out:
    the file serves kinematics and distances.
    """
    model = plant.model
    root = ET.Element("mujoco", model=name)
    ET.SubElement(root, "compiler", angle="radian", autolimits="false", inertiafromgeom="false", balanceinertia="false")
    assets, world = ET.SubElement(root, "asset"), ET.SubElement(root, "worldbody")
    table = next(g for g in range(model.ngeom) if model.geom(g).name == "table_collision")
    _shape(world, "table", model.geom_type[table], model.geom_size[table], plant.data.geom_xpos[table], np.array([1.0, 0, 0, 0]))
    scene = NativeScene(model)
    effort = dict(zip(scene.arm, model.actuator_ctrlrange[scene.arm_actuators], strict=True))
    made: dict[int, ET.Element] = {}
    for body in robot_bodies(model):
        parent = made.get(int(model.body_parentid[body]), world)
        element = ET.SubElement(parent, "body", name=model.body(body).name.removeprefix("robot0_").removeprefix(GRIPPER_PREFIX),
                                pos=text(model.body_pos[body]), quat=text(model.body_quat[body]))
        made[body] = element
        if model.body_mass[body] > 0:
            ET.SubElement(element, "inertial", pos=text(model.body_ipos[body]), quat=text(model.body_iquat[body]),
                          mass=text(model.body_mass[body]), diaginertia=text(model.body_inertia[body]))
        for joint in (j for j in range(model.njnt) if model.jnt_bodyid[j] == body):
            dof = model.jnt_dofadr[joint]
            limited = bool(model.jnt_limited[joint])
            attributes = {"name": plain_name(model.joint(joint).name),
                          "type": "slide" if model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_SLIDE else "hinge",
                          "pos": text(model.jnt_pos[joint]),
                          "axis": text(model.jnt_axis[joint]), "limited": str(limited).lower(),
                          "ref": text(model.qpos0[model.jnt_qposadr[joint]]), "damping": text(model.dof_damping[dof]),
                          "armature": text(model.dof_armature[dof]), "frictionloss": text(model.dof_frictionloss[dof])}
            if limited:
                attributes["range"] = text(model.jnt_range[joint])
            if joint in effort:
                attributes |= {"actuatorfrclimited": "true", "actuatorfrcrange": text(effort[joint])}
            ET.SubElement(element, "joint", attributes)
        for geom in (g for g in range(model.ngeom) if model.geom_bodyid[g] == body and model.geom_group[g] == 0):
            _enclose(element, model, geom)
            if model.body(body).name.startswith(GRIPPER_PREFIX) and model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_MESH:
                _hull(assets, element, model, geom)
        for site in (s for s in range(model.nsite) if model.site_bodyid[s] == body and model.site(s).name == GRIP_SITE):
            ET.SubElement(element, "site", name="grasp", pos=text(model.site_pos[site]), quat=text(model.site_quat[site]))
    ET.indent(root)
    return ET.tostring(root, encoding="unicode") + "\n"


_KINDS = {
    int(mujoco.mjtGeom.mjGEOM_SPHERE): ("sphere", 1), int(mujoco.mjtGeom.mjGEOM_CAPSULE): ("capsule", 2),
    int(mujoco.mjtGeom.mjGEOM_CYLINDER): ("cylinder", 2), int(mujoco.mjtGeom.mjGEOM_BOX): ("box", 3),
    int(mujoco.mjtGeom.mjGEOM_ELLIPSOID): ("ellipsoid", 3),
}


def _shape(parent: ET.Element, name: str, kind: int, size: np.ndarray, position: np.ndarray, quaternion: np.ndarray) -> None:
    word, count = _KINDS[int(kind)]
    ET.SubElement(parent, "geom", name=name, type=word, size=text(size[:count]), pos=text(position), quat=text(quaternion))


def vertices(model: mujoco.MjModel, geom: int) -> np.ndarray:
    """Vertices (n, 3) [m] of a geom's mesh in its frame."""
    mesh = int(model.geom_dataid[geom])
    start = model.mesh_vertadr[mesh]
    return np.asarray(model.mesh_vert[start : start + model.mesh_vertnum[mesh]], float)


def _hull(assets: ET.Element, parent: ET.Element, model: mujoco.MjModel, geom: int) -> None:
    name, points = plain_name(model.geom(geom).name) + HULL, vertices(model, geom)
    try:
        points = points[ConvexHull(points).vertices]
    except QhullError:
        pass  # flat: all of its vertices, then
    rounded = " ".join(f"{v:.7f}" for v in points.ravel())  # to 0.05 um
    ET.SubElement(assets, "mesh", name=name, vertex=rounded, inertia="shell")
    ET.SubElement(parent, "geom", name=name, type="mesh", mesh=name, pos=text(model.geom_pos[geom]), quat=text(model.geom_quat[geom]),
                  contype="0", conaffinity="0", group="3")


def _enclose(parent: ET.Element, model: mujoco.MjModel, geom: int) -> None:
    name, kind = plain_name(model.geom(geom).name), int(model.geom_type[geom])
    if kind in _KINDS:
        _shape(parent, name, kind, model.geom_size[geom], model.geom_pos[geom], model.geom_quat[geom])
        return
    points = vertices(model, geom)
    centre, half = 0.5 * (points.max(axis=0) + points.min(axis=0)), 0.5 * np.ptp(points, axis=0)
    along = int(np.argmax(half))
    offset = points - centre
    aside = np.linalg.norm(np.delete(offset, along, axis=1), axis=1)
    radius = float(aside.max())
    length = max(0.0, float((np.abs(offset[:, along]) - np.sqrt(np.maximum(radius**2 - aside**2, 0.0))).max()))
    position, flat = model.geom_pos[geom].copy(), np.empty(9)
    mujoco.mju_quat2Mat(flat, model.geom_quat[geom])
    rotation = flat.reshape(3, 3)
    position += rotation @ centre
    if 8 * half.prod() <= np.pi * radius**2 * (2 * length + 4 / 3 * radius):
        _shape(parent, name, mujoco.mjtGeom.mjGEOM_BOX, half, position, model.geom_quat[geom])
        return
    turned = rotation[:, [(along + 1) % 3, (along + 2) % 3, along]]  # a capsule lies along its z
    quaternion = np.empty(4)
    mujoco.mju_mat2Quat(quaternion, np.ascontiguousarray(turned).ravel())
    _shape(parent, name, mujoco.mjtGeom.mjGEOM_CAPSULE, np.array([radius, length, 0.0]), position, quaternion)


def text(values: np.ndarray | float) -> str:
    """Numbers in full, as an attribute of XML."""
    return " ".join(repr(float(v)) for v in np.atleast_1d(values))

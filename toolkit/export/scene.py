"""The simulated scene as MJCF that MuJoCo alone loads and steps: robot, motors, couplings, table and object, to be driven.

Written from the compiled model, every number in full, so that what was measured there can be measured again: the recorded actions under
the manifest's law of torques give the recorded episode (docs/drive_scene.py). What only a camera sees is left out; meshes are the convex
hulls with which MuJoCo finds contacts anyhow.
"""

import xml.etree.ElementTree as ET
from collections.abc import Callable, Iterable

import mujoco
import numpy as np
from scipy.spatial import ConvexHull, QhullError

from toolkit.errors import ToolkitError
from toolkit.export.robot_xml import text, vertices

START = "start"
"""Keyframe of the recorded episode's first row: positions, and the motors' targets there."""
TRANSMITTED, WRAPPED = mujoco.mjtTrn.mjTRN_JOINT, mujoco.mjtWrap.mjWRAP_JOINT
GEOMS = {mujoco.mjtGeom.mjGEOM_PLANE: "plane", mujoco.mjtGeom.mjGEOM_SPHERE: "sphere", mujoco.mjtGeom.mjGEOM_CAPSULE: "capsule",
         mujoco.mjtGeom.mjGEOM_ELLIPSOID: "ellipsoid", mujoco.mjtGeom.mjGEOM_CYLINDER: "cylinder", mujoco.mjtGeom.mjGEOM_BOX: "box",
         mujoco.mjtGeom.mjGEOM_MESH: "mesh"}
JOINTS = {mujoco.mjtJoint.mjJNT_FREE: "free", mujoco.mjtJoint.mjJNT_BALL: "ball", mujoco.mjtJoint.mjJNT_SLIDE: "slide",
          mujoco.mjtJoint.mjJNT_HINGE: "hinge"}
INTEGRATORS = {mujoco.mjtIntegrator.mjINT_EULER: "Euler", mujoco.mjtIntegrator.mjINT_RK4: "RK4",
               mujoco.mjtIntegrator.mjINT_IMPLICIT: "implicit", mujoco.mjtIntegrator.mjINT_IMPLICITFAST: "implicitfast"}


def scene_mjcf(model: mujoco.MjModel, data: mujoco.MjData, name: str, plain: Callable[[str], str], sites: dict[str, str]) -> str:
    """The scene as MJCF.

    Args:
        model: compiled, of hinges, slides and free bodies, motors at joints, fixed tendons, couplings of joints and tendons.
        data: at the recorded episode's first row.
        name: of the model.
        plain: name in the model -> name in the file.
        sites: name in the model -> name in the file, of those that are kept.

    Raises:
        ToolkitError: the model holds something that this file has no words for; the message names it.
    """
    root = ET.Element("mujoco", model=name)
    ET.SubElement(root, "compiler", angle="radian", autolimits="false", inertiafromgeom="false", balanceinertia="false", boundmass="0",
                  boundinertia="0")
    option = model.opt
    ET.SubElement(
        root, "option", timestep=text(option.timestep), gravity=text(option.gravity), wind=text(option.wind),
        density=text(option.density), viscosity=text(option.viscosity), impratio=text(option.impratio),
        integrator=INTEGRATORS[option.integrator], cone="elliptic" if option.cone == mujoco.mjtCone.mjCONE_ELLIPTIC else "pyramidal",
        solver={0: "PGS", 1: "CG", 2: "Newton"}[int(option.solver)], iterations=str(option.iterations), tolerance=text(option.tolerance),
        noslip_iterations=str(option.noslip_iterations),
    )
    assets = ET.SubElement(root, "asset")
    elements = {0: ET.SubElement(root, "worldbody")}
    for body in range(model.nbody):
        if body:
            elements[body] = _body(elements[int(model.body_parentid[body])], model, body, plain)
        for geom in _of(model.geom_bodyid, body):
            if model.geom_contype[geom] or model.geom_conaffinity[geom]:
                _geom(elements[body], assets, model, geom, plain)
        for site in _of(model.site_bodyid, body):
            if model.site(site).name in sites:
                ET.SubElement(elements[body], "site", name=sites[model.site(site).name], pos=text(model.site_pos[site]),
                              quat=text(model.site_quat[site]))
    _tendons(root, model, plain)
    _equalities(root, model, plain)
    _actuators(root, model, plain)
    ET.SubElement(ET.SubElement(root, "keyframe"), "key", name=START, qpos=text(data.qpos), ctrl=text(data.ctrl))
    ET.indent(root)
    return ET.tostring(root, encoding="unicode") + "\n"


def _body(parent: ET.Element, model: mujoco.MjModel, body: int, plain: Callable[[str], str]) -> ET.Element:
    element = ET.SubElement(parent, "body", name=plain(model.body(body).name), pos=text(model.body_pos[body]),
                            quat=text(model.body_quat[body]), gravcomp=text(model.body_gravcomp[body]))
    if model.body_mass[body] > 0:
        ET.SubElement(element, "inertial", pos=text(model.body_ipos[body]), quat=text(model.body_iquat[body]),
                      mass=text(model.body_mass[body]), diaginertia=text(model.body_inertia[body]))
    for joint in _of(model.jnt_bodyid, body):
        kind, dof, at = mujoco.mjtJoint(model.jnt_type[joint]), int(model.jnt_dofadr[joint]), int(model.jnt_qposadr[joint])
        words = {"name": plain(model.joint(joint).name), "type": JOINTS[kind]}
        if kind in (mujoco.mjtJoint.mjJNT_SLIDE, mujoco.mjtJoint.mjJNT_HINGE):
            words |= {
                "pos": text(model.jnt_pos[joint]), "axis": text(model.jnt_axis[joint]), "ref": text(model.qpos0[at]),
                "springref": text(model.qpos_spring[at]), "stiffness": text(model.jnt_stiffness[joint]),
                "damping": text(model.dof_damping[dof]), "armature": text(model.dof_armature[dof]),
                "frictionloss": text(model.dof_frictionloss[dof]), "solreffriction": text(model.dof_solref[dof]),
                "solimpfriction": text(model.dof_solimp[dof]), "solreflimit": text(model.jnt_solref[joint]),
                "solimplimit": text(model.jnt_solimp[joint]), "margin": text(model.jnt_margin[joint]),
                "limited": _word(model.jnt_limited[joint]), "range": text(model.jnt_range[joint]),
                "actuatorfrclimited": _word(model.jnt_actfrclimited[joint]), "actuatorfrcrange": text(model.jnt_actfrcrange[joint]),
            }
        elif model.dof_damping[dof] or model.dof_frictionloss[dof] or model.dof_armature[dof]:
            words |= {"damping": text(model.dof_damping[dof]), "armature": text(model.dof_armature[dof]),
                      "frictionloss": text(model.dof_frictionloss[dof])}
        ET.SubElement(element, "joint", words)
    return element


def _geom(parent: ET.Element, assets: ET.Element, model: mujoco.MjModel, geom: int, plain: Callable[[str], str]) -> None:
    kind = mujoco.mjtGeom(model.geom_type[geom])
    if kind not in GEOMS:
        raise _unknown(f"geom {model.geom(geom).name!r} of kind {kind.name}")
    words = {
        "type": GEOMS[kind], "pos": text(model.geom_pos[geom]), "quat": text(model.geom_quat[geom]),
        "contype": str(model.geom_contype[geom]), "conaffinity": str(model.geom_conaffinity[geom]), "mass": "0",
        "condim": str(model.geom_condim[geom]), "priority": str(model.geom_priority[geom]), "friction": text(model.geom_friction[geom]),
        "solmix": text(model.geom_solmix[geom]), "solref": text(model.geom_solref[geom]), "solimp": text(model.geom_solimp[geom]),
        "margin": text(model.geom_margin[geom]), "gap": text(model.geom_gap[geom]),
    }
    if model.geom(geom).name:
        words["name"] = plain(model.geom(geom).name)
    if kind == mujoco.mjtGeom.mjGEOM_MESH:
        words["mesh"] = f"{words.get('name', f'geom {geom}')} hull"
        ET.SubElement(assets, "mesh", name=words["mesh"], vertex=" ".join(f"{v:.9g}" for v in _hull(model, geom).ravel()), inertia="shell")
    else:
        words["size"] = text(model.geom_size[geom])
    ET.SubElement(parent, "geom", words)


def _hull(model: mujoco.MjModel, geom: int) -> np.ndarray:
    """Vertices (n, 3) [m] of the convex hull of a geom's mesh, in the geom's frame."""
    points = vertices(model, geom)
    try:
        return points[np.sort(ConvexHull(points).vertices)]
    except QhullError:
        return points  # flat: all of its vertices, then


def _tendons(root: ET.Element, model: mujoco.MjModel, plain: Callable[[str], str]) -> None:
    parent = ET.SubElement(root, "tendon")
    for tendon in range(model.ntendon):
        wraps = range(model.tendon_adr[tendon], model.tendon_adr[tendon] + model.tendon_num[tendon])
        if any(model.wrap_type[w] != WRAPPED for w in wraps):
            raise _unknown(f"tendon {model.tendon(tendon).name!r}, which is not a sum of joints")
        element = ET.SubElement(
            parent, "fixed", name=plain(model.tendon(tendon).name), limited=_word(model.tendon_limited[tendon]),
            range=text(model.tendon_range[tendon]), stiffness=text(model.tendon_stiffness[tendon]),
            damping=text(model.tendon_damping[tendon]), armature=text(model.tendon_armature[tendon]),
            springlength=text(model.tendon_lengthspring[tendon]), frictionloss=text(model.tendon_frictionloss[tendon]),
            margin=text(model.tendon_margin[tendon]), solreflimit=text(model.tendon_solref_lim[tendon]),
            solimplimit=text(model.tendon_solimp_lim[tendon]), solreffriction=text(model.tendon_solref_fri[tendon]),
            solimpfriction=text(model.tendon_solimp_fri[tendon]),
        )
        for w in wraps:
            ET.SubElement(element, "joint", joint=plain(model.joint(model.wrap_objid[w]).name), coef=text(model.wrap_prm[w]))


def _equalities(root: ET.Element, model: mujoco.MjModel, plain: Callable[[str], str]) -> None:
    parent = ET.SubElement(root, "equality")
    for equality in range(model.neq):
        kind, ends = mujoco.mjtEq(model.eq_type[equality]), (int(model.eq_obj1id[equality]), int(model.eq_obj2id[equality]))
        words = {"joint": "joint", "tendon": "tendon"}.get(kind.name.removeprefix("mjEQ_").lower())
        if words is None:
            raise _unknown(f"equality {model.equality(equality).name!r} of kind {kind.name}")
        named = {f"{words}{i + 1}": plain(getattr(model, words)(end).name) for i, end in enumerate(ends) if end >= 0}
        if model.equality(equality).name:
            named["name"] = plain(model.equality(equality).name)
        ET.SubElement(parent, words, named | {
            "polycoef": text(model.eq_data[equality, :5]), "active": _word(model.eq_active0[equality]),
            "solref": text(model.eq_solref[equality]), "solimp": text(model.eq_solimp[equality]),
        })


def _actuators(root: ET.Element, model: mujoco.MjModel, plain: Callable[[str], str]) -> None:
    parent = ET.SubElement(root, "actuator")
    for a in range(model.nu):
        gain, bias = mujoco.mjtGain(model.actuator_gaintype[a]), mujoco.mjtBias(model.actuator_biastype[a])
        known = gain == mujoco.mjtGain.mjGAIN_FIXED and bias in (mujoco.mjtBias.mjBIAS_NONE, mujoco.mjtBias.mjBIAS_AFFINE)
        if model.actuator_trntype[a] != TRANSMITTED or model.actuator_dyntype[a] != mujoco.mjtDyn.mjDYN_NONE or not known:
            raise _unknown(f"actuator {model.actuator(a).name!r}")
        ET.SubElement(
            parent, "general", name=plain(model.actuator(a).name), joint=plain(model.joint(model.actuator_trnid[a, 0]).name),
            gear=text(model.actuator_gear[a]), ctrllimited=_word(model.actuator_ctrllimited[a]),
            ctrlrange=text(model.actuator_ctrlrange[a]), forcelimited=_word(model.actuator_forcelimited[a]),
            forcerange=text(model.actuator_forcerange[a]),
            gaintype="fixed", gainprm=text(model.actuator_gainprm[a, :3]), biasprm=text(model.actuator_biasprm[a, :3]),
            biastype="none" if bias == mujoco.mjtBias.mjBIAS_NONE else "affine",
        )


def _of(owners: np.ndarray, body: int) -> Iterable[int]:
    return map(int, np.flatnonzero(owners == body))


def _unknown(what: str) -> ToolkitError:
    return ToolkitError(f"the scene holds {what}, which a bundle's scene.xml has no words for; leave it out of the robot's model")


def _word(flag: int) -> str:
    return "true" if flag else "false"

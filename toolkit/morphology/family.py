"""Robots that are changes of one MuJoCo model: their evolution space, and F in place.

The robots of a family (robots/model_robot.py) have the same bodies, joints, geoms and actuators under the same names, so they are matched
by name, whatever their limbs and whether their root is free. Theta is every number of the compiled models that differs; F writes it back.
A mass that MuJoCo takes from a body's geoms is no parameter: F takes it from the geoms again, as MuJoCo's compiler does.
"""

import copy
from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from robots.model_robot import ModelRobot
from tasks.task import ModelTask
from toolkit.errors import ToolkitError
from toolkit.morphology.arithmetic import principal
from toolkit.morphology.parameters import Field, ParameterSpace
from toolkit.morphology.space import gyration

SPHERE, CAPSULE, BOX = mujoco.mjtGeom.mjGEOM_SPHERE, mujoco.mjtGeom.mjGEOM_CAPSULE, mujoco.mjtGeom.mjGEOM_BOX
CYLINDER, ELLIPSOID = mujoco.mjtGeom.mjGEOM_CYLINDER, mujoco.mjtGeom.mjGEOM_ELLIPSOID
SHORTEST = 1e-12
"""Half length [m] of a capsule that stands for a sphere: MuJoCo's compiler refuses one of none."""


@dataclass(frozen=True)
class _Numbers:
    """An array of mjModel that may differ between the robots of a family.

    Attributes:
        array: its name in mjModel.
        owner: what its rows belong to: "body", "geom", "joint", "dof", "qpos", "actuator", "tendon", "wrap", "site" or "equality".
        quantity: as of ``Family.element``.
        unit: of its entries.
    """

    array: str
    owner: str
    quantity: str
    unit: str


NUMBERS = (
    _Numbers("body_pos", "body", "mount", "m"),
    _Numbers("body_gravcomp", "body", "mass", "1"),
    _Numbers("geom_size", "geom", "size", "m"),
    _Numbers("geom_pos", "geom", "size", "m"),
    _Numbers("geom_friction", "geom", "contact", "1, m, m"),
    _Numbers("geom_solref", "geom", "contact", "s, 1"),
    _Numbers("geom_solimp", "geom", "contact", "1, 1, m, 1, 1"),
    _Numbers("geom_solmix", "geom", "contact", "1"),
    _Numbers("geom_margin", "geom", "contact", "m"),
    _Numbers("geom_gap", "geom", "contact", "m"),
    _Numbers("jnt_pos", "joint", "joint", "m"),
    _Numbers("jnt_axis", "joint", "joint", "1"),
    _Numbers("jnt_range", "joint", "joint", "rad or m"),
    _Numbers("jnt_stiffness", "joint", "joint", "N m/rad or N/m"),
    _Numbers("jnt_margin", "joint", "joint", "rad or m"),
    _Numbers("jnt_solref", "joint", "joint", "s, 1"),
    _Numbers("jnt_solimp", "joint", "joint", "1"),
    _Numbers("qpos0", "qpos", "joint", "rad or m"),
    _Numbers("qpos_spring", "qpos", "joint", "rad or m"),
    _Numbers("dof_damping", "dof", "joint", "N m s/rad or N s/m"),
    _Numbers("dof_armature", "dof", "joint", "kg m^2 or kg"),
    _Numbers("dof_frictionloss", "dof", "joint", "N m or N"),
    _Numbers("dof_solref", "dof", "joint", "s, 1"),
    _Numbers("dof_solimp", "dof", "joint", "1"),
    _Numbers("actuator_ctrlrange", "actuator", "joint", "of the control"),
    _Numbers("actuator_forcerange", "actuator", "joint", "N m or N"),
    _Numbers("actuator_gear", "actuator", "joint", "1"),
    _Numbers("actuator_gainprm", "actuator", "joint", "of the gain"),
    _Numbers("actuator_biasprm", "actuator", "joint", "of the bias"),
    _Numbers("actuator_dynprm", "actuator", "joint", "of the activation"),
    _Numbers("tendon_range", "tendon", "joint", "m"),
    _Numbers("tendon_stiffness", "tendon", "joint", "N/m"),
    _Numbers("tendon_damping", "tendon", "joint", "N s/m"),
    _Numbers("tendon_frictionloss", "tendon", "joint", "N"),
    _Numbers("tendon_lengthspring", "tendon", "joint", "m"),
    _Numbers("wrap_prm", "wrap", "joint", "1"),
    _Numbers("site_pos", "site", "site", "m"),
    _Numbers("site_size", "site", "site", "m"),
    _Numbers("eq_data", "equality", "joint", "of the equality"),
)
"""What may differ as it stands; rotations and inertias are parameters of their own kinds (``_rotations``, ``_masses``)."""
TURNS = (("body_quat", "body", "mount"), ("geom_quat", "geom", "size"), ("site_quat", "site", "site"))
"""Quaternions that may differ: array, owner, quantity."""
ALIKE = (
    "body_parentid", "geom_bodyid", "geom_contype", "geom_conaffinity", "geom_condim", "geom_dataid", "jnt_type", "jnt_bodyid",
    "jnt_limited", "actuator_trnid", "actuator_trntype", "actuator_ctrllimited", "actuator_forcelimited", "actuator_gaintype",
    "actuator_biastype",
    "tendon_limited", "wrap_type", "wrap_objid", "eq_type",
)
"""What no evolution can change: it has to be the same on all robots of a family."""


class Reading:
    """A robot of a family, compiled in its task's scene.

    Args:
        robot, task: which.

    Attributes:
        robot: the card.  model: compiled.
        weighed: (nbody,) whether MuJoCo takes the body's mass from its geoms.
        density: (ngeom,) [kg/m^3] of those geoms, NaN where ``geom_mass`` says the mass.  geom_mass: (ngeom,) [kg] or NaN.
    """

    def __init__(self, robot: ModelRobot, task: ModelTask) -> None:
        self.robot = robot
        try:
            spec = task.spec(robot)
            self.model = spec.compile()
        except ValueError as error:
            raise ToolkitError(f"robot {robot.name} does not compile in task {task.name}: {' '.join(str(error).split())}") from error
        always, never = (spec.compiler.inertiafromgeom == i for i in (1, 0))
        self.weighed = np.zeros(self.model.nbody, bool)
        for body in spec.bodies:
            self.weighed[body.id] = body.id > 0 and (always or (not never and not body.explicitinertial))
        self.density = np.array([geom.density if np.isnan(geom.mass) else np.nan for geom in spec.geoms])
        self.geom_mass = np.array([geom.mass for geom in spec.geoms])
        order = [geom.id for geom in spec.geoms]
        self.density[order], self.geom_mass[order] = self.density.copy(), self.geom_mass.copy()


def body_of(model: mujoco.MjModel, owner: str, row: int) -> int:
    """The body to which a row of one of mjModel's arrays belongs; 0, the world, where it belongs to none."""
    if owner == "body":
        return row
    if owner == "qpos":
        return int(model.jnt_bodyid[np.flatnonzero(model.jnt_qposadr <= row)[-1]])
    if owner == "dof":
        return int(model.dof_bodyid[row])
    if owner == "actuator":
        joint, tendon = mujoco.mjtTrn.mjTRN_JOINT, mujoco.mjtTrn.mjTRN_TENDON
        at = int(model.actuator_trnid[row, 0])
        return body_of(model, {joint: "joint", tendon: "tendon"}[mujoco.mjtTrn(model.actuator_trntype[row])], at)
    if owner == "tendon":
        return body_of(model, "wrap", int(model.tendon_adr[row]))
    if owner == "wrap":
        return int(model.jnt_bodyid[model.wrap_objid[row]]) if model.wrap_type[row] == mujoco.mjtWrap.mjWRAP_JOINT else 0
    if owner == "equality":
        return int(model.jnt_bodyid[model.eq_obj1id[row]]) if model.eq_type[row] == mujoco.mjtEq.mjEQ_JOINT else 0
    return int(getattr(model, {"geom": "geom_bodyid", "joint": "jnt_bodyid", "site": "site_bodyid"}[owner])[row])


def _name(model: mujoco.MjModel, owner: str, row: int) -> str:
    """What a row is called: its own name, or its body's with its number there."""
    kinds = {"body": mujoco.mjtObj.mjOBJ_BODY, "geom": mujoco.mjtObj.mjOBJ_GEOM, "joint": mujoco.mjtObj.mjOBJ_JOINT,
             "actuator": mujoco.mjtObj.mjOBJ_ACTUATOR, "tendon": mujoco.mjtObj.mjOBJ_TENDON, "site": mujoco.mjtObj.mjOBJ_SITE,
             "equality": mujoco.mjtObj.mjOBJ_EQUALITY}
    own = mujoco.mj_id2name(model, kinds[owner], row) if owner in kinds else None
    return own or f"{model.body(body_of(model, owner, row)).name or 'world'}/{owner}{row}"


def _as_capsules(models: Sequence[mujoco.MjModel]) -> None:
    """Where a geom is a sphere on some robots and a capsule on others, write the sphere as the capsule of no length that it is."""
    for geom in range(min(model.ngeom for model in models)):
        slim = next((model for model in models if model.geom_type[geom] == CAPSULE), None)
        if slim is None:
            continue
        for model in models:
            if model.geom_type[geom] == SPHERE:
                model.geom_type[geom], model.geom_size[geom, 1:] = CAPSULE, 0.0
                model.geom_quat[geom], model.geom_sameframe[geom] = slim.geom_quat[geom], 0


class FamilySpace(ParameterSpace):
    """The space of robots that are changes of one model.

    Args:
        robots: the source first.
        task: in whose scene they are compiled.

    Attributes:
        robots: the same.
        readings: the robots, compiled.
        rows: field -> indices (n,) of its rows in the array of mjModel of the same name.
        gyration: (nbody, 6) [m] of the source's links whose mass the model states.

    Raises:
        ToolkitError: the robots are of different families, or one has bodies, joints or geoms that another lacks.
    """

    def __init__(self, robots: Sequence[ModelRobot], task: ModelTask) -> None:
        self.robots = tuple(robots)
        names = [robot.name for robot in robots]
        if len(robots) < 2 or len(set(names)) != len(names):
            raise ToolkitError(f"a merged tree needs at least two different robots; got {', '.join(names) or 'none'}")
        self.readings = [Reading(robot, task) for robot in robots]
        _as_capsules([reading.model for reading in self.readings])
        self._check()
        self.rows: dict[str, np.ndarray] = {}
        super().__init__(names, [*self._plain(), *self._rotations(), *self._masses()])

    def _check(self) -> None:
        """The same elements under the same names on all robots."""
        source = self.readings[0]
        for reading in self.readings[1:]:
            pair = f"robots {source.robot.name} and {reading.robot.name}"
            if reading.robot.family.name != source.robot.family.name:
                families = f"{source.robot.family.name} and {reading.robot.family.name}"
                raise ToolkitError(f"{pair} are of the families {families}; one cannot become the other")
            for owner, count in (("body", "nbody"), ("joint", "njnt"), ("geom", "ngeom"), ("actuator", "nu"), ("tendon", "ntendon")):
                own, other = ([_name(r.model, owner, i) for i in range(getattr(r.model, count))] for r in (source, reading))
                if own != other:
                    odd = sorted(set(own) ^ set(other)) or own
                    raise ToolkitError(f"{pair} do not have the same {owner} in the same order: {odd[0]!r} is in one alone")
            for array in ALIKE:
                own, other = getattr(source.model, array), getattr(reading.model, array)
                if own.shape != other.shape or (own != other).any():
                    raise ToolkitError(f"{pair} differ in {array}, which no evolution can change")
            changed = np.flatnonzero(source.model.geom_type != reading.model.geom_type)
            if changed.size or (source.weighed != reading.weighed).any():
                geom = _name(source.model, "geom", int(changed[0])) if changed.size else ""
                why = f"geom {geom!r} is of another kind" if geom else "the mass of one's body is stated, the other's comes from its geoms"
                raise ToolkitError(f"{pair} cannot become one another: {why}")

    def _element(self, owner: str, row: int, quantity: str) -> str:
        model = self.readings[0].model
        return self.robots[0].family.element(model.body(body_of(model, owner, row)).name, quantity)

    def _field(self, name: str, owner: str, quantity: str, unit: str, values: np.ndarray, components: Sequence[str]) -> Field | None:
        """The rows of an array (n_robots, rows, columns) in which the robots differ; None if there are none."""
        rows = np.flatnonzero(np.ptp(values, axis=0).max(axis=1, initial=0.0) > 0.0)
        if not rows.size:
            return None
        self.rows[name] = rows
        items = tuple(_name(self.readings[0].model, owner, int(row)) for row in rows)
        elements = tuple(self._element(owner, int(row), quantity) for row in rows)
        return Field(name, items, elements, tuple(components), unit, values[:, rows])

    def _plain(self) -> list[Field]:
        out = []
        for numbers in NUMBERS:
            arrays = [np.array(getattr(r.model, numbers.array), float) for r in self.readings]
            if not arrays[0].size:
                continue
            values = np.array([array.reshape(len(array), -1) for array in arrays])
            columns = values.shape[2]
            components = [str(i) for i in range(columns)] if columns > 1 else [""]
            out.append(self._field(numbers.array, numbers.owner, numbers.quantity, numbers.unit, values, components))
        return [field for field in out if field is not None]

    def _rotations(self) -> list[Field]:
        """Turns from the source's rotation to the robot's, as rotation vectors [rad]."""
        out = []
        for array, owner, quantity in TURNS:
            turns = [Rotation.from_quat(getattr(r.model, array), scalar_first=True) for r in self.readings]
            values = np.array([(turns[0].inv() * turn).as_rotvec() for turn in turns])
            values[np.abs(values) < 1e-12] = 0.0
            out.append(self._field(array, owner, quantity, "rad", values, "xyz"))
        return [field for field in out if field is not None]

    def _masses(self) -> list[Field]:
        """Mass, centre and gyration of the links whose mass the model states."""
        stated = ~self.readings[0].weighed
        masses, centres, roots = [], [], []
        for reading in self.readings:
            model = reading.model
            frames = Rotation.from_quat(model.body_iquat, scalar_first=True).as_matrix()
            masses.append(np.where(stated, model.body_mass, 0.0)[:, None])
            centres.append(np.where(stated[:, None], model.body_ipos, 0.0))
            tensors = [frame @ np.diag(moments) @ frame.T for frame, moments in zip(frames, model.body_inertia, strict=True)]
            roots.append([gyration(float(mass), tensor) if own and mass > 0.0 else np.zeros(6)
                          for mass, tensor, own in zip(model.body_mass, tensors, stated, strict=True)])
        self.gyration = np.array(roots[0])
        found = [
            self._field("body_mass", "body", "mass", "kg", np.array(masses), [""]),
            self._field("body_ipos", "body", "mass", "m", np.array(centres), "xyz"),
            self._field("gyration", "body", "mass", "m", np.array(roots), ("xx", "yy", "zz", "xy", "xz", "yz")),
        ]
        return [field for field in found if field is not None]


def _solid(kind: int, size: np.ndarray) -> tuple[float, np.ndarray]:
    """Volume [m^3] and second moments (3,) [m^2] per unit of mass along the geom's own axes, of a uniform solid.

    A capsule is a cylinder with two half balls (a half ball's centre lies 3/8 of its radius off its face).

    Raises:
        ToolkitError: a kind of geom that no primitive formula is for.
    """
    if kind == SPHERE:
        return 4.0 / 3.0 * np.pi * size[0] ** 3, np.full(3, size[0] ** 2 / 5.0)
    if kind == ELLIPSOID:
        return 4.0 / 3.0 * np.pi * float(np.prod(size)), size**2 / 5.0
    if kind == BOX:
        return 8.0 * float(np.prod(size)), size**2 / 3.0
    radius, half = size[0], size[1]
    cylinder = 2.0 * np.pi * radius**2 * half
    along, across = half**2 / 3.0, radius**2 / 4.0
    if kind == CYLINDER:
        return cylinder, np.array([across, across, along])
    if kind == CAPSULE:
        balls = 4.0 / 3.0 * np.pi * radius**3
        share = balls / (cylinder + balls)
        ends = radius**2 / 5.0 + half**2 + 0.75 * half * radius  # of half balls whose faces lie at the cylinder's ends
        across = (1.0 - share) * across + share * radius**2 / 5.0
        return cylinder + balls, np.array([across, across, (1.0 - share) * along + share * ends])
    name = mujoco.mjtGeom(kind).name.removeprefix("mjGEOM_").lower()
    raise ToolkitError(f"a {name} cannot grow with its mass; give its body an inertial")


def _extent(kind: int, size: np.ndarray) -> tuple[float, np.ndarray]:
    """Bounding radius [m] and half edges (3,) [m] of the bounding box of a geom, in its own frame."""
    if kind == SPHERE:
        return float(size[0]), np.full(3, size[0])
    if kind == CAPSULE:
        return float(size[0] + size[1]), np.array([size[0], size[0], size[0] + size[1]])
    if kind == CYLINDER:
        return float(np.hypot(size[0], size[1])), np.array([size[0], size[0], size[1]])
    return float(size.max() if kind == ELLIPSOID else np.linalg.norm(size)), np.array(size)


class MergedModel:
    """One compiled MuJoCo model that can become any robot between those of a family.

    Args:
        space: the evolution space.
        task: the task whose scene it stands in.

    Attributes:
        template: the model at the source; never stepped, only copied.
    """

    def __init__(self, space: FamilySpace, task: ModelTask) -> None:
        self.space, self.task = space, task
        source = space.readings[0]
        self.template = template = copy.copy(source.model)
        self._turns = {array: np.array(getattr(template, array)) for array, _, _ in TURNS if array in space.rows}
        self._grown = space.rows.get("geom_size", np.zeros(0, int))
        moved = np.union1d(self._grown, space.rows.get("geom_pos", np.zeros(0, int))).astype(int)
        moved = np.union1d(moved, space.rows.get("geom_quat", np.zeros(0, int))).astype(int)
        self._weighed = [body for body in np.unique(template.geom_bodyid[moved]) if source.weighed[body]]
        stated = [space.rows[name] for name in ("body_mass", "gyration") if name in space.rows]
        self._stated = np.unique(np.concatenate(stated)) if stated else np.zeros(0, int)
        self._loosen(template, moved)
        self.become(space.betas[0], template, mujoco.MjData(template))

    def _loosen(self, model: mujoco.MjModel, moved: np.ndarray) -> None:
        """Undo what the compiler concluded from one robot's frames and boxes, so that F may move both."""
        model.body_sameframe[:], model.geom_sameframe[:], model.site_sameframe[:] = 0, 0, 0
        model.body_simple[:], model.dof_simplenum[:] = 0, 0
        for body in np.unique(model.geom_bodyid[moved]):
            reach = 0.0
            for reading in self.space.readings:
                own = np.flatnonzero(reading.model.geom_bodyid == body)
                far = np.linalg.norm(reading.model.geom_pos[own], axis=1) + reading.model.geom_rbound[own]
                reach = max(reach, float(far.max()) + float(np.linalg.norm(reading.model.body_ipos[body])))
            nodes = np.arange(model.body_bvhadr[body], model.body_bvhadr[body] + model.body_bvhnum[body])
            model.bvh_aabb[nodes] = (0, 0, 0, reach, reach, reach)

    def new(self) -> tuple[mujoco.MjModel, mujoco.MjData]:
        """A model at the source and its data, ready to be patched and stepped."""
        model = copy.copy(self.template)
        return model, mujoco.MjData(model)

    def become(self, alpha: np.ndarray, model: mujoco.MjModel, data: mujoco.MjData) -> None:
        """F(alpha) in place: patch ``model`` (from ``new``) and recompute its derived constants; ``data`` is reset."""
        theta, rows = self.space.theta(alpha), self.space.rows
        for name, values in theta.items():
            if name in self._turns:
                turned = Rotation.from_quat(self._turns[name][rows[name]], scalar_first=True) * Rotation.from_rotvec(values)
                getattr(model, name)[rows[name]] = turned.as_quat(scalar_first=True)
            elif name != "gyration":
                array = getattr(model, name)
                array[rows[name]] = values if array.ndim > 1 else values[:, 0]
        self._write_inertias(theta, model)
        for geom in self._grown:
            if model.geom_type[geom] == CAPSULE:
                model.geom_size[geom, 1] = max(model.geom_size[geom, 1], SHORTEST)
            model.geom_rbound[geom], model.geom_aabb[geom, 3:] = _extent(model.geom_type[geom], model.geom_size[geom])
        for body in self._weighed:
            self._weigh(body, model)
        mujoco.mj_setConst(model, data)
        mujoco.mj_resetData(model, data)

    def _write_inertias(self, theta: dict[str, np.ndarray], model: mujoco.MjModel) -> None:
        """Principal moments of the links whose mass is stated and changes."""
        if not self._stated.size:
            return
        roots = self.space.gyration.copy()
        if "gyration" in theta:
            roots[self.space.rows["gyration"]] = theta["gyration"]
        moments, frames = principal(model.body_mass[self._stated], roots[self._stated], 0.0)
        model.body_inertia[self._stated], model.body_iquat[self._stated] = moments, frames

    def _weigh(self, body: int, model: mujoco.MjModel) -> None:
        """Mass, centre and principal moments of a body from its geoms' volumes and densities."""
        source = self.space.readings[0]
        first = int(model.body_geomadr[body])
        masses, places, moments = [], [], []
        for geom in range(first, first + int(model.body_geomnum[body])):
            volume, second = _solid(int(model.geom_type[geom]), model.geom_size[geom])
            mass = volume * source.density[geom] if np.isnan(source.geom_mass[geom]) else source.geom_mass[geom]
            if mass > 0.0:
                axes = Rotation.from_quat(model.geom_quat[geom], scalar_first=True).as_matrix()
                masses.append(mass)
                places.append(np.array(model.geom_pos[geom]))
                moments.append(mass * axes @ np.diag(second) @ axes.T)
        mass = float(np.sum(masses))
        centre = np.array(masses) @ np.array(places) / mass
        moment = np.sum(moments, axis=0)
        for own, place in zip(masses, places, strict=True):
            moment += own * np.outer(place - centre, place - centre)
        inertia = np.trace(moment) * np.eye(3) - moment
        found, frames = principal(np.array([mass]), gyration(mass, inertia)[None], 0.0)
        model.body_mass[body], model.body_ipos[body] = mass, centre
        model.body_inertia[body], model.body_iquat[body] = found[0], frames[0]

"""F: an evolution parameter alpha becomes a MuJoCo model, by patching one compiled model in place.

Every body frame of the merged robot stands with world axes at the start posture, joint angles count from there, and the
grasp frame starts at the same pose on every robot; so a link is its joint's anchor and axis, nothing else.
"""

from collections.abc import Sequence

import mujoco
import numpy as np

from grippers.gripper import ROLE_COMMAND
from tasks.pick import START_POSITION, START_ROTATION, PickTask
from tasks.table import HAND_BIT
from toolkit.errors import ToolkitError
from toolkit.morphology.arithmetic import bones, directions, finger_tips, principal, quaternion, turned
from toolkit.morphology.grasp import Course, GraspLaw
from toolkit.morphology.patch import Patch
from toolkit.morphology.space import (
    FREEZE_DECADES,
    FROZEN_ARM_ARMATURE,
    FROZEN_ARM_STIFFNESS,
    FROZEN_ARMATURE,
    FROZEN_SLIDE_ARMATURE,
    FROZEN_SLIDE_STIFFNESS,
    FROZEN_STIFFNESS,
    FROZEN_WIDE_DECADES,
    EvolutionSpace,
)

MIN_MASS = 1e-9
"""Mass [kg] of an absent link: MuJoCo refuses less; its joint's armature is what keeps the mass matrix regular."""
MIN_INERTIA = 1e-13
"""Principal inertia [kg m^2] of an absent link."""
AIR_MASS = 1e-8
"""Mass [kg] of a body that is there for the air's drag alone, which depends on moment over mass."""
MIN_SIZE = 1e-5
"""Size [m] of an absent geom; absent geoms do not collide either."""
HAND_EXTENT = 0.25
"""Half extent [m] of the box within which a hand link's geoms lie, from the link's centre of mass, on every robot."""
HELD = 1e-6
"""A coupling is held from this share of its full impedance on, a pad from this stiffness [N m/rad] on."""
HELD_FOLDS = np.log(10.0) * FREEZE_DECADES
"""A coupling's hold grows over so many e-folds, as a freezing joint's does."""
HELD_FADING = 8.0
"""Power of the hold with which a held tendon's friction fades."""
SOFT = 0.85
"""Impedance of the constraint that holds a pad to its curve: it adds six times the apparent inertia of the two joints. The contacts
of meshes that hold robosuite's own have 0.95. With less than 0.7 a pad swings by 3 degrees whenever its knuckle starts, meets the
object askew, and needs a time constant below two time steps, which MuJoCo does not give; at 0.95 the IIWA's held less."""
IMPEDANCE = np.array([0.9, 0.95])
"""MuJoCo's default impedance of a constraint, at rest and displaced."""
BOTH_WAYS = np.array([-1.0, 1.0])
"""A limit times this is its range."""
OTHER_TWO = np.ones((3, 3)) - np.eye(3)
"""(x, y, z) @ this is (y + z, x + z, x + y)."""
LOW_AND_WIDTH = np.array([[1.0, 1.0], [0.0, 1.0]])
"""(low, width) @ this is (low, high)."""
TOUCHES = 0.2
"""A geom collides from this presence on: a thinner sliver would prick the object rather than hold it."""
WAKING = 0.2
"""Presence over which, from TOUCHES on, a geom comes to count for where its finger meets an object."""
BONE_RADIUS = {"arm": 0.04, "finger": 0.006}
"""Radius [m] of the visual bones between joints."""


def _span(ids: Sequence[int] | np.ndarray) -> np.ndarray | slice:
    """Consecutive indices as a slice, which NumPy writes to several times faster."""
    ids = np.asarray(ids, int)
    return slice(int(ids[0]), int(ids[-1]) + 1) if len(ids) and (np.diff(ids) == 1).all() else ids


class MergedRobot:
    """One compiled MuJoCo model that can become any robot of an evolution space.

    Args:
        space: the evolution space.
        task: whose furniture and object are in the scene.

    Attributes:
        template: the model compiled at the source; never stepped, only copied.
    """

    def __init__(self, space: EvolutionSpace, task: PickTask) -> None:
        self.space, self.task = space, task
        slots = space.matching.slots
        self._parents = np.array([slot.parent for slot in slots])
        self._roots = np.flatnonzero(self._parents < 0)
        self._arm = space.matching.arm_size
        self.driven = [i for i in range(self._arm, len(slots)) if slots[i].name in ROLE_COMMAND]
        self._shape_slot = np.array([s.slot for s in space.shape_slots])
        slim = (mujoco.mjtGeom.mjGEOM_CAPSULE, mujoco.mjtGeom.mjGEOM_CYLINDER)
        two = np.array([s.kind in slim for s in space.shape_slots])
        self._shape_dims = np.where(two[:, None], (1.0, 1.0, 0.0), 1.0)
        self._shape_reference = np.array([quaternion(s.reference) for s in space.shape_slots])
        self._airy = np.flatnonzero(space.fields["air_edges"].values.max(axis=(0, 2)) > 0)
        self._world_axes = np.tile(quaternion(np.eye(3)), (len(self._airy), 1))
        self._hold = self._holds()
        self._tip_of, self._ends = self._tips()
        self._bone_radius = np.where(np.arange(len(slots)) < self._arm, BONE_RADIUS["arm"], BONE_RADIUS["finger"])
        self.law: GraspLaw | None = None
        self.template = self.compile(space.betas[0])
        self.law = GraspLaw(space, self.driven, self.write, *self.new())
        self.become(space.betas[0], self.template, mujoco.MjData(self.template))

    def _holds(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Spring, damping and armature of each slot when frozen, and the e-folds over which they grow: (n_slots,) each."""
        sliding = np.array([slot.sliding for slot in self.space.matching.slots])
        arm = np.arange(len(sliding)) < self._arm
        spring = np.where(arm, FROZEN_ARM_STIFFNESS, np.where(sliding, FROZEN_SLIDE_STIFFNESS, FROZEN_STIFFNESS))
        armature = np.where(arm, FROZEN_ARM_ARMATURE, np.where(sliding, FROZEN_SLIDE_ARMATURE, FROZEN_ARMATURE))
        decades = np.where(arm | sliding, FROZEN_WIDE_DECADES, FREEZE_DECADES)
        return spring, 2.0 * np.sqrt(spring * armature), armature, np.log(10.0) * decades

    def _tips(self) -> tuple[np.ndarray, np.ndarray]:
        """For each slot the slot at whose anchor its visual bone ends, or itself; and the slots where a finger ends."""
        out = np.arange(len(self._parents))
        for index in range(len(self._parents)):
            children = np.flatnonzero(self._parents == index)
            if index != self._arm - 1 and len(children):
                out[index] = children[0]
        ends = [i for i in range(self._arm, len(out)) if out[i] == i]
        return out, np.array(ends)

    # ---- theta -> what MuJoCo wants ----------------------------------------------------------------------------

    def patch(self, alpha: np.ndarray) -> Patch:
        """Everything that F writes at ``alpha`` (D,)."""
        theta = self.space.theta(alpha)
        anchors = theta["anchor"]
        body_pos = anchors - anchors[self._parents]
        body_pos[self._roots] = anchors[self._roots]
        mass = np.maximum(theta["mass"][:, 0], MIN_MASS)
        moments, frames = principal(mass, theta["gyration"], MIN_INERTIA)
        freeze = theta["freeze"][:, 0]
        lock_spring, lock_damping, lock_armature, folds = self._hold
        locked = np.expm1(folds * freeze) / np.expm1(folds)
        own_spring, own_quadratic = (theta[name][:, 0] * theta["stiffness"][:, 0] for name in ("spring_share", "spring_share_quadratic"))
        lock = locked * lock_spring
        spring = own_spring + lock  # the lock's spring rests at zero
        presence = theta["shape_presence"][:, 0]
        size = np.maximum(theta["shape_size"] * presence[:, None], MIN_SIZE) * self._shape_dims
        # A constraint that fades evenly is as good as rigid nearly to its end, and would fight the motors all the way.
        held = np.expm1(HELD_FOLDS * theta["coupling_held"][:, 0]) / np.expm1(HELD_FOLDS)
        bone_pos, bone_quat, bone_size = self._bone_geometry(theta, presence)
        return Patch(
            anchor=anchors,
            freeze=freeze,
            body_pos=body_pos,
            grasp_pos=START_POSITION - anchors[self._arm - 1],
            axis=directions(theta["axis"], self.space.axis_references, self.space.axis_bases),
            mass=mass,
            com=theta["com"] - anchors,
            inertia=moments,
            inertia_quat=frames,
            air_pos=(theta["air_position"] - anchors)[self._airy],
            air_quat=turned(theta["air_rotation"][self._airy], self._world_axes),
            air_inertia=np.maximum(AIR_MASS / 12.0 * theta["air_edges"][self._airy] ** 2 @ OTHER_TWO, MIN_INERTIA),
            limits=theta["limits"],
            margin=theta["limit_margin"][:, 0],
            lock=lock,
            spring=spring,
            spring_quadratic=own_quadratic,
            spring_rest=own_spring * theta["spring_rest"][:, 0] / np.maximum(spring, 1e-12),
            damping=theta["damping"][:, 0] * (1 - freeze) + locked * lock_damping,
            armature=theta["armature"][:, 0] * (1 - freeze) + locked * lock_armature,
            friction_loss=theta["friction_loss"][:, 0],
            gain=theta["stiffness"][self.driven, 0],
            start_target=theta["start_target"][self.driven, 0],
            preshape=float(theta["preshape"][0, 0]),
            rate=float(10.0 ** theta["log_rate"][0, 0]),
            shape_pos=theta["shape_position"] - anchors[self._shape_slot],
            shape_quat=turned(theta["shape_rotation"], self._shape_reference),
            shape_size=size,
            shape_contact=np.where(presence > TOUCHES, HAND_BIT, 0),
            shape_activity=np.clip((presence - TOUCHES) / WAKING, 0.0, 1.0),
            shape_friction=theta["shape_friction"],
            shape_solref=theta["shape_solref"],
            shape_margin=theta["shape_margin"][:, 0],
            coupling=theta["coupling"],
            coupling_stiffness=theta["coupling_stiffness"][:, 0],
            coupling_slack=theta["coupling_slack"] @ LOW_AND_WIDTH,
            coupling_limits=theta["coupling_limits"],
            # While the tendon is held its friction does no work; as the hold softens, the finger would stick in it.
            coupling_friction=theta["coupling_friction"][:, 0] * held**HELD_FADING,
            # MuJoCo's defaults when fully held. Its constraint acceleration goes as 1 / (impedance * time^2), so a coupling
            # fades out in proportion to ``held`` only if its time constant grows as the impedance falls.
            coupling_impedance=held[:, None] * IMPEDANCE,
            coupling_time=0.02 / np.maximum(held, 1e-3),
            coupling_length=theta["coupling_length"][:, 0],
            coupling_held=held > HELD,
            curve=theta["curve"],
            curve_stiffness=theta["curve_stiffness"][:, 0],
            torque_limit=np.maximum(theta["torque_limit"][:, 0], 1e-9),
            bone_pos=bone_pos,
            bone_quat=bone_quat,
            bone_size=bone_size,
        )

    def _bone_geometry(self, theta: dict[str, np.ndarray], presence: np.ndarray) -> tuple[np.ndarray, ...]:
        anchors = theta["anchor"]
        tips = anchors[self._tip_of]
        tips[self._arm - 1] = 0.5 * (anchors[self._arm - 1] + START_POSITION)
        finger_tips(tips, self._ends, self._shape_slot, presence, theta["shape_position"])
        radius = self._bone_radius * (1.0 - theta["freeze"][:, 0])
        return bones(anchors, tips, np.maximum(radius, MIN_SIZE), MIN_SIZE)

    # ---- from scratch ------------------------------------------------------------------------------------------

    def spec(self, p: Patch) -> mujoco.MjSpec:
        """The patched scene as an MjSpec: the reference that F in place must equal field by field."""
        spec = mujoco.MjSpec()
        spec.modelname = "merged"
        spec.compiler.degree = False
        # robosuite 1.5.1, base.xml.
        spec.option.timestep, spec.option.impratio = 0.002, 20.0
        spec.option.density, spec.option.viscosity = 1.2, 2e-5
        spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
        # Bounding-volume trees of bodies are compiled; few geoms per body make them useless, and F would have to mend them.
        spec.option.disableflags = mujoco.mjtDisableBit.mjDSBL_MIDPHASE
        self.task.add_furniture(spec)
        bodies = self._add_links(spec, p)
        self._add_shapes(bodies, p)
        self._add_actuators(spec, p)
        self._add_couplings(spec, p)
        self._add_curves(spec, p)
        self.task.add_object(spec)
        return spec

    def _add_links(self, spec: mujoco.MjSpec, p: Patch) -> list:
        bodies: list[mujoco.MjsBody] = []
        hinge, slide = mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE
        for i, slot in enumerate(self.space.matching.slots):
            parent = spec.worldbody if slot.parent < 0 else bodies[slot.parent]
            body = parent.add_body(
                name=slot.name, pos=p.body_pos[i], mass=p.mass[i], ipos=p.com[i], iquat=p.inertia_quat[i],
                inertia=p.inertia[i], explicitinertial=True,
            )
            body.add_joint(
                name=slot.name, type=slide if slot.sliding else hinge, axis=p.axis[i], limited=True, range=p.limits[i],
                margin=p.margin[i], stiffness=[p.spring[i], p.spring_quadratic[i], 0], springref=p.spring_rest[i],
                damping=p.damping[i], armature=p.armature[i], frictionloss=p.friction_loss[i],
            )
            rgba = [0.3, 0.33, 0.38, 1] if i < self._arm else [0.55, 0.58, 0.62, 1]
            body.add_geom(
                name=f"{slot.name}/bone", type=mujoco.mjtGeom.mjGEOM_CAPSULE, size=p.bone_size[i], pos=p.bone_pos[i],
                quat=p.bone_quat[i], contype=0, conaffinity=0, group=1, rgba=rgba, density=0,
            )
            bodies.append(body)
        for k, airy in enumerate(self._airy):
            bodies[airy].add_body(
                name=f"{self.space.matching.slots[airy].name}/air", pos=p.air_pos[k], quat=p.air_quat[k], mass=AIR_MASS, ipos=[0, 0, 0],
                inertia=p.air_inertia[k], explicitinertial=True,
            )
        flange = bodies[self._arm - 1]
        quat = quaternion(START_ROTATION)
        flange.add_site(name="grasp", pos=p.grasp_pos, quat=quat)
        return bodies

    def _add_shapes(self, bodies: list, p: Patch) -> None:
        for i, shape in enumerate(self.space.shape_slots):
            owner_is_source = shape.owners[0] is not None
            bodies[shape.slot].add_geom(
                name=shape.name, type=mujoco.mjtGeom(shape.kind), size=p.shape_size[i], pos=p.shape_pos[i],
                quat=p.shape_quat[i], friction=p.shape_friction[i], solref=p.shape_solref[i], margin=p.shape_margin[i],
                condim=shape.condim, contype=HAND_BIT, conaffinity=0, group=1, density=0,
                rgba=[0.85, 0.65, 0.5, 1] if owner_is_source else [0.2, 0.45, 0.75, 1],
            )

    def _add_actuators(self, spec: mujoco.MjSpec, p: Patch) -> None:
        slots = self.space.matching.slots
        for i in range(self._arm):
            limit = p.torque_limit[i]
            actuator = spec.add_actuator(name=slots[i].name, target=slots[i].name, ctrllimited=True, ctrlrange=[-limit, limit])
            actuator.trntype = mujoco.mjtTrn.mjTRN_JOINT
        for k, i in enumerate(self.driven):
            gain = p.gain[k]
            actuator = spec.add_actuator(  # how strong it is, the grasp law says
                name=slots[i].name, target=slots[i].name, forcelimited=True, forcerange=[-1.0, 1.0],
                biastype=mujoco.mjtBias.mjBIAS_AFFINE,
            )
            actuator.gainprm[0], actuator.biasprm[1] = gain, -gain
            actuator.trntype = mujoco.mjtTrn.mjTRN_JOINT

    def _add_couplings(self, spec: mujoco.MjSpec, p: Patch) -> None:
        slots = self.space.matching.slots
        for i, coupling in enumerate(self.space.coupling_slots):
            tendon = spec.add_tendon(name=coupling.name, stiffness=p.coupling_stiffness[i],
                                     frictionloss=p.coupling_friction[i], springlength=p.coupling_slack[i],
                                     limited=True, range=p.coupling_limits[i])
            for slot, coefficient in zip(coupling.slots, p.coupling[i], strict=False):
                tendon.wrap_joint(slots[slot].name, coefficient)
            equality = spec.add_equality(name=coupling.name, name1=coupling.name, type=mujoco.mjtEq.mjEQ_TENDON,
                                         active=bool(p.coupling_held[i]), objtype=mujoco.mjtObj.mjOBJ_TENDON)
            equality.data[0] = p.coupling_length[i]
            equality.solimp[:2] = p.coupling_impedance[i]
            equality.solref[0] = p.coupling_time[i]

    def _add_curves(self, spec: mujoco.MjSpec, p: Patch) -> None:
        slots = self.space.matching.slots
        for i, curve in enumerate(self.space.curve_slots):
            equality = spec.add_equality(
                name=curve.name, type=mujoco.mjtEq.mjEQ_JOINT, objtype=mujoco.mjtObj.mjOBJ_JOINT, name1=slots[curve.pad].name,
                name2=slots[curve.driven].name, active=bool(p.curve_stiffness[i] > HELD),
            )
            equality.data[:5] = (0.0, *p.curve[i], 0.0, 0.0)
            equality.solimp[:2] = SOFT

    def compile(self, alpha: np.ndarray) -> mujoco.MjModel:
        """A model compiled from scratch at ``alpha`` (D,).

        Raises:
            ToolkitError: MuJoCo refuses the merged model; the sentence names the robots and MuJoCo's complaint.
        """
        try:
            patch = self.patch(alpha)
            model = self.spec(patch).compile()
        except ValueError as error:
            names = ", ".join(self.space.matching.names)
            raise ToolkitError(f"the merged robot of {names} does not compile: {' '.join(str(error).split())}") from error
        self._loosen(model)
        self._set_contacts(model, patch)
        self._soften(model, patch)
        self._set_motors(alpha, patch, model, mujoco.MjData(model))
        return model

    def _loosen(self, model: mujoco.MjModel) -> None:
        """Undo what the compiler concluded from one robot's frames and boxes, so that F may move both."""
        model.body_sameframe[:], model.geom_sameframe[:], model.site_sameframe[:] = 0, 0, 0
        model.body_simple[:], model.dof_simplenum[:] = 0, 0
        self._address(model)
        for body in np.unique(model.geom_bodyid[self._shape]):
            nodes = np.arange(model.body_bvhadr[body], model.body_bvhadr[body] + model.body_bvhnum[body])
            model.bvh_aabb[nodes] = (0, 0, 0, HAND_EXTENT, HAND_EXTENT, HAND_EXTENT)

    def _set_contacts(self, model: mujoco.MjModel, p: Patch) -> None:
        """Contact bits of the hand's geoms, and of its bodies, which the broad phase looks at first."""
        model.geom_contype[self._shape] = p.shape_contact
        model.body_contype[self._shape_body] = 0
        model.body_contype[self._shape_body[p.shape_contact > 0]] = HAND_BIT

    def _soften(self, model: mujoco.MjModel, p: Patch) -> None:
        """Give the pads' constraints their stiffnesses.

        At constant impedance d, MuJoCo's constraint of time constant t and damping ratio 1 is a spring of stiffness
        1 / (t^2 (1 - d) A), critically damped, where A is the sum of the joints' inverse inertias.
        """
        inverse_inertia = model.dof_invweight0[self._curve_dofs].sum(axis=1)
        model.eq_solref[self._curve, 0] = 1.0 / np.sqrt(np.maximum(p.curve_stiffness, HELD) * (1.0 - SOFT) * inverse_inertia)

    # ---- in place ----------------------------------------------------------------------------------------------

    def _address(self, model: mujoco.MjModel) -> None:
        slots = self.space.matching.slots
        self._body = _span([model.body(s.name).id for s in slots])
        self._air = np.array([model.body(f"{slots[i].name}/air").id for i in self._airy], int)
        joint = [model.joint(s.name).id for s in slots]
        dof = model.jnt_dofadr[joint]
        self._joint, self._dof, self._qpos = _span(joint), _span(dof), _span(model.jnt_qposadr[joint])
        self._bone = np.array([model.geom(f"{s.name}/bone").id for s in slots])
        self._shape = np.array([model.geom(s.name).id for s in self.space.shape_slots])
        self._shape_body = model.geom_bodyid[self._shape]
        self._shape_bounds, self._bone_bounds = self._bounds(model, self._shape), self._bounds(model, self._bone)
        self._arm_actuator = _span([model.actuator(s.name).id for s in slots[: self._arm]])
        self._finger_actuator = _span([model.actuator(slots[i].name).id for i in self.driven])
        self._finger_joints = np.array(joint)[self.driven]
        self._grasp = model.site("grasp").id
        couplings = self.space.coupling_slots
        tendon = np.array([model.tendon(c.name).id for c in couplings], int)
        self._tendon, self._equality = _span(tendon), _span([model.equality(c.name).id for c in couplings])
        curves = self.space.curve_slots
        self._curve = _span([model.equality(c.name).id for c in curves])
        self._curve_dofs = np.array([(dof[c.pad], dof[c.driven]) for c in curves], int).reshape(-1, 2)
        first, count = model.tendon_adr[tendon], model.tendon_num[tendon]
        self._wraps = np.concatenate([np.arange(a, a + n) for a, n in zip(first, count, strict=True)] or [np.empty(0)]).astype(int)
        self._wrapped = np.arange(count.max(initial=0)) < count[:, None]

    @staticmethod
    def _bounds(model: mujoco.MjModel, geoms: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """How far geoms of these kinds reach: whether as far as radius plus half length (n,), and size -> extent (n, 3, 3)."""
        capsule = np.array([[1.0, 0, 0], [1, 0, 0], [1, 1, 0]])
        cylinder = np.array([[1.0, 0, 0], [1, 0, 0], [0, 1, 0]])
        extents = {mujoco.mjtGeom.mjGEOM_CAPSULE: capsule, mujoco.mjtGeom.mjGEOM_CYLINDER: cylinder}
        kinds = [mujoco.mjtGeom(kind) for kind in model.geom_type[geoms]]
        round_ = np.array([kind == mujoco.mjtGeom.mjGEOM_CAPSULE for kind in kinds])
        return round_, np.array([extents.get(kind, np.eye(3)) for kind in kinds])

    def new(self) -> tuple[mujoco.MjModel, mujoco.MjData]:
        """A model at the source and its data, ready to be patched and stepped."""
        import copy

        model = copy.copy(self.template)
        return model, mujoco.MjData(model)

    def become(self, alpha: np.ndarray, model: mujoco.MjModel, data: mujoco.MjData) -> Course:
        """F(alpha) in place: patch ``model`` (from ``new``) and recompute its derived constants; ``data`` is reset.

        Returns:
            the finger actuators' position targets (n_driven,) over the closing command.
        """
        p = self.write(alpha, model, data)
        targets = self._set_motors(alpha, p, model, data)
        mujoco.mj_resetData(model, data)
        return targets

    def _set_motors(self, alpha: np.ndarray, p: Patch, model: mujoco.MjModel, data: mujoco.MjData) -> Course:
        """Strengths of the finger actuators into ``model``; returns their targets (n_driven,) over the closing command."""
        if self.law is None:  # being measured on, for the law that it will have
            return Course.straight(p.start_target, p.start_target)
        motors = self.law.motors(alpha, p, model, data)
        model.actuator_forcerange[self._finger_actuator] = motors.limit[:, None] * BOTH_WAYS
        model.jnt_range[self._finger_joints] = motors.range
        model.geom_pos[self._shape] = p.shape_pos + motors.slips
        model.actuator_gainprm[self._finger_actuator, 0] = motors.gain
        model.actuator_biasprm[self._finger_actuator, 1] = -motors.gain
        return motors.course

    def write(self, alpha: np.ndarray, model: mujoco.MjModel, data: mujoco.MjData) -> Patch:
        """All of F(alpha) but the strengths of the finger actuators, in place; returns what was written."""
        p = self.patch(alpha)
        model.body_pos[self._body], model.body_mass[self._body] = p.body_pos, p.mass
        model.body_ipos[self._body], model.body_iquat[self._body] = p.com, p.inertia_quat
        model.body_inertia[self._body] = p.inertia
        model.body_pos[self._air], model.body_quat[self._air] = p.air_pos, p.air_quat
        model.body_inertia[self._air] = p.air_inertia
        model.jnt_axis[self._joint], model.jnt_range[self._joint] = p.axis, p.limits
        model.jnt_margin[self._joint], model.jnt_stiffness[self._joint] = p.margin, p.spring
        model.jnt_stiffnesspoly[self._joint, 0], model.qpos_spring[self._qpos] = p.spring_quadratic, p.spring_rest
        model.dof_damping[self._dof], model.dof_armature[self._dof] = p.damping, p.armature
        model.dof_frictionloss[self._dof] = p.friction_loss
        model.site_pos[self._grasp] = p.grasp_pos
        self._patch_geoms(model, p)
        self._patch_actuation(model, p)
        mujoco.mj_setConst(model, data)
        self._soften(model, p)
        return p

    def _patch_geoms(self, model: mujoco.MjModel, p: Patch) -> None:
        for ids, pos, quat, size, (round_, extent) in (
            (self._shape, p.shape_pos, p.shape_quat, p.shape_size, self._shape_bounds),
            (self._bone, p.bone_pos, p.bone_quat, p.bone_size, self._bone_bounds),
        ):
            model.geom_pos[ids], model.geom_quat[ids] = pos, quat
            model.geom_size[ids] = size
            model.geom_rbound[ids] = np.where(round_, size[:, 0] + size[:, 1], np.sqrt((size * size).sum(axis=1)))
            model.geom_aabb[ids, 3:] = (extent @ size[:, :, None])[:, :, 0]
        self._set_contacts(model, p)
        model.geom_friction[self._shape] = p.shape_friction
        model.geom_solref[self._shape] = p.shape_solref
        model.geom_margin[self._shape] = p.shape_margin

    def _patch_actuation(self, model: mujoco.MjModel, p: Patch) -> None:
        model.actuator_ctrlrange[self._arm_actuator] = p.torque_limit[:, None] * BOTH_WAYS
        model.actuator_gainprm[self._finger_actuator, 0] = p.gain
        model.actuator_biasprm[self._finger_actuator, 1] = -p.gain
        model.wrap_prm[self._wraps] = p.coupling[self._wrapped]
        model.tendon_stiffness[self._tendon] = p.coupling_stiffness
        model.tendon_lengthspring[self._tendon] = p.coupling_slack
        model.tendon_range[self._tendon] = p.coupling_limits
        model.tendon_frictionloss[self._tendon] = p.coupling_friction
        model.eq_active0[self._equality] = p.coupling_held
        model.eq_data[self._equality, 0] = p.coupling_length
        model.eq_solimp[self._equality, :2] = p.coupling_impedance
        model.eq_solref[self._equality, 0] = p.coupling_time
        model.eq_data[self._curve, 1:3], model.eq_active0[self._curve] = p.curve, p.curve_stiffness > HELD

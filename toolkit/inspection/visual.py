"""What is drawn of a merged robot, and where it stands in every frame: meshes, primitives, scenery, and from where one looks at them.

Of arms with grippers the unmodified robots' meshes, hung on the merged robot's links and fading into one another, with what touches in
the physics as wireframes. Of a family every visible geom and site of the compiled model as it is; where a link's shape changes and its
meshes cannot, these fade into the shapes that touch.
"""

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from toolkit.errors import ToolkitError
from toolkit.inspection.appearance import Appearance, Mesh, body_mesh, geom_colour, geom_mesh, geom_triangles, weights
from toolkit.inspection.furniture import furniture, world_meshes
from toolkit.inspection.trajectory import PickTrajectory, Trajectory
from toolkit.morphology.build import MergedRobot
from toolkit.morphology.family import MergedModel
from toolkit.morphology.lab import Merged

VISIBLE = 3
"""MuJoCo draws the groups 0 to 2 of geoms and sites (mjv_defaultOption)."""
KINDS = {
    mujoco.mjtGeom.mjGEOM_CAPSULE: "capsules", mujoco.mjtGeom.mjGEOM_BOX: "boxes", mujoco.mjtGeom.mjGEOM_CYLINDER: "cylinders",
    mujoco.mjtGeom.mjGEOM_SPHERE: "ellipsoids", mujoco.mjtGeom.mjGEOM_ELLIPSOID: "ellipsoids",
}
"""Kind of primitive as which a geom or site is drawn."""
BONE, WIRE = (70, 74, 82, 255), (30, 90, 200, 255)
BONE_SHARE = 0.35
"""Bones are drawn this much thinner than they are, inside the meshes."""
SKIN, SHAPE, ALWAYS = 0, 1, 2
"""Of a family: columns of the weights of meshes that fade, of the shapes into which they fade, and of everything else."""
AROUND, LOWER = 50.0, 0.8
"""[deg] by which one looks at a robot from further round than at its scene, and share of the scene's elevation."""
DISTANCE = 1.3
"""Of the eye, in diagonals of what is looked at: a field of view of 45 degrees holds its ball at 1.3."""
ROOM = 1.4
"""By how much more a scene spans than what moves in it does where an episode begins."""


@dataclass(frozen=True, eq=False)
class Primitives:
    """Primitives of one kind, drawn together.

    Attributes:
        kind: "capsules", "boxes", "ellipsoids" or "cylinders".
        colours: (n, 4) or (4,), 0 to 255.
        columns: (n,) of the weights with which each shows; None: they show always.
        wire: as wireframes.
        thinness: share of a radius that is drawn.
    """

    kind: str
    colours: np.ndarray
    columns: np.ndarray | None = None
    wire: bool = False
    thinness: float = 1.0


@dataclass(frozen=True, eq=False)
class Framing:
    """From where one looks: pairs of the eye (3,) and the point looked at (3,), world [m].

    Attributes:
        whole: the whole scene.  near: the robot.  beside: several robots side by side.
        apart: [m] between these.
        label: (3,) [m] where it is written what a robot is.
    """

    whole: tuple[np.ndarray, np.ndarray]
    near: tuple[np.ndarray, np.ndarray]
    beside: tuple[np.ndarray, np.ndarray]
    apart: float
    label: np.ndarray


AT_THE_TABLE = Framing(
    whole=(np.array([0.52, -0.92, 1.45]), np.array([-0.22, 0.0, 1.08])), near=(np.array([0.52, -0.92, 1.45]), np.array([-0.22, 0.0, 1.08])),
    beside=(np.array([0.75, 0.0, 1.3]), np.array([-0.25, 0.0, 1.12])), apart=0.95, label=np.array([-0.3, 0.0, 1.75]),
)
"""Arms with grippers at their table, from beside the robot."""
Part = tuple[np.ndarray, np.ndarray, np.ndarray]
"""Positions (T, n, 3) [m], quaternions (T, n, 4), w first, and sizes (T, n, 3) [m] as of mjModel.geom_size, of primitives."""


@dataclass(frozen=True, eq=False)
class Motion:
    """One robot over T frames, world frame.

    Attributes:
        positions: (T, n_instances, 3) [m] and quaternions: (T, n_instances, 4) w first, of the meshes' instances.
        weights: (T, n_columns) how much shows: of arms a column per robot, of a family SKIN, SHAPE, ALWAYS.
        parts: name of primitives -> where they are and how large.
        carried: (T, 7) pose of the object; None where there is none.
    """

    positions: np.ndarray
    quaternions: np.ndarray
    weights: np.ndarray
    parts: dict[str, Part]
    carried: np.ndarray | None = None

    def moved(self, offset: np.ndarray) -> "Motion":
        """The same robot elsewhere: offset (3,) [m]."""
        parts = {name: (positions + offset, *rest) for name, (positions, *rest) in self.parts.items()}
        carried = None if self.carried is None else self.carried + np.pad(offset, (0, 4))
        return replace(self, positions=self.positions + offset, parts=parts, carried=carried)

    def stretched(self, count: int) -> "Motion":
        """Its first ``count`` frames; the last one again where there are fewer."""
        parts = {name: (held(places, count), held(turns, count), held(sizes, count)) for name, (places, turns, sizes) in self.parts.items()}
        carried = None if self.carried is None else held(self.carried, count)
        return Motion(held(self.positions, count), held(self.quaternions, count), held(self.weights, count), parts, carried)


def held(values: np.ndarray, count: int) -> np.ndarray:
    """The first ``count`` rows; the last one repeated if there are fewer."""
    rows = values[:count]
    return np.concatenate([rows, np.repeat(rows[-1:], count - len(rows), axis=0)]) if len(rows) < count else rows


def _joined(frames: list[Motion]) -> Motion:
    """Motions of single frames, one after another."""
    stack = lambda arrays: np.concatenate(list(arrays))  # noqa: E731
    part = lambda name, k: stack(frame.parts[name][k] for frame in frames)  # noqa: E731
    parts = {name: (part(name, 0), part(name, 1), part(name, 2)) for name in frames[0].parts}
    carried = None if frames[0].carried is None else stack(frame.carried for frame in frames)
    return Motion(stack(frame.positions for frame in frames), stack(frame.quaternions for frame in frames),
                stack(frame.weights for frame in frames), parts, carried)


class Visual(ABC):
    """Turns robots and trajectories into motions.

    Attributes:
        meshes: each once.
        instances: (n_instances, 2) index of the mesh, and column of the weights with which it shows.
        primitives: by the names that they have in a motion.
        carried: look of the object that is moved about; None where the model's bodies are all that there is.
        scenery: what never moves, world frame.
        framing: from where one looks.
    """

    meshes: list[Mesh]
    instances: np.ndarray
    primitives: Mapping[str, Primitives]
    carried: Mesh | None
    scenery: list[Mesh]
    framing: Framing

    @abstractmethod
    def standing(self, alphas: Sequence[np.ndarray] | np.ndarray) -> Motion:
        """Robots F(alpha) at the start, one per frame."""

    @abstractmethod
    def playing(self, trajectory: Trajectory, alpha: np.ndarray) -> Motion:
        """A trajectory on F(alpha)."""

    @abstractmethod
    def native(self, trajectory: Trajectory, robot: str) -> Motion:
        """A trajectory on the unmodified robot of that name."""


def visual_of(merged: Merged) -> Visual:
    """Whatever a merged robot is, how it is drawn."""
    return ModelVisual(merged) if isinstance(merged, MergedModel) else ArmVisual(merged)


class ArmVisual(Visual):
    """Arms with grippers at their table.

    Args:
        merged: the merged robot.
    """

    framing = AT_THE_TABLE
    carried: Mesh

    def __init__(self, merged: MergedRobot) -> None:
        self.merged, self.appearance = merged, Appearance(merged.space)
        template = merged.template
        self.links = [template.body(slot.name).id for slot in merged.space.matching.slots]
        self._object = template.body("object").id
        bones = [template.geom(f"{slot.name}/bone").id for slot in merged.space.matching.slots]
        self._shapes = [template.geom(shape.name).id for shape in merged.space.shape_slots]
        boxes = [geom for geom in self._shapes if template.geom_type[geom] == mujoco.mjtGeom.mjGEOM_BOX]
        self._geoms = {"bones": bones, "pads": [geom for geom in self._shapes if geom not in boxes], "boxes": boxes}
        self.meshes = self.appearance.meshes
        self.instances = np.array([(item.mesh, item.robot) for item in self.appearance.instances])
        self.primitives = {"bones": Primitives("capsules", np.array(BONE), thinness=BONE_SHARE),
                           "pads": Primitives("capsules", np.array(WIRE), wire=True),
                           "boxes": Primitives("boxes", np.array(WIRE), wire=True)}
        carried = body_mesh(template, self._object)
        if carried is None:
            raise ToolkitError(f"task {merged.task.name!r} adds an object without a visible geom; give it one in group 0 or 1")
        self.carried = carried
        self.scenery = furniture(merged.space.matching.systems[0].model)

    def standing(self, alphas: Sequence[np.ndarray] | np.ndarray) -> Motion:
        """Robots F(alpha) at the start posture, one per frame."""
        frames = []
        model, data = self.merged.new()
        for alpha in alphas:
            self.merged.become(alpha, model, data)
            mujoco.mj_kinematics(model, data)
            frames.append(self._frame(model, data, weights(alpha, self.merged.space.betas)))
        return _joined(frames)

    def playing(self, trajectory: Trajectory, alpha: np.ndarray) -> Motion:
        """A trajectory on F(alpha)."""
        data = mujoco.MjData(trajectory.model)
        shares = weights(alpha, self.merged.space.betas)
        frames = []
        for row in trajectory.qpos:
            data.qpos[:] = row
            mujoco.mj_kinematics(trajectory.model, data)
            frames.append(self._frame(trajectory.model, data, shares))
        return _joined(frames)

    def native(self, trajectory: Trajectory, robot: str) -> Motion:
        """A trajectory on the unmodified robosuite robot."""
        if not isinstance(trajectory, PickTrajectory):
            raise TypeError("a trajectory of an arm with a gripper is a PickTrajectory")
        data = mujoco.MjData(trajectory.model)
        index = self.merged.space.names.index(robot)
        own = [k for k, item in enumerate(self.appearance.instances) if item.robot == index]
        bodies = [self.appearance.instances[k].body for k in own]
        steps, instances = len(trajectory.qpos), len(self.appearance.instances)
        positions, quaternions, carried = np.zeros((steps, instances, 3)), np.zeros((steps, instances, 4)), np.empty((steps, 7))
        quaternions[..., 0] = 1.0
        for frame, row in enumerate(trajectory.qpos):
            data.qpos[:] = row
            mujoco.mj_kinematics(trajectory.model, data)
            positions[frame, own], quaternions[frame, own] = data.xpos[bodies], data.xquat[bodies]
            carried[frame] = [*data.xpos[trajectory.object_body], *data.xquat[trajectory.object_body]]
        shares = np.zeros((steps, len(self.merged.space.names)))
        shares[:, index] = 1.0
        none = np.empty((steps, 0, 3)), np.empty((steps, 0, 4)), np.empty((steps, 0, 3))
        return Motion(positions, quaternions, shares, dict.fromkeys(self.primitives, none), carried)

    def _frame(self, model: mujoco.MjModel, data: mujoco.MjData, shares: np.ndarray) -> Motion:
        positions, quaternions = self.appearance.poses(model, data, self.links, self._shapes)
        parts = {name: _of_geoms(model, data, geoms) for name, geoms in self._geoms.items()}
        carried = np.array([*data.xpos[self._object], *data.xquat[self._object]])
        return Motion(positions[None], quaternions[None], shares[None], parts, carried[None])


def _of_geoms(model: mujoco.MjModel, data: mujoco.MjData, geoms: Sequence[int]) -> Part:
    """One frame of primitives that are geoms."""
    turned = Rotation.from_matrix(data.geom_xmat[geoms].reshape(-1, 3, 3)).as_quat(scalar_first=True)
    return np.array(data.geom_xpos[geoms])[None], turned[None], np.array(model.geom_size[geoms])[None]


def _matrices(quaternions: np.ndarray) -> np.ndarray:
    """(n, 9) of quaternions (n, 4), w first."""
    return Rotation.from_quat(quaternions, scalar_first=True).as_matrix().reshape(-1, 9)


def _of_sites(model: mujoco.MjModel, data: mujoco.MjData, sites: Sequence[int]) -> Part:
    turned = Rotation.from_matrix(data.site_xmat[sites].reshape(-1, 3, 3)).as_quat(scalar_first=True)
    return np.array(data.site_xpos[sites])[None], turned[None], np.array(model.site_size[sites])[None]


class ModelVisual(Visual):
    """Robots of a family in their task's scene.

    Args:
        merged: the merged robot.

    Attributes:
        geoms, sites: ids of what is drawn of the model, each with its column of the weights.
    """

    carried = None

    def __init__(self, merged: MergedModel) -> None:
        self.merged = merged
        model = merged.template
        self.geoms, self.sites = self._drawn(model)
        meshed = [geom for geom in self.geoms if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_MESH]
        self._meshed, self.meshes, known, instances = meshed, [], {}, []
        for geom in meshed:
            mesh, column = geom_mesh(model, geom), self.geoms[geom]
            if (mesh.digest, column) not in known:  # the instances of one mesh fade together
                known[mesh.digest, column] = len(self.meshes)
                self.meshes.append(mesh)
            instances.append((known[mesh.digest, column], column))
        self.instances = np.array(instances, int).reshape(-1, 2)
        self._parts: dict[str, tuple[list[int], list[int]]] = {}
        for ids, kinds, column in ((self.geoms, model.geom_type, 0), (self.sites, model.site_type, 1)):
            for index in ids:
                if (kind := KINDS.get(mujoco.mjtGeom(kinds[index]))) is not None:
                    self._parts.setdefault(kind, ([], []))[column].append(index)
        self.primitives = {kind: self._primitives(model, kind, *own) for kind, own in self._parts.items()}
        self._balls = {kind: np.array([*(model.geom_type[geoms] == mujoco.mjtGeom.mjGEOM_SPHERE),
                                       *(model.site_type[sites] == mujoco.mjtGeom.mjGEOM_SPHERE)])
                       for kind, (geoms, sites) in self._parts.items()}
        self.framing, span = self._framed()
        self.scenery = world_meshes(model, *span)

    def _drawn(self, model: mujoco.MjModel) -> tuple[dict[int, int], dict[int, int]]:
        """Geoms and sites that are drawn -> their columns of the weights; what stands on the world itself is scenery."""
        rows = self.merged.space.rows
        touching = model.geom_contype + model.geom_conaffinity > 0
        changing = np.union1d(rows.get("geom_size", []), rows.get("geom_pos", [])).astype(int)
        changed = set(model.geom_bodyid[changing[touching[changing]]].tolist())
        seen = [geom for geom in range(model.ngeom) if model.geom_bodyid[geom] > 0 and model.geom_group[geom] < VISIBLE
                and geom_colour(model, geom)[3] > 0]
        fading = [geom for geom in seen if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_MESH
                  and _touched(model, touching, int(model.geom_bodyid[geom])) in changed]
        bare = np.unique(model.geom_bodyid[fading])
        shapes = [geom for geom in range(model.ngeom) if geom not in seen and model.geom_bodyid[geom] in bare
                  and touching[geom]]
        geoms = dict.fromkeys(seen, ALWAYS) | dict.fromkeys(fading, SKIN) | dict.fromkeys(shapes, SHAPE)
        sites = [site for site in range(model.nsite) if model.site_group[site] < VISIBLE and model.site_rgba[site, 3] > 0]
        return geoms, dict.fromkeys(sites, ALWAYS)

    def _primitives(self, model: mujoco.MjModel, kind: str, geoms: list[int], sites: list[int]) -> Primitives:
        painted = [geom_colour(model, geom) for geom in geoms] + [np.round(255 * model.site_rgba[site]) for site in sites]
        colours = np.array(painted).reshape(-1, 4).astype(np.uint8)
        columns = np.array([self.geoms[geom] for geom in geoms] + [self.sites[site] for site in sites])
        colours[columns == SHAPE, 3] = 255  # they are made to be seen through, with the meshes around them
        return Primitives(kind, colours, columns if (columns != ALWAYS).any() else None)

    def _framed(self) -> tuple[Framing, tuple[np.ndarray, np.ndarray]]:
        """From where one looks, and what the scene spans: least and greatest corner (3,) [m].

        The robots are seen as large as they get, where the episode of seed 0 begins. Of a scene everything is seen if its robots can walk
        away, else what moves.
        """
        space, (model, data) = self.merged.space, self.merged.new()
        root = model.body(space.robots[0].family.root).id
        free = model.body_jntnum[root] > 0 and model.jnt_type[model.body_jntadr[root]] == mujoco.mjtJoint.mjJNT_FREE
        solid = [geom for geom in range(model.ngeom)
                 if model.geom_type[geom] != mujoco.mjtGeom.mjGEOM_PLANE and model.geom_group[geom] < VISIBLE]
        own = [geom for geom in solid if _hangs_on(model, int(model.geom_bodyid[geom]), root)]
        moving = [geom for geom in solid if free or model.body_weldid[model.geom_bodyid[geom]] > 0]
        robots, scenes = [], []
        for beta in space.betas:
            self._begin(beta, model, data)
            robots.append(_span(model, data, own))
            scenes.append(_span(model, data, moving))
        everything = _span(model, data, solid)
        near, whole = _around(robots), _around(scenes)
        if not free:
            middle, half = (whole[0] + whole[1]) / 2, ROOM * (whole[1] - whole[0]) / 2
            whole = middle - half, middle + half
        look, across = model.vis.global_, float((whole[1] - whole[0])[1])
        beside = _seen_from(whole[0] - (0.0, across / 2, 0.0), whole[1] + (0.0, across / 2, 0.0), 180.0, look.elevation)
        label = np.array([*(near[0] + near[1])[:2] / 2, near[1][2] + 0.1 * float(np.max(near[1] - near[0]))])
        return Framing(_seen_from(*whole, look.azimuth, look.elevation),
                       _seen_from(*near, look.azimuth + AROUND, LOWER * look.elevation), beside, across, label), everything

    def _begin(self, alpha: np.ndarray, model: mujoco.MjModel, data: mujoco.MjData) -> None:
        self.merged.become(alpha, model, data)
        self.merged.task.scene(model, data).begin(np.random.default_rng(0))

    def standing(self, alphas: Sequence[np.ndarray] | np.ndarray) -> Motion:
        """Robots F(alpha) where the episode of seed 0 begins, one per frame."""
        frames, (model, data) = [], self.merged.new()
        for alpha in alphas:
            self._begin(alpha, model, data)
            frames.append(self._frame(model, data, self._shares(alpha)))
        return _joined(frames)

    def playing(self, trajectory: Trajectory, alpha: np.ndarray) -> Motion:
        """A trajectory on F(alpha)."""
        model, data = trajectory.model, mujoco.MjData(trajectory.model)
        model.body_pos[:], model.site_pos[:] = trajectory.body_pos, trajectory.site_pos  # a later episode may have moved them
        shares, frames = self._shares(alpha), []
        for row in trajectory.qpos:
            data.qpos[:] = row
            mujoco.mj_kinematics(model, data)
            frames.append(self._frame(model, data, shares))
        return _joined(frames)

    def native(self, trajectory: Trajectory, robot: str) -> Motion:
        """A trajectory on the unmodified robot, whose model has the same elements."""
        return self.playing(trajectory, self.merged.space.beta(robot))

    def pose(self, motion: Motion, frame: int, model: mujoco.MjModel, data: mujoco.MjData) -> None:
        """Write a motion's frame into a model of these robots, to be drawn: sizes, and what mj_kinematics computes of geoms and sites."""
        data.geom_xpos[self._meshed], data.geom_xmat[self._meshed] = motion.positions[frame], _matrices(motion.quaternions[frame])
        for kind, (geoms, sites) in self._parts.items():
            places, turns, sizes = (array[frame] for array in motion.parts[kind])
            count = len(geoms)
            data.geom_xpos[geoms], data.geom_xmat[geoms], model.geom_size[geoms] = places[:count], _matrices(turns[:count]), sizes[:count]
            data.site_xpos[sites], data.site_xmat[sites], model.site_size[sites] = places[count:], _matrices(turns[count:]), sizes[count:]

    def _shares(self, alpha: np.ndarray) -> np.ndarray:
        """(3,) how much shows of SKIN, SHAPE and ALWAYS."""
        source = weights(alpha, self.merged.space.betas)[0]
        return np.array([source, 1.0 - source, max(source, 1.0 - source)])

    def _frame(self, model: mujoco.MjModel, data: mujoco.MjData, shares: np.ndarray) -> Motion:
        positions, quaternions, _ = _of_geoms(model, data, self._meshed)
        parts = {}
        for kind, (geoms, sites) in self._parts.items():
            pair = _of_geoms(model, data, geoms), _of_sites(model, data, sites)
            places, turns, sizes = (np.concatenate(both, axis=1) for both in zip(*pair, strict=True))
            parts[kind] = places, turns, np.where(self._balls[kind][:, None], sizes[..., :1], sizes)
        return Motion(positions, quaternions, shares[None], parts)


def _touched(model: mujoco.MjModel, touching: np.ndarray, body: int) -> int:
    """The body whose shapes touch for a body that has none, as a knuckle: its own, or the next one towards the root."""
    while body > 0 and not touching[model.geom_bodyid == body].any():
        body = int(model.body_parentid[body])
    return body


def _hangs_on(model: mujoco.MjModel, body: int, root: int) -> bool:
    """Whether a body is the root or moves with it."""
    while body > 0 and body != root:
        body = int(model.body_parentid[body])
    return body == root


def _span(model: mujoco.MjModel, data: mujoco.MjData, geoms: Sequence[int]) -> tuple[np.ndarray, np.ndarray]:
    """Least and greatest corner (3,) [m] of geoms, world frame."""
    points = [geom_triangles(model, geom)[0] @ data.geom_xmat[geom].reshape(3, 3).T + data.geom_xpos[geom] for geom in geoms]
    return np.concatenate(points).min(axis=0), np.concatenate(points).max(axis=0)


def _around(spans: Sequence[tuple[np.ndarray, np.ndarray]]) -> tuple[np.ndarray, np.ndarray]:
    """What spans (3,), (3,) span together."""
    low, high = zip(*spans, strict=True)
    return np.min(low, axis=0), np.max(high, axis=0)


def _seen_from(low: np.ndarray, high: np.ndarray, azimuth: float, elevation: float) -> tuple[np.ndarray, np.ndarray]:
    """Eye and point looked at [m] for a box between two corners (3,), from a direction [deg] as of mjvCamera."""
    azimuth, elevation = np.radians(azimuth), np.radians(elevation)
    forward = np.array([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)])
    middle = (low + high) / 2
    return middle - DISTANCE * np.linalg.norm(high - low) * forward, middle

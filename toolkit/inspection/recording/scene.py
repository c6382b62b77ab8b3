"""The robot in 3-D: every mesh once, as many instances of it as robots wear it, placed anew in every frame.

    scene/robot/<mesh>     instances of one mesh; it fades as its robot melts into another
    scene/robot/bones      the merged robot's links as capsules; scene/robot/pads, boxes: what touches, as wireframes
    scene/object, goal, trail, target, contacts, label
"""

from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
import rerun as rr
from scipy.spatial.transform import Rotation

from toolkit.inspection.appearance import Mesh, Wardrobe, body_mesh
from toolkit.inspection.film import Film
from toolkit.inspection.furniture import furniture, opacity
from toolkit.inspection.recording.stream import Stream, x_first
from toolkit.morphology.build import MergedRobot

FAINT = 0.02
"""A robot of less weight is not drawn."""
BONE_SHARE = 0.35
"""Bones are drawn this much thinner than they are, inside the meshes."""
METRES_PER_NEWTON = 0.01
"""Length of a contact's arrow."""
LONGEST_ARROW = 0.25
"""[m] for the jolts of a simulation that comes apart."""
BONE, WIRE, GOAL, TRAIL, AIM, PUSH = (70, 74, 82), (30, 90, 200), (0, 158, 115), (0, 114, 178), (230, 159, 0), (213, 94, 0)


@dataclass(frozen=True, eq=False)
class Cast:
    """One robot over T frames, world frame.

    Attributes:
        positions: (T, n_worn, 3) [m] and quaternions: (T, n_worn, 4) w first, of everything worn.
        weights: (T, n_robots) how much of each robot shows.
        bones, pads: capsules as positions (T, n, 3) of their middles, quaternions (T, n, 4), sizes (T, n, 2): radius
            and half length [m].  boxes: likewise with half sizes (T, n, 3).
        carried: (T, 7) pose of the object.
    """

    positions: np.ndarray
    quaternions: np.ndarray
    weights: np.ndarray
    bones: tuple[np.ndarray, np.ndarray, np.ndarray]
    pads: tuple[np.ndarray, np.ndarray, np.ndarray]
    boxes: tuple[np.ndarray, np.ndarray, np.ndarray]
    carried: np.ndarray

    def moved(self, offset: np.ndarray) -> "Cast":
        """The same robot elsewhere: offset (3,) [m]."""
        parts = {name: (p + offset, q, s) for name, (p, q, s) in (("bones", self.bones), ("pads", self.pads), ("boxes", self.boxes))}
        carried = self.carried.copy()
        carried[:, :3] += offset
        return Cast(self.positions + offset, self.quaternions, self.weights, carried=carried, **parts)


class Casting:
    """Turns robots and films into casts.

    Args:
        merged: the merged robot.
        wardrobe: of its matching.
    """

    def __init__(self, merged: MergedRobot, wardrobe: Wardrobe) -> None:
        self.merged, self.wardrobe = merged, wardrobe
        template = merged.template
        self._links = [template.body(slot.name).id for slot in merged.space.matching.slots]
        self._object = template.body("object").id
        bones = [template.geom(f"{slot.name}/bone").id for slot in merged.space.matching.slots]
        shapes = [template.geom(shape.name).id for shape in merged.space.shape_slots]
        boxes = [geom for geom in shapes if template.geom_type[geom] == mujoco.mjtGeom.mjGEOM_BOX]
        self._geoms = (bones, [geom for geom in shapes if geom not in boxes], boxes)

    def standing(self, alphas: Sequence[np.ndarray]) -> Cast:
        """Robots F(alpha) at the start posture, one per frame."""
        frames = []
        model, data = self.merged.new()
        for alpha in alphas:
            self.merged.become(alpha, model, data)
            mujoco.mj_kinematics(model, data)
            frames.append(self._frame(model, data, self.wardrobe.weights(alpha, self.merged.space.betas)))
        return _joined(frames)

    def playing(self, film: Film, alpha: np.ndarray) -> Cast:
        """A film on F(alpha)."""
        data = mujoco.MjData(film.model)
        weights = self.wardrobe.weights(alpha, self.merged.space.betas)
        frames = []
        for row in film.qpos:
            data.qpos[:] = row
            mujoco.mj_kinematics(film.model, data)
            frames.append(self._frame(film.model, data, weights))
        return _joined(frames)

    def native(self, film: Film, robot: str) -> Cast:
        """A film on the unmodified robosuite robot."""
        data = mujoco.MjData(film.model)
        index = self.merged.space.matching.names.index(robot)
        own = [k for k, item in enumerate(self.wardrobe.worn) if item.robot == index]
        bodies = [self.wardrobe.worn[k].body for k in own]
        steps, worn = len(film.qpos), len(self.wardrobe.worn)
        positions, quaternions, carried = np.zeros((steps, worn, 3)), np.zeros((steps, worn, 4)), np.empty((steps, 7))
        quaternions[..., 0] = 1.0
        for frame, row in enumerate(film.qpos):
            data.qpos[:] = row
            mujoco.mj_kinematics(film.model, data)
            positions[frame, own], quaternions[frame, own] = data.xpos[bodies], data.xquat[bodies]
            carried[frame] = [*data.xpos[film.object_body], *data.xquat[film.object_body]]
        weights = np.zeros((steps, len(self.merged.space.matching.names)))
        weights[:, index] = 1.0
        none = (np.empty((steps, 0, 3)), np.empty((steps, 0, 4)))
        return Cast(positions, quaternions, weights, (*none, np.empty((steps, 0, 2))), (*none, np.empty((steps, 0, 2))),
                    (*none, np.empty((steps, 0, 3))), carried)

    def _frame(self, model: mujoco.MjModel, data: mujoco.MjData, weights: np.ndarray) -> Cast:
        positions, quaternions = self.wardrobe.poses(data, self._links)
        parts = []
        for geoms in self._geoms:
            turned = Rotation.from_matrix(data.geom_xmat[geoms].reshape(-1, 3, 3)).as_quat(scalar_first=True)
            parts.append((np.array(data.geom_xpos[geoms])[None], turned[None], np.array(model.geom_size[geoms])[None]))
        (bones, pads, boxes) = parts
        carried = np.array([*data.xpos[self._object], *data.xquat[self._object]])
        return Cast(positions[None], quaternions[None], weights[None], (*bones[:2], bones[2][..., :2]),
                    (*pads[:2], pads[2][..., :2]), boxes, carried[None])


def _joined(frames: list[Cast]) -> Cast:
    """Casts of single frames, one after another."""
    stack = lambda name: np.concatenate([getattr(frame, name) for frame in frames])  # noqa: E731
    triple = lambda name: tuple(np.concatenate([getattr(frame, name)[k] for frame in frames]) for k in range(3))  # noqa: E731
    return Cast(stack("positions"), stack("quaternions"), stack("weights"), triple("bones"), triple("pads"), triple("boxes"),
                stack("carried"))


class Scene:
    """Draws casts.

    Args:
        stream: to draw into.
        merged: whose table and object are drawn.
        wardrobe: its meshes.
        offsets: [m] where the robots stand; one, or one per robot that is compared.
    """

    def __init__(self, stream: Stream, merged: MergedRobot, wardrobe: Wardrobe, offsets: Sequence[np.ndarray] = (np.zeros(3),)) -> None:
        self.stream, self.wardrobe, self.offsets = stream, wardrobe, [np.asarray(offset, float) for offset in offsets]
        self._users = [[k for k, item in enumerate(wardrobe.worn) if item.mesh == mesh] for mesh in range(len(wardrobe.meshes))]
        self._shown: dict[int, bool] = {}
        names = [mesh.name for mesh in wardrobe.meshes]
        self.entities = [f"scene/robot/{name}" if names.count(name) == 1 else f"scene/robot/{name}-{k}" for k, name in enumerate(names)]
        for entity, mesh in zip(self.entities, wardrobe.meshes, strict=True):
            stream.static(entity, _triangles(mesh))
        stream.static("scene/robot/bones", rr.Capsules3D.from_fields(colors=BONE, fill_mode="solid"))
        stream.static("scene/robot/pads", rr.Capsules3D.from_fields(colors=WIRE, fill_mode="majorwireframe", line_radii=0.0006))
        stream.static("scene/robot/boxes", rr.Boxes3D.from_fields(colors=WIRE, fill_mode="majorwireframe", radii=0.0006))
        stream.static("scene/goal", rr.Ellipsoids3D.from_fields(colors=GOAL, fill_mode="majorwireframe", line_radii=0.001))
        stream.static("scene/trail", rr.LineStrips3D.from_fields(colors=TRAIL, radii=0.0015))
        stream.static("scene/target", rr.Points3D.from_fields(colors=AIM, radii=0.006))
        stream.static("scene/contacts", rr.Arrows3D.from_fields(colors=PUSH, radii=0.0015))
        stream.static("scene/label", rr.Points3D.from_fields(colors=BONE, radii=0.001, show_labels=True))
        template = merged.template
        stream.static("scene/object", _triangles(body_mesh(template, template.body("object").id)))
        for k, mesh in enumerate(furniture(merged.space.matching.systems[0].model)):
            upright = [(0.0, 0.0, 0.0, 1.0)] * len(offsets)
            stream.static(f"scene/furniture/{k}", _triangles(mesh), rr.InstancePoses3D(translations=self.offsets, quaternions=upright))
        self.tolerance = merged.task.goal_tolerance

    def show(self, times: np.ndarray, iteration: int, casts: Sequence[Cast]) -> None:
        """Draw robots over T frames, from ``times`` (T,) [s] on; a cast that is shorter stands still at its end."""
        casts = [_stretched(cast.moved(offset), len(times)) for cast, offset in zip(casts, self.offsets, strict=True)]
        for mesh in range(len(self.entities)):
            self._show_mesh(mesh, times, iteration, casts)
        self._show_parts(times, iteration, casts)
        carried = np.stack([cast.carried for cast in casts], axis=1)
        self.stream.rows("scene/object", times, iteration, _poses(carried[..., :3], carried[..., 3:]))

    def act(self, times: np.ndarray, iteration: int, films: Sequence[Film]) -> None:
        """Draw goals, trails, targets and contacts of films that ``show`` has drawn the robots of."""
        goals = [film.goal + offset for film, offset in zip(films, self.offsets, strict=True)]
        begin, sizes = float(times[0]), [[self.tolerance] * 3] * len(films)
        self.stream.row("scene/goal", begin, iteration, rr.Ellipsoids3D.from_fields(centers=goals, half_sizes=sizes))
        trails = [film.grasp + offset for film, offset in zip(films, self.offsets, strict=True)]
        self.stream.row("scene/trail", begin, iteration, rr.LineStrips3D.from_fields(strips=trails))
        steps = len(times) - 1
        if steps < 1:
            return
        aims = np.stack([_held(film.target, steps) + offset for film, offset in zip(films, self.offsets, strict=True)], axis=1)
        columns = rr.Points3D.columns(positions=aims.reshape(-1, 3)).partition([len(films)] * steps)
        self.stream.rows("scene/target", times[1:], iteration, columns)
        self._touches(times, iteration, films)

    def clear_act(self, time: float, iteration: int) -> None:
        """Take away what belongs to an episode."""
        none, at = np.empty((0, 3)), (np.array([time]), iteration)
        self.stream.rows("scene/goal", *at, rr.Ellipsoids3D.columns(centers=none, half_sizes=none).partition([0]))
        self.stream.row("scene/trail", time, iteration, rr.LineStrips3D.from_fields(strips=[]))
        self.stream.rows("scene/target", *at, rr.Points3D.columns(positions=none).partition([0]))
        self.stream.rows("scene/contacts", *at, rr.Arrows3D.columns(origins=none, vectors=none).partition([0]))

    def label(self, time: float, iteration: int, texts: Sequence[str]) -> None:
        """Write over each robot what it is."""
        places = [np.array([-0.3, 0.0, 1.75]) + offset for offset in self.offsets]
        self.stream.row("scene/label", time, iteration, rr.Points3D.from_fields(positions=places, labels=texts))

    # ---- parts ------------------------------------------------------------------------------------------------

    def _show_mesh(self, mesh: int, times: np.ndarray, iteration: int, casts: Sequence[Cast]) -> None:
        users, worn = self._users[mesh], self.wardrobe.worn
        robots = np.array([worn[user].robot for user in users])
        positions = np.concatenate([cast.positions[:, users] for cast in casts], axis=1)
        quaternions = np.concatenate([cast.quaternions[:, users] for cast in casts], axis=1)
        faint = FAINT if len(casts) == 1 else 0.5  # one opacity serves all instances: of robots side by side, no ghosts
        seen = np.concatenate([_seen(cast, users, robots, faint) for cast in casts], axis=1)
        if not seen.any():
            if self._shown.get(mesh, True):
                times, seen, positions, quaternions = times[:1], seen[:1], positions[:1], quaternions[:1]
            else:
                return
        self._shown[mesh] = bool(seen.any())
        unique = sorted(set(robots.tolist()))
        weights = [cast.weights[: len(times)] for cast in casts]
        shown = np.max([opacity(each[:, unique].sum(axis=1), each.max(axis=1)) for each in weights], axis=0)
        colours = [(255, 255, 255, int(value)) for value in np.round(255 * shown)]
        columns = _poses(positions[seen], quaternions[seen], lengths=seen.sum(axis=1))
        self.stream.rows(self.entities[mesh], times, iteration, columns, rr.Mesh3D.columns(albedo_factor=colours))

    def _show_parts(self, times: np.ndarray, iteration: int, casts: Sequence[Cast]) -> None:
        frames = len(times)
        for name in ("bones", "pads"):
            positions, quaternions, sizes = (np.concatenate([getattr(cast, name)[k] for cast in casts], axis=1) for k in range(3))
            radius, half = sizes[..., 0], sizes[..., 1]
            radius = radius * (BONE_SHARE if name == "bones" else 1.0)
            begin = positions - _z_axes(quaternions) * half[..., None]  # rerun's capsules start at their origin
            count = positions.shape[1]
            each = [count] * frames
            columns = rr.Capsules3D.columns(
                translations=begin.reshape(-1, 3), quaternions=x_first(quaternions).reshape(-1, 4), radii=radius.ravel(),
                lengths=2 * half.ravel()).partition(each)
            self.stream.rows(f"scene/robot/{name}", times, iteration, columns)
        positions, quaternions, sizes = (np.concatenate([cast.boxes[k] for cast in casts], axis=1) for k in range(3))
        self.stream.rows("scene/robot/boxes", times, iteration, rr.Boxes3D.columns(
            centers=positions.reshape(-1, 3), quaternions=x_first(quaternions).reshape(-1, 4),
            half_sizes=sizes.reshape(-1, 3)).partition([positions.shape[1]] * frames))

    def _touches(self, times: np.ndarray, iteration: int, films: Sequence[Film]) -> None:
        origins, vectors, lengths = [], [], []
        for step in range(len(times) - 1):
            points = [film.points[step] + offset for film, offset in zip(films, self.offsets, strict=True) if step < len(film.points)]
            forces = [film.forces[step] for film in films if step < len(film.forces)]
            origins += points
            vectors += forces
            lengths.append(sum(len(point) for point in points))
        arrows = np.concatenate(vectors) * METRES_PER_NEWTON if vectors else np.empty((0, 3))
        size = np.linalg.norm(arrows, axis=1, keepdims=True)
        arrows = arrows * np.minimum(1.0, LONGEST_ARROW / np.maximum(size, 1e-9))
        if len(arrows):
            columns = rr.Arrows3D.columns(origins=np.concatenate(origins), vectors=arrows).partition(lengths)
            self.stream.rows("scene/contacts", times[1:], iteration, columns)


def _triangles(mesh: Mesh) -> rr.Mesh3D:
    return rr.Mesh3D(vertex_positions=mesh.vertices, vertex_normals=mesh.normals, vertex_colors=mesh.colours, triangle_indices=mesh.faces)


def _z_axes(quaternions: np.ndarray) -> np.ndarray:
    """(..., 3) unit vectors from quaternions (..., 4), w first."""
    w, x, y, z = np.moveaxis(quaternions, -1, 0)
    return np.stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)], axis=-1)


def _seen(cast: Cast, users: list[int], robots: np.ndarray, faint: float) -> np.ndarray:
    """(T, n_users): which instances of a mesh are drawn; of two in the same place, as arms that robots share, one."""
    seen = cast.weights[:, robots] > faint
    for later in range(1, len(users)):
        for earlier in range(later):
            if robots[earlier] != robots[later]:
                apart = np.abs(cast.positions[:, users[earlier]] - cast.positions[:, users[later]]).max(axis=1)
                seen[:, later] &= ~(seen[:, earlier] & (apart < 1e-3))
    return seen


def _poses(positions: np.ndarray, quaternions: np.ndarray, lengths: np.ndarray | None = None) -> rr.ComponentColumnList:
    """Instance poses per frame: (T, n, 3) and (T, n, 4), or flat with the number of instances of each frame."""
    if lengths is None:
        lengths = np.full(positions.shape[0], positions.shape[1])
    flat = {"translations": positions.reshape(-1, 3), "quaternions": x_first(quaternions).reshape(-1, 4)}
    return rr.InstancePoses3D.columns(**flat).partition(lengths)


def _held(values: np.ndarray, count: int) -> np.ndarray:
    """The first ``count`` rows; the last one repeated if there are fewer."""
    rows = values[:count]
    return np.concatenate([rows, np.repeat(rows[-1:], count - len(rows), axis=0)]) if len(rows) < count else rows


def _stretched(cast: Cast, count: int) -> Cast:
    triple = lambda part: tuple(_held(array, count) for array in part)  # noqa: E731
    return Cast(_held(cast.positions, count), _held(cast.quaternions, count), _held(cast.weights, count), triple(cast.bones),
                triple(cast.pads), triple(cast.boxes), _held(cast.carried, count))

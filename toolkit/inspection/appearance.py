"""What robots look like: the visual meshes of the unmodified robots, link by link, hung on the merged robot's links; any geom as a mesh.

A link that fades in or out has its anchor where some other robot's joint is, and its collision geoms within the finger that is
there: the meshes go with the geoms. Physics never sees them. A link's meshes and primitives become one triangle mesh, simplified
to a grid; two links that look alike (arms that robots share, left and right jaws) share one mesh.
"""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np

from toolkit.morphology.matching import System
from toolkit.morphology.native_scene import ARM_PREFIX, plain_name
from toolkit.morphology.space import EvolutionSpace

GRID = 0.002
"""Cell [m] to which vertices are gathered: below what a screen shows of a whole robot."""
ROUND = 24
"""Corners of a circle when a primitive becomes triangles."""
PARTS = (ARM_PREFIX, "gripper0_")
"""Prefixes of robosuite's names of what belongs to a robot; its pedestal stays out of the way."""


@dataclass(frozen=True, eq=False)
class Mesh:
    """Triangles in some link's frame.

    Attributes:
        name: of the link that first had it.
        vertices: (n, 3) [m].  normals: (n, 3), unit.  colours: (n, 4) 0 to 255.  faces: (m, 3) indices.
        digest: equal for meshes that look alike.
    """

    name: str
    vertices: np.ndarray
    normals: np.ndarray
    colours: np.ndarray
    faces: np.ndarray
    digest: bytes


@dataclass(frozen=True, eq=False)
class Instance:
    """One link of one robot as the merged robot wears it.

    Attributes:
        robot: index in the matching.  mesh: index in the appearance's meshes.
        body: id in the robot's own scene.  slot: index of the link that carries it, -1 for the world.
        position: (3,) [m] and quaternion: (4,) w first, of the mesh in that slot's frame.
        shapes: indices of the space's shape slots that the robot has on that link.  centre: (3,) [m], their mean in the slot's frame.
    """

    robot: int
    mesh: int
    body: int
    slot: int
    position: np.ndarray
    quaternion: np.ndarray
    shapes: tuple[int, ...]
    centre: np.ndarray


class Appearance:
    """The meshes of all robots of a space, each once, and where they hang.

    Args:
        space: of the merged robot.

    Attributes:
        meshes: without repetition.
        instances: every link of every robot.
    """

    def __init__(self, space: EvolutionSpace) -> None:
        matching = space.matching
        self.meshes: list[Mesh] = []
        self.instances: list[Instance] = []
        known: dict[bytes, int] = {}
        for index, system in enumerate(matching.systems):
            for body, mesh in link_meshes(system.model).items():
                if mesh.digest not in known:
                    known[mesh.digest] = len(self.meshes)
                    self.meshes.append(mesh)
                self.instances.append(_instance(index, system, space, known[mesh.digest], body))

    def poses(
        self, model: mujoco.MjModel, data: mujoco.MjData, links: Sequence[int], shapes: Sequence[int]
    ) -> tuple[np.ndarray, np.ndarray]:
        """World positions (n_instances, 3) [m] and quaternions (n_instances, 4) of all instances on a merged robot.

        Args:
            model, data: the merged robot, body frames computed.
            links: body ids (n_slots,) of its slots.  shapes: geom ids (n_shapes,) of its shape slots.
        """
        shape_positions = model.geom_pos[shapes]
        positions, quaternions = np.empty((len(self.instances), 3)), np.empty((len(self.instances), 4))
        for k, item in enumerate(self.instances):
            body = links[item.slot] if item.slot >= 0 else 0
            moved = shape_positions[list(item.shapes)].mean(axis=0) - item.centre if item.shapes else 0.0
            mujoco.mju_rotVecQuat(positions[k], item.position + moved, data.xquat[body])
            positions[k] += data.xpos[body]
            mujoco.mju_mulQuat(quaternions[k], data.xquat[body], item.quaternion)
        return positions, quaternions


def weights(alpha: np.ndarray, betas: np.ndarray) -> np.ndarray:
    """How much of each robot shows at ``alpha`` (D,): (n_robots,) in [0, 1], 1 at the robot itself.

    Args:
        alpha: the robot in between.
        betas: (n_robots, D), the source first.
    """
    spans = np.abs(betas[1:] - betas[0]).sum(axis=1)
    shares = 1.0 - np.abs(betas[1:] - alpha).sum(axis=1) / spans
    shares = np.clip(shares, 0.0, 1.0)
    return np.array([1.0 - shares.max(), *shares])


def _instance(index: int, system: System, space: EvolutionSpace, mesh: int, body: int) -> Instance:
    data = mujoco.MjData(system.model)
    data.qpos[:] = system.start
    mujoco.mj_kinematics(system.model, data)
    slot = _slot_of(system, body)
    # At the start posture a slot's frame has world axes and stands at its anchor.
    joint = system.joints[slot] if slot >= 0 else None
    anchor = np.zeros(3) if joint is None else joint.screw.anchor
    own = {k: shape.owners[index] for k, shape in enumerate(space.shape_slots) if shape.slot == slot}
    centres = {k: owner.position - anchor for k, owner in own.items() if owner is not None}
    centre = np.mean(list(centres.values()), axis=0) if centres else np.zeros(3)
    position, quaternion = np.array(data.xpos[body]) - anchor, np.array(data.xquat[body])
    return Instance(index, mesh, body, slot, position, quaternion, tuple(centres), centre)


def _slot_of(system: System, body: int) -> int:
    """The slot whose joint carries a body; -1: fixed to the world. A gripper's fixed parts ride on the flange."""
    slots = {joint.mujoco_joint: slot for slot, joint in enumerate(system.joints) if joint is not None and joint.mujoco_joint >= 0}
    while body > 0:
        joint = int(system.model.body_jntadr[body])
        if joint in slots:
            return slots[joint]
        body = int(system.model.body_parentid[body])
    return -1


def link_meshes(model: mujoco.MjModel) -> dict[int, Mesh]:
    """Body id -> the look of a robosuite robot's link, bodies fixed to one another taken as one.

    Args:
        model: a robosuite scene.
    """
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    geoms: dict[int, list[int]] = {}
    for geom in range(model.ngeom):
        body = int(model.geom_bodyid[geom])
        if model.geom_group[geom] == 1 and model.body(body).name.startswith(PARTS) and geom_colour(model, geom)[3] > 0:
            geoms.setdefault(int(model.body_weldid[body]), []).append(geom)
    return {body: _gathered(model, data, body, own) for body, own in geoms.items()}


def body_mesh(model: mujoco.MjModel, body: int, largest: float = np.inf) -> Mesh | None:
    """The look of one body: its visual geoms (group 1) or, where it has none, those of group 0; None if nothing shows.

    Args:
        model, body: any.
        largest: bounding radius [m] from which on a geom is the wall of a room, and left out.
    """
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    solid = [geom for geom in range(model.ngeom) if model.geom_bodyid[geom] == body and model.geom_group[geom] <= 1
             and model.geom_type[geom] != mujoco.mjtGeom.mjGEOM_PLANE and model.geom_rbound[geom] < largest]
    chosen = [geom for geom in solid if model.geom_group[geom] == 1] or solid
    return _gathered(model, data, body, chosen) if chosen else None


def geom_mesh(model: mujoco.MjModel, geom: int) -> Mesh:
    """The look of one geom of any solid kind, in its own frame."""
    points, triangles = simplified(*geom_triangles(model, geom))
    name = model.geom(geom).name or f"{model.body(model.geom_bodyid[geom]).name}-{geom}"
    return _painted(name, points, triangles, np.tile(geom_colour(model, geom), (len(points), 1)))


def _gathered(model: mujoco.MjModel, data: mujoco.MjData, body: int, geoms: list[int]) -> Mesh:
    """One mesh, in the body's frame, of several geoms."""
    vertices, colours, faces, count = [], [], [], 0
    inverse = data.xmat[body].reshape(3, 3).T
    for geom in geoms:
        points, triangles = geom_triangles(model, geom)
        points = points @ data.geom_xmat[geom].reshape(3, 3).T + data.geom_xpos[geom]
        points, triangles = simplified((points - data.xpos[body]) @ inverse.T, triangles)
        vertices.append(points)
        colours.append(np.tile(geom_colour(model, geom), (len(points), 1)))
        faces.append(triangles + count)
        count += len(points)
    name = plain_name(model.body(body).name) if body else "base"
    return _painted(name, np.concatenate(vertices), np.concatenate(faces), np.concatenate(colours))


def _painted(name: str, vertices: np.ndarray, faces: np.ndarray, colours: np.ndarray) -> Mesh:
    points, triangles = vertices.astype(np.float32), faces.astype(np.uint32)
    digest = hashlib.sha256(np.round(points, 5).tobytes() + triangles.tobytes() + colours.tobytes()).digest()
    return Mesh(name, points, vertex_normals(points, triangles), colours, triangles, digest)


def simplified(vertices: np.ndarray, faces: np.ndarray, grid: float = GRID) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (n, 3) [m] gathered into grid cells, each cell's mean one vertex; faces (m, 3) that vanish are dropped.

    Of a cell's vertices only those come together whose normals point the same way, of six: the two walls of a thin shell stay two, where
    they would else meet in specks. Meshes of fewer than a thousand faces stay as they are (Rossignac and Borrel 1993, vertex clustering).
    """
    if len(faces) < 1000:
        return vertices, faces
    cells = np.floor((vertices - vertices.min(axis=0)) / grid).astype(np.int64)
    normals = vertex_normals(vertices, faces)
    axes = np.abs(normals).argmax(axis=1)
    sides = 2 * axes + (np.take_along_axis(normals, axes[:, None], axis=1)[:, 0] > 0)
    keys = 6 * ((cells[:, 0] << 40) + (cells[:, 1] << 20) + cells[:, 2]) + sides
    _, index, counts = np.unique(keys, return_inverse=True, return_counts=True)
    means = np.stack([np.bincount(index, weights=vertices[:, k]) for k in range(3)], axis=1) / counts[:, None]
    faces = index[faces]
    whole = (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])
    return means, faces[whole]


def vertex_normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Unit normals (n, 3) of vertices (n, 3), the mean of their faces' (m, 3), larger faces counting more."""
    corners = vertices[faces]
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals = np.zeros((len(vertices), 3))
    for k in range(3):
        for axis in range(3):
            normals[:, axis] += np.bincount(faces[:, k], weights=across[:, axis], minlength=len(vertices))
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    return np.where(length > 0, normals / np.maximum(length, 1e-12), (0.0, 0.0, 1.0)).astype(np.float32)


def geom_triangles(model: mujoco.MjModel, geom: int) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (n, 3) [m] in the geom's frame and faces (m, 3) of a geom of any solid kind; of others, nothing."""
    kind, size = int(model.geom_type[geom]), model.geom_size[geom]
    if kind == mujoco.mjtGeom.mjGEOM_MESH:
        mesh = int(model.geom_dataid[geom])
        start, count = model.mesh_vertadr[mesh], model.mesh_vertnum[mesh]
        first, number = model.mesh_faceadr[mesh], model.mesh_facenum[mesh]
        return model.mesh_vert[start : start + count].astype(float), model.mesh_face[first : first + number]
    if kind == mujoco.mjtGeom.mjGEOM_BOX:
        return _box(size)
    if kind in (mujoco.mjtGeom.mjGEOM_SPHERE, mujoco.mjtGeom.mjGEOM_ELLIPSOID):
        radii = np.full(3, size[0]) if kind == mujoco.mjtGeom.mjGEOM_SPHERE else size
        angles = np.linspace(0, np.pi, ROUND // 2 + 1)
        return _turned(np.stack([np.sin(angles), np.cos(angles)], axis=1), radii)
    if kind == mujoco.mjtGeom.mjGEOM_CAPSULE:
        angles = np.linspace(0, np.pi / 2, ROUND // 4 + 1)
        top = np.stack([np.sin(angles), np.cos(angles) + size[1] / size[0]], axis=1)
        return _turned(np.concatenate([top, top[::-1] * (1, -1)]), np.full(3, size[0]))
    if kind == mujoco.mjtGeom.mjGEOM_CYLINDER:
        profile = np.array([(0, size[1]), (size[0], size[1]), (size[0], size[1]), (size[0], -size[1]), (size[0], -size[1]), (0, -size[1])])
        return _turned(profile, np.ones(3))
    return np.zeros((0, 3)), np.zeros((0, 3), int)


def _box(half: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A box with four vertices per side, so that its edges stay sharp."""
    vertices: list[np.ndarray] = []
    faces: list[tuple[int, int, int]] = []
    for axis in range(3):
        for side in (-1.0, 1.0):
            corners = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)], float)
            points = np.insert(corners, axis, side, axis=1) * half
            outward = np.cross(points[1] - points[0], points[2] - points[0])[axis] * side > 0
            order = (0, 1, 2, 3) if outward else (0, 3, 2, 1)
            base = len(vertices) * 4
            vertices.append(points[list(order)])
            faces += [(base, base + 1, base + 2), (base, base + 2, base + 3)]
    return np.concatenate(vertices), np.array(faces)


def _turned(profile: np.ndarray, radii: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A profile (k, 2) of radius and height, top first, turned about z and stretched by radii (3,)."""
    turns = np.linspace(0, 2 * np.pi, ROUND, endpoint=False)
    rings = [np.stack([r * np.cos(turns), r * np.sin(turns), np.full(ROUND, z)], axis=1) for r, z in profile]
    faces = []
    for ring in range(len(profile) - 1):
        for k in range(ROUND):
            a, b = ring * ROUND + k, ring * ROUND + (k + 1) % ROUND
            faces += [(a, a + ROUND, b), (b, a + ROUND, b + ROUND)]
    return np.concatenate(rings) * radii, np.array(faces)


def geom_colour(model: mujoco.MjModel, geom: int) -> np.ndarray:
    """(4,) 0 to 255: MuJoCo's rule (a geom's colour wins over its material's unless left at grey), textures averaged."""
    rgba, material = model.geom_rgba[geom].copy(), model.geom_matid[geom]
    if material >= 0:
        if np.array_equal(rgba, np.array([0.5, 0.5, 0.5, 1.0], np.float32)):
            rgba = model.mat_rgba[material].copy()
        texture = model.mat_texid[material, mujoco.mjtTextureRole.mjTEXROLE_RGB]
        if texture >= 0 and model.tex_nchannel[texture] >= 3:
            channels, start = model.tex_nchannel[texture], model.tex_adr[texture]
            texels = model.tex_data[start : start + model.tex_width[texture] * model.tex_height[texture] * channels]
            rgba[:3] *= texels.reshape(-1, channels)[::97, :3].mean(axis=0) / 255  # a sample of the texels is plenty
    return np.round(255 * np.clip(rgba, 0, 1)).astype(np.uint8)

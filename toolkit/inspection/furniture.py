"""What stands around robots: robosuite's pedestal and table, of which physics knows the top alone; walls, floors; what fades into what."""

import mujoco
import numpy as np

from toolkit.inspection.appearance import Mesh, body_mesh, geom_colour, geom_mesh

SEEN = 0.4
"""Share of the largest weight from which on a robot shows at all."""
FLOOR = 0.7
"""Half width of a floor, in diagonals of the scene that stands on it."""
STANDING = ("table", "fixed_mount0_", "mount0_")
"""Beginnings of robosuite's names of bodies that are furniture."""


def furniture(model: mujoco.MjModel) -> list[Mesh]:
    """Table and pedestal as meshes in the world's frame [m].

    Args:
        model: a robosuite scene of a robot at a table.
    """
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    found = []
    for body in range(model.nbody):
        seen = model.geom_group[model.geom_bodyid == body] == 1  # the others are what the pedestal is to collisions
        if model.body(body).name.startswith(STANDING) and seen.any():
            mesh, turn = body_mesh(model, body), data.xmat[body].reshape(3, 3)
            if mesh is None:
                continue
            vertices = (mesh.vertices @ turn.T + data.xpos[body]).astype(np.float32)
            normals = (mesh.normals @ turn.T).astype(np.float32)
            found.append(Mesh(model.body(body).name, vertices, normals, mesh.colours, mesh.faces, mesh.digest))
    return found


def world_meshes(model: mujoco.MjModel, low: np.ndarray, high: np.ndarray) -> list[Mesh]:
    """What a scene has fixed to its world, as meshes in the world's frame [m]; a plane as far as it lies under the scene.

    Args:
        model: any.
        low, high: (3,) [m] least and greatest corner of the scene.
    """
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    found = []
    for geom in map(int, np.flatnonzero(model.geom_bodyid == 0)):
        if model.geom_group[geom] > 2 or geom_colour(model, geom)[3] == 0:  # as of mjv_defaultOption
            continue
        turn, place = data.geom_xmat[geom].reshape(3, 3), data.geom_xpos[geom]
        if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_PLANE:
            found.append(_plane(model, geom, (low + high) / 2, FLOOR * float(np.linalg.norm(high - low))))
        else:
            mesh = geom_mesh(model, geom)
            vertices, normals = mesh.vertices @ turn.T + place, mesh.normals @ turn.T
            found.append(Mesh(mesh.name, vertices.astype(np.float32), normals.astype(np.float32), mesh.colours, mesh.faces, mesh.digest))
    return found


def _plane(model: mujoco.MjModel, geom: int, middle: np.ndarray, reach: float) -> Mesh:
    """A plane as a square about the foot of a point (3,), no further than ``reach`` [m], nor than the plane itself."""
    place, flat = np.array(model.geom_pos[geom]), np.empty(9)
    mujoco.mju_quat2Mat(flat, model.geom_quat[geom])
    turn = flat.reshape(3, 3)
    half = np.where(model.geom_size[geom, :2] > 0, model.geom_size[geom, :2], np.inf)
    foot = ((middle - place) @ turn)[:2]
    low, high = np.maximum(foot - reach, -half), np.minimum(foot + reach, half)
    corners = np.array([(x, y, 0.0) for x, y in ((low[0], low[1]), (high[0], low[1]), (high[0], high[1]), (low[0], high[1]))])
    vertices, normals = corners @ turn.T + place, np.tile(turn[:, 2], (4, 1))
    paint = np.tile(geom_colour(model, geom), (4, 1))
    faces = np.array([(0, 1, 2), (0, 2, 3)], np.uint32)
    return Mesh(f"plane-{geom}", vertices.astype(np.float32), normals.astype(np.float32), paint, faces, vertices.tobytes())


def opacity(weight: np.ndarray, most: np.ndarray) -> np.ndarray:
    """How opaque a robot is drawn: the one that shows most is solid, one that shows little is not there, so that nothing is a ghost.

    Args:
        weight: how much it shows, in [0, 1]; of what several robots share, all of them together.
        most: weight of the robot that shows most.
    """
    return np.clip((weight / np.maximum(most, 1e-9) - SEEN) / (1.0 - SEEN), 0.0, 1.0)

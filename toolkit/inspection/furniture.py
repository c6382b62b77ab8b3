"""How a robot is shown in its task: robosuite's pedestal and table, of which physics knows the top alone, and what fades into what."""

import mujoco
import numpy as np

from toolkit.inspection.appearance import Mesh, body_mesh

SEEN = 0.4
"""Share of the largest weight from which on a robot shows at all."""
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
            vertices = (mesh.vertices @ turn.T + data.xpos[body]).astype(np.float32)
            normals = (mesh.normals @ turn.T).astype(np.float32)
            found.append(Mesh(model.body(body).name, vertices, normals, mesh.colours, mesh.faces, mesh.digest))
    return found


def opacity(weight: np.ndarray, most: np.ndarray) -> np.ndarray:
    """How opaque a robot is drawn: the one that shows most is solid, one that shows little is not there, so that nothing is a ghost.

    Args:
        weight: how much it shows, in [0, 1]; of what several robots share, all of them together.
        most: weight of the robot that shows most.
    """
    return np.clip((weight / np.maximum(most, 1e-9) - SEEN) / (1.0 - SEEN), 0.0, 1.0)

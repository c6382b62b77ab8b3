"""The table and what is picked from it, as parts of a MuJoCo scene around a robot; robosuite's own are in tasks/env.py."""

from collections.abc import Sequence

import mujoco
import numpy as np

from tasks.objects import PickObject

TABLE_TOP = 0.8
"""Height [m] of the table's surface above the floor: robosuite's table arena."""
TABLE_FULL_SIZE = (0.8, 0.8, 0.05)
"""[m]: robosuite's table arena."""
TABLE_FRICTION = (1.0, 0.005, 0.0001)
"""Sliding, spinning and rolling friction: robosuite's table arena."""
OBJECT_SOLREF = (0.02, 1.0)
"""Contact time constant [s] and damping ratio: MuJoCo's defaults."""
OBJECT_MARGIN = {"box": 0.0, "cylinder": 0.001}
"""Contact margin [m] by shape: robosuite's BoxObject and CylinderObject."""
HAND_BIT, OBJECT_BIT = 2, 1
"""Contact bits: the hand touches object and table, object and table touch each other, the hand never itself."""


def add_table(spec: mujoco.MjSpec) -> None:
    """Add the table, like robosuite's table arena, and a light."""
    half = np.array(TABLE_FULL_SIZE) / 2
    spec.worldbody.add_geom(
        name="table", type=mujoco.mjtGeom.mjGEOM_BOX, size=half, pos=[0, 0, TABLE_TOP - half[2]],
        friction=TABLE_FRICTION, contype=OBJECT_BIT, conaffinity=OBJECT_BIT | HAND_BIT, group=1,
        rgba=[0.75, 0.72, 0.68, 1],
    )
    spec.worldbody.add_light(pos=[0.5, -0.5, 2.5], dir=[-0.2, 0.2, -1])


def add_object(spec: mujoco.MjSpec, item: PickObject, position: Sequence[float]) -> None:
    """Add what is picked: body, free joint and geom named "object", at a position (3,) [m]."""
    body = spec.worldbody.add_body(name="object", pos=position)
    body.add_freejoint(name="object")
    kind = mujoco.mjtGeom.mjGEOM_BOX if item.shape == "box" else mujoco.mjtGeom.mjGEOM_CYLINDER
    size = [*item.half_size, *([0.0] * (3 - len(item.half_size)))]
    body.add_geom(
        name="object", type=kind, size=size, density=item.mass / item.volume, friction=item.friction,
        solref=OBJECT_SOLREF, margin=OBJECT_MARGIN[item.shape], contype=OBJECT_BIT,
        conaffinity=OBJECT_BIT | HAND_BIT, group=1, rgba=[0.8, 0.25, 0.2, 1],
    )

"""The table and what is picked from it, as parts of a MuJoCo scene around a robot; robosuite's own are in tasks/env.py."""

import mujoco
import numpy as np

from tasks.objects import PickObject
from tasks.pick import OBJECT_MARGIN, OBJECT_SOLREF, OBJECT_XY, TABLE_FRICTION, TABLE_FULL_SIZE, TABLE_TOP

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


def add_object(spec: mujoco.MjSpec, item: PickObject) -> None:
    """Add what is picked: body, free joint and geom named "object", at its nominal start."""
    body = spec.worldbody.add_body(name="object", pos=[*OBJECT_XY, TABLE_TOP + item.half_height])
    body.add_freejoint(name="object")
    kind = mujoco.mjtGeom.mjGEOM_BOX if item.shape == "box" else mujoco.mjtGeom.mjGEOM_CYLINDER
    size = [*item.half_size, *([0.0] * (3 - len(item.half_size)))]
    body.add_geom(
        name="object", type=kind, size=size, density=item.mass / item.volume, friction=item.friction,
        solref=OBJECT_SOLREF, margin=OBJECT_MARGIN[item.shape], contype=OBJECT_BIT,
        conaffinity=OBJECT_BIT | HAND_BIT, group=1, rgba=[0.8, 0.25, 0.2, 1],
    )

"""Objects: how far a point is from one, and what no object can be."""

import mujoco
import numpy as np
import pytest

from tasks.objects import OBJECTS, PickObject


@pytest.mark.parametrize("name", ["061_foam_brick", "005_tomato_soup_can"])
def test_the_distance_from_an_object_is_mujocos(name):
    """Of a speck outside it; inside, no point of the surface is nearer, and one is as near."""
    item, speck = OBJECTS[name], 1e-6
    kind = "box" if item.shape == "box" else "cylinder"
    size = " ".join(map(str, item.half_size))
    model = mujoco.MjModel.from_xml_string(
        f'<mujoco><worldbody><geom name="a" type="{kind}" size="{size}"/><body mocap="true"><geom name="b" size="{speck}"/></body>'
        "</worldbody></mujoco>"
    )
    data, rng = mujoco.MjData(model), np.random.default_rng(0)
    points = rng.uniform(-0.1, 0.1, (400, 3))
    found = item.distance(points)
    assert (found > 0).any() and (found < 0).any()
    grid = np.stack(np.meshgrid(*[np.linspace(-0.06, 0.06, 61)] * 3), axis=-1).reshape(-1, 3)
    outer = grid[item.distance(grid) > 0]
    for point, distance in zip(points, found, strict=True):
        if distance > 0:
            data.mocap_pos[0] = point
            mujoco.mj_forward(model, data)
            assert distance == pytest.approx(mujoco.mj_geomDistance(model, data, 0, 1, 1.0, None) + speck, abs=1e-5)
        else:
            nearest = np.linalg.norm(outer - point, axis=1).min()
            assert nearest - 0.004 < -distance <= nearest, f"{point} is {distance} deep, the nearest point outside is {nearest} away"


@pytest.mark.parametrize(
    "shape, half_size, mass",
    [("sphere", (0.1,), 0.1), ("box", (0.1, 0.1), 0.1), ("cylinder", (0.1, -0.1), 0.1), ("box", (0.1, 0.1, 0.1), 0.0)],
)
def test_an_impossible_object_is_refused(shape, half_size, mass):
    with pytest.raises(ValueError, match="object thing: bad shape"):
        PickObject("thing", shape, half_size, mass)


@pytest.mark.parametrize("friction", [(0.2, 0.001), (0.2, -0.001, 0.0)])
def test_an_impossible_friction_is_refused(friction):
    with pytest.raises(ValueError, match="object thing: bad friction"):
        PickObject("thing", "box", (0.1, 0.1, 0.1), 0.1, friction)

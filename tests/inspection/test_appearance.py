"""The meshes of the unmodified robots on a merged one: whole on the way, and each robot's own at its own parameters."""

import mujoco
import numpy as np
import pytest
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from toolkit.inspection.appearance import GRID, ROUND, geom_triangles, simplified
from toolkit.inspection.visual import ArmVisual


@pytest.fixture(scope="module")
def visual(pair):
    return ArmVisual(pair.merged)


def drawn(visual, motion, frame, instance):
    """Vertices (n, 3) [m] of an instance's mesh where it is drawn."""
    turn = Rotation.from_quat(motion.quaternions[frame, instance], scalar_first=True)
    return turn.apply(visual.meshes[visual.instances[instance, 0]].vertices) + motion.positions[frame, instance]


@pytest.mark.parametrize("share", [0.0, 0.25, 0.45, 0.6, 0.9])
def test_the_thumbs_tip_stays_at_its_middle_link(pair, visual, share):
    """Its anchor goes to where the jaw's joint is, centimetres from the hand's thumb; what touches does not, nor what is drawn."""
    source, target = pair.space.betas
    motion = visual.standing([source + share * (target - source)])
    names = [visual.meshes[mesh].name for mesh, robot in visual.instances if robot == 0]
    middle, tip = (drawn(visual, motion, 0, names.index(link)) for link in ("thmiddle", "thdistal"))
    assert cKDTree(middle).query(tip)[0].min() < 0.006


def test_at_its_own_parameters_a_robot_looks_as_its_own_scene_has_it(pair, visual):
    for robot, (beta, system) in enumerate(zip(pair.space.betas, pair.space.matching.systems, strict=True)):
        motion = visual.standing([beta])
        data = mujoco.MjData(system.model)
        data.qpos[:] = system.start
        mujoco.mj_kinematics(system.model, data)
        own = [k for k, item in enumerate(visual.appearance.instances) if item.robot == robot]
        bodies = [visual.appearance.instances[k].body for k in own]
        assert any(visual.appearance.instances[k].shapes for k in own)
        np.testing.assert_allclose(motion.positions[0, own], data.xpos[bodies], atol=1e-9)


def test_the_walls_of_a_thin_shell_stay_two():
    """A sphere with a hollow that leaves it a wall of a millimetre: a cell of the grid holds both sides."""
    outside = sphere(0.05)
    hollow = outside[0] * 0.98, outside[1][:, ::-1] + len(outside[0])
    vertices, faces = np.concatenate([outside[0], hollow[0]]), np.concatenate([outside[1], hollow[1]])
    kept, left = simplified(vertices, faces)
    assert len(left) < 0.7 * len(faces) and GRID > 0.001
    radii = np.linalg.norm(kept, axis=1)
    assert ((radii < 0.0493) | (radii > 0.0497)).all(), "no vertex lies between the walls"


def sphere(radius):
    """Vertices (n, 3) [m] and faces (m, 3) of a sphere, a tenth of a cell apart at its poles and a cell at its equator."""
    up, around = np.linspace(0.02, np.pi - 0.02, 90), np.linspace(0, 2 * np.pi, 180, endpoint=False)
    theta, phi = np.meshgrid(up, around, indexing="ij")
    points = radius * np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], axis=-1).reshape(-1, 3)
    a = (np.arange(89)[:, None] * 180 + np.arange(180)).ravel()
    b = (np.arange(89)[:, None] * 180 + (np.arange(180) + 1) % 180).ravel()
    return points, np.concatenate([np.stack([a, a + 180, b], axis=1), np.stack([b, a + 180, b + 180], axis=1)])


def test_meshes_are_simplified_within_their_grid():
    generator = np.random.default_rng(0)
    directions = generator.normal(size=(3000, 3))
    points = 0.1 * directions / np.linalg.norm(directions, axis=1, keepdims=True)
    from scipy.spatial import ConvexHull

    faces = ConvexHull(points).simplices
    vertices, kept = simplified(points, faces, grid=0.01)
    assert len(kept) < 0.75 * len(faces)
    assert np.abs(np.linalg.norm(vertices, axis=1) - 0.1).max() < 0.01
    few = simplified(points, faces[:10])
    assert few[0] is points, "a small mesh stays as it is"


def test_primitives_become_closed_surfaces():
    kinds = {"box": ([0.1, 0.2, 0.3], 8 * 0.006), "sphere": ([0.1, 0, 0], 4 / 3 * np.pi * 1e-3),
             "capsule": ([0.1, 0.2, 0], np.pi * 0.01 * 0.4 + 4 / 3 * np.pi * 1e-3), "cylinder": ([0.1, 0.2, 0], np.pi * 0.01 * 0.4),
             "ellipsoid": ([0.1, 0.2, 0.3], 4 / 3 * np.pi * 0.006)}
    spec = mujoco.MjSpec()
    for name, (size, _) in kinds.items():
        spec.worldbody.add_geom(name=name, type=getattr(mujoco.mjtGeom, f"mjGEOM_{name.upper()}"), size=size)
    model = spec.compile()
    for name, (_, volume) in kinds.items():
        vertices, faces = geom_triangles(model, model.geom(name).id)
        a, b, c = vertices[faces].transpose(1, 0, 2)
        measured = np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6  # divergence theorem; positive if faces look outwards
        assert measured == pytest.approx(volume, rel=12 / ROUND**2 * 3), name

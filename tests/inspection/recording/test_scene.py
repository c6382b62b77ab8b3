"""Robots in 3-D: each mesh once, every link where MuJoCo has it, one robot fading into the other."""

import mujoco
import numpy as np
import pytest
from rerun_rows import entities, film_of, seconds
from scipy.spatial.transform import Rotation

from toolkit.inspection.recording.scene import Scene
from toolkit.inspection.recording.stream import Stream
from toolkit.inspection.visual import visual_of
from toolkit.learning.policy import MeanActor
from toolkit.simulation.laws import merged_plant


def test_no_mesh_twice(rows, small):
    meshes = {path: [row["Mesh3D:vertex_positions"] for row in own if "Mesh3D:vertex_positions" in row] for path, own in rows.items()}
    meshes = {path: own for path, own in meshes.items() if own}
    assert len(meshes) > 20 and all(len(own) == 1 for own in meshes.values()), "each mesh is logged once"
    shapes = [np.array(own[0]).tobytes() for own in meshes.values()]
    assert len(set(shapes)) == len(shapes), "no two entities hold the same mesh"


def test_the_native_robots_links_stand_where_mujoco_says(rows, small, policy, stored):
    """The last film is on the unmodified Jaco: instances of its meshes against mj_kinematics, to 1e-5."""
    from toolkit.inspection.trajectory import replay

    film = replay(stored.native("jaco"), MeanActor(policy), 11, small.space.betas[1])
    model, data = film.model, mujoco.MjData(film.model)
    body = model.body("robot0_j2s7s300_link_4").id
    (entity,) = [path for path in rows if path.endswith("/j2s7s300_link_4")]
    poses = sorted((row for row in rows[entity] if "InstancePoses3D:translations" in row), key=seconds)[-len(film.qpos) :]
    assert len(poses) == len(film.qpos)
    for row, qpos in list(zip(poses, film.qpos, strict=True))[::5]:
        data.qpos[:] = qpos
        mujoco.mj_kinematics(model, data)
        np.testing.assert_allclose(row["InstancePoses3D:translations"], [data.xpos[body]], atol=1e-5)
        seen = Rotation.from_quat(row["InstancePoses3D:quaternions"][0])
        true = Rotation.from_quat(data.xquat[body], scalar_first=True)
        assert (seen * true.inv()).magnitude() < 1e-5
    steps = np.diff([seconds(row) for row in poses])
    np.testing.assert_allclose(steps, film.interval, atol=2e-6)


def test_the_merged_robots_bones_stand_where_mujoco_says(tmp_path, small):
    visual = visual_of(small.merged)
    alphas = small.space.betas[0] + np.linspace(0, 1, 4)[:, None] * (small.space.betas[1] - small.space.betas[0])
    stream = Stream(tmp_path / "a.rrd")
    Scene(stream, visual).show(np.arange(4.0), 0, [visual.standing(alphas)])
    stream.close()
    bones = sorted((row for row in entities(tmp_path / "a.rrd")["/scene/robot/bones"] if "film" in row), key=seconds)
    model, data = small.merged.new()
    geoms = [model.geom(f"{slot.name}/bone").id for slot in small.space.matching.slots]
    for row, alpha in zip(bones, alphas, strict=True):
        small.merged.become(alpha, model, data)
        mujoco.mj_kinematics(model, data)
        length = np.array(row["Capsules3D:lengths"])
        axes = Rotation.from_quat(row["Capsules3D:quaternions"]).apply([0, 0, 1.0])
        middles = np.array(row["Capsules3D:translations"]) + 0.5 * length[:, None] * axes
        np.testing.assert_allclose(middles, data.geom_xpos[geoms], atol=1e-5)
        np.testing.assert_allclose(length, 2 * model.geom_size[geoms, 1], atol=1e-5)


def test_one_robot_fades_into_the_other(rows):
    """On its way the source's hand loses opacity and the target's gains it, between 0 and 255."""
    opacity = lambda row: row["Mesh3D:albedo_factor"][0] & 0xFF  # noqa: E731
    (gripper,) = [path for path in rows if path.endswith("/j2s7s300_link_7")]
    (hand,) = [path for path in rows if path.endswith("/thmiddle")]
    rising = [opacity(row) for row in sorted((r for r in rows[gripper] if "film" in r), key=seconds) if row["InstancePoses3D:translations"]]
    falling = [opacity(row) for row in sorted((r for r in rows[hand] if "film" in r), key=seconds) if row["InstancePoses3D:translations"]]
    assert rising[-1] == 255 and min(rising) < 30
    assert falling[0] == 255 and min(falling) < 30


def begun(lab, alpha):
    """F(alpha) where the episode of seed 0 begins, by the plant that plays it."""
    plant = merged_plant(lab.merged, alpha, *lab.merged.new())
    plant.begin(0)
    mujoco.mj_kinematics(plant.model, plant.data)
    return plant.model, plant.data


def test_capsules_stand_where_mujoco_says_and_grow_with_the_robot(tmp_path, crawlers):
    visual = visual_of(crawlers.merged)
    source, long = crawlers.space.betas[:2]
    alphas = source + np.linspace(0, 1, 4)[:, None] * (long - source)
    stream = Stream(tmp_path / "a.rrd")
    Scene(stream, visual).show(np.arange(4.0), 0, [visual.standing(alphas)])
    stream.close()
    told = film_of(tmp_path / "a.rrd")
    assert set(told) == {"/scene/robot/capsules"}, "no goal, no trail, no contacts, no object"
    for row, alpha in zip(told["/scene/robot/capsules"], alphas, strict=True):
        model, data = begun(crawlers, alpha)
        moving = np.flatnonzero(model.geom_bodyid > 0)
        length, turned = np.array(row["Capsules3D:lengths"]), Rotation.from_quat(row["Capsules3D:quaternions"])
        middles = np.array(row["Capsules3D:translations"]) + 0.5 * length[:, None] * turned.apply([0, 0, 1.0])
        np.testing.assert_allclose(middles, data.geom_xpos[moving], atol=1e-5)
        np.testing.assert_allclose(length, 2 * model.geom_size[moving, 1], atol=1e-5)
        np.testing.assert_allclose(row["Capsules3D:radii"], model.geom_size[moving, 0], atol=1e-6)
    grown = [np.array(row["Capsules3D:lengths"])[0] for row in told["/scene/robot/capsules"]]
    assert grown[0] < 1e-6 and grown[-1] == pytest.approx(0.4), "a ball has become a capsule"

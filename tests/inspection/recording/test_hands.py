"""Recordings of hands: bones and object as recorded, both robots where MuJoCo has them, one clip after the other."""

import mujoco
import numpy as np
import pytest
from rerun_rows import film_of, seconds

from tasks.objects import OBJECTS
from toolkit.inspection.recording.hands import BONES, PAUSE, Clip, record_clips

FRAMES, STEPS, FRAME_DT, CONTROL_DT = 6, 9, 0.04, 0.05


def swing(name, length):
    """A pendulum whose one body is a capsule, in a room whose wall is not to be drawn."""
    spec = mujoco.MjSpec()
    spec.worldbody.add_geom(name="wall", type=mujoco.mjtGeom.mjGEOM_BOX, size=[3, 0.1, 3], pos=[0, 5, 0])
    body = spec.worldbody.add_body(name=name, pos=[0, 0, 1])
    body.add_joint(name="swing", axis=[0, 1, 0])
    body.add_geom(type=mujoco.mjtGeom.mjGEOM_CAPSULE, fromto=[0, 0, 0, 0, 0, -length], size=[0.02, 0, 0])
    return spec.compile()


def clip(name, item):
    """Without a hand in its first frame, without an object in its last one."""
    rng = np.random.default_rng(0)
    joints, poses = rng.normal(size=(FRAMES, 21, 3)), np.tile(np.eye(4), (FRAMES, 1, 1))
    poses[:, :3, 3] = rng.normal(size=(FRAMES, 3))
    joints[0], poses[-1] = np.nan, np.nan
    return Clip(name, item, FRAME_DT, joints, poses, swing("hand", 0.1), np.arange(1, FRAMES), np.linspace(0, 1, FRAMES - 1)[:, None],
                swing("robot", 0.2), np.linspace(0, 2, STEPS)[:, None], CONTROL_DT, "reaches the goal")


@pytest.fixture(scope="module")
def told(tmp_path_factory):
    """(the clips, entity -> rows) of a box and a can, one after the other."""
    file = tmp_path_factory.mktemp("hands") / "hands.rrd"
    clips = [clip("first", OBJECTS["061_foam_brick"]), clip("second", OBJECTS["005_tomato_soup_can"])]
    record_clips(file, clips)
    return clips, film_of(file)


def test_clips_follow_one_another(told):
    """The second begins a pause after the longest of the first: its replay, of nine steps."""
    _, rows = told
    labels = {row["Points3D:labels"][0]: seconds(row) for row in rows["/replay/label"] + rows["/recorded/label"]}
    begins = STEPS * CONTROL_DT + PAUSE
    assert labels["recorded: first"] == 0 and labels["recorded: second"] == pytest.approx(begins, abs=2e-6)
    assert [row["Points3D:labels"] for row in rows["/replay/label"]] == [["replay: reaches the goal"]] * 2


def test_the_hand_is_there_where_it_was_seen(told):
    (first, _), rows = told
    bones = rows["/recorded/hand/bones"]
    mine = [row for row in bones if seconds(row) < 0.3 and row.get("LineStrips3D:strips")]
    assert [seconds(row) for row in mine] == pytest.approx([FRAME_DT * k for k in range(1, FRAMES)], abs=2e-6)
    for row, joints in zip(mine, first.joints[1:], strict=True):
        for strip, bone in zip(row["LineStrips3D:strips"], BONES, strict=True):
            np.testing.assert_allclose(strip, joints[bone], atol=1e-6)


@pytest.mark.parametrize("entity", ["/recorded/object", "/retargeted/object"])
def test_the_object_is_where_it_was_annotated_and_has_its_shape(told, entity):
    (first, second), rows = told
    placed = [row for row in rows[entity] if "Transform3D:translation" in row and seconds(row) < 0.3]
    np.testing.assert_allclose([row["Transform3D:translation"][0] for row in placed], first.object_poses[:-1, :3, 3], atol=1e-6)
    (box,) = [row for row in rows[f"{entity}/box"] if row.get("Boxes3D:half_sizes")]
    np.testing.assert_allclose(box["Boxes3D:half_sizes"], [first.item.half_size], atol=1e-7)
    (can,) = [row for row in rows[f"{entity}/can"] if row.get("Cylinders3D:lengths")]
    assert seconds(can) > seconds(box) and can["Cylinders3D:lengths"] == pytest.approx([2 * second.item.half_size[1]])


@pytest.mark.parametrize("entity, body, interval", [("retargeted", "hand", FRAME_DT), ("replay", "robot", CONTROL_DT)])
def test_robots_stand_where_mujoco_has_them(told, entity, body, interval):
    """Each mesh logged once for both clips; of the room, which would hide the robot, nothing."""
    (first, _), rows = told
    meshes = [path for path in rows if path.startswith(f"/{entity}/") and "InstancePoses3D:translations" in rows[path][0]]
    assert len(meshes) == 1 and body in meshes[0]
    model, qpos, start = {"hand": (first.hand, first.hand_qpos, FRAME_DT), "robot": (first.replay, first.replay_qpos, 0.0)}[body]
    mine, data = rows[meshes[0]][: len(qpos)], mujoco.MjData(model)
    assert len(rows[meshes[0]]) == 2 * len(qpos)
    np.testing.assert_allclose([seconds(row) for row in mine], start + interval * np.arange(len(qpos)), atol=2e-6)
    for row, angles in zip(mine, qpos, strict=True):
        data.qpos[:] = angles
        mujoco.mj_kinematics(model, data)
        np.testing.assert_allclose(row["InstancePoses3D:translations"], [data.body(body).xpos], atol=1e-6)
        turn = np.roll(data.body(body).xquat, -1)
        assert abs(np.dot(row["InstancePoses3D:quaternions"][0], turn)) == pytest.approx(1.0, abs=1e-6)

"""What is read back from a recording is what MuJoCo says."""

import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from rerun.chunk import RrdReader

from toolkit import recording
from toolkit.errors import ToolkitError
from toolkit.recording import Recording, curves_of, show, tree_layout

Geom = mujoco.mjtGeom
NODES = [{"name": name, "kind": kind, "alpha": [0.0]} for name, kind in [("s", "source"), ("m", "meta"), ("t", "target"), ("u", "target")]]
EDGES = [{"from": "s", "to": "m", "length": 1.0}, {"from": "m", "to": "t", "length": 0.5}, {"from": "m", "to": "u", "length": 0.25}]


def hand(length: float = 0.1, tip: float = 0.02) -> mujoco.MjModel:
    """A floating palm with a finger of one capsule, a mesh and every other kind of primitive."""
    spec = mujoco.MjSpec()
    spec.worldbody.add_geom(name="floor", type=Geom.mjGEOM_PLANE, size=[0, 0, 0.1])
    wedge = spec.add_mesh(name="wedge")
    wedge.uservert = 0.03 * np.array([0, 0, 0, 1, 0, 0, 0, 1, 0, 0, 0, 1.0])
    palm = spec.worldbody.add_body(name="palm", pos=[0, 0, 0.5])
    palm.add_freejoint()
    palm.add_geom(name="box", type=Geom.mjGEOM_BOX, size=[0.05, 0.04, 0.02], group=1)
    palm.add_geom(name="hidden", type=Geom.mjGEOM_BOX, size=[0.05, 0.04, 0.02], group=0)
    palm.add_geom(name="wedge", type=Geom.mjGEOM_MESH, meshname="wedge", group=1)
    finger = palm.add_body(name="finger", pos=[0.05, 0, 0], quat=[0.9, 0.1, 0.3, 0.2])
    finger.add_joint(name="bend", axis=[0, 1, 0])
    finger.add_geom(name="bone", type=Geom.mjGEOM_CAPSULE, fromto=[0, 0, 0, length, 0, length], size=[0.01, 0, 0])
    finger.add_geom(name="tip", type=Geom.mjGEOM_SPHERE, size=[tip, 0, 0], mass=0.01)
    finger.add_geom(name="nail", type=Geom.mjGEOM_ELLIPSOID, size=[0.01, 0.02, 0.005])
    finger.add_geom(name="ring", type=Geom.mjGEOM_CYLINDER, size=[0.012, 0.003, 0])
    return spec.compile()


def swing(model: mujoco.MjModel, frames: int = 20) -> np.ndarray:
    """(frames, nq) random poses."""
    generator = np.random.default_rng(1)
    qpos = generator.normal(size=(frames, model.nq))
    qpos[:, 3:7] /= np.linalg.norm(qpos[:, 3:7], axis=1, keepdims=True)
    return qpos


def columns(path: Path) -> dict[str, list[dict[str, Any]]]:
    """Entity path -> its rows, each a dictionary of what is not empty."""
    rows: dict[str, list[dict[str, Any]]] = {}
    for chunk in recording._reader(path).stream():
        for row in chunk.to_record_batch().to_pylist():
            rows.setdefault(chunk.entity_path, []).append({key: value for key, value in row.items() if value is not None})
    return rows


def test_poses_equal_mujocos(tmp_path: Path) -> None:
    model = hand()
    qpos = swing(model)
    with Recording(tmp_path / "a.rrd") as made:
        end = made.log_episode("robot", model, qpos, control_dt=0.05, start_time=2.0, phase=7)
    assert end == pytest.approx(3.0)
    rows = columns(made.path)
    data = mujoco.MjData(model)
    for body in ("palm", "finger"):
        poses = rows[f"/robot/{body}"]
        assert len(poses) == len(qpos) and {row["iteration"] for row in poses} == {7}
        for frame, row in enumerate(poses):
            data.qpos[:] = qpos[frame]
            mujoco.mj_forward(model, data)
            assert row["time"].total_seconds() == pytest.approx(2.0 + 0.05 * frame, abs=1e-6)
            np.testing.assert_allclose(row["Transform3D:translation"][0], data.body(body).xpos, atol=1e-5)
            np.testing.assert_allclose(np.roll(row["Transform3D:quaternion"][0], 1), data.body(body).xquat, atol=1e-5)


def test_shapes_equal_mujocos(tmp_path: Path) -> None:
    model = hand()
    with Recording(tmp_path / "a.rrd") as made:
        made.log_episode("robot", model, swing(model), 0.05, 0.0, 0)
    rows = columns(made.path)
    geoms = {path for path in rows if path.startswith("/robot/") and path.count("/") == 3}
    assert geoms == {f"/robot/{name}" for name in "world/floor palm/box palm/wedge finger/bone finger/tip finger/nail finger/ring".split()}
    bone = rows["/robot/finger/bone"][0]
    ends = np.array([bone["Capsules3D:translations"][0]] * 2)
    mujoco.mju_rotVecQuat(axis := np.zeros(3), np.array([0, 0, 1.0]), np.roll(bone["Capsules3D:quaternions"][0], 1))
    ends[1] += bone["Capsules3D:lengths"][0] * axis
    np.testing.assert_allclose(ends[np.argsort(ends[:, 0])], [[0, 0, 0], [0.1, 0, 0.1]], atol=1e-6)
    assert np.allclose(rows["/robot/palm/box"][0]["Boxes3D:half_sizes"], [[0.05, 0.04, 0.02]])
    vertices = np.concatenate([row["Mesh3D:vertex_positions"] for row in rows["/robot/palm/wedge"] if "Mesh3D:vertex_positions" in row])
    assert {tuple(np.round(vertex, 6)) for vertex in vertices} == {tuple(np.round(vertex.astype(float), 6)) for vertex in model.mesh_vert}


def test_only_changes_are_logged_and_a_mesh_once(tmp_path: Path) -> None:
    with Recording(tmp_path / "a.rrd") as made:
        for phase, (length, tip) in enumerate([(0.1, 0.02), (0.1, 0.02), (0.2, 1e-4), (0.2, 0.02)]):
            model = hand(length, tip)
            made.log_episode("robot", model, swing(model), 0.05, float(phase), phase)
    rows = columns(made.path)
    assert sum("Mesh3D:vertex_positions" in row for row in rows["/robot/palm/wedge"]) == 1
    assert len(rows["/robot/palm/box"]) == 1
    assert [row["iteration"] for row in rows["/robot/finger/bone"]] == [0, 2]
    tips = [(row["iteration"], "Clear:is_recursive" in row) for row in rows["/robot/finger/tip"]]
    assert tips == [(0, False), (2, True), (3, False)], "a part that has shrunk away is cleared, and may grow again"
    assert len(rows["/robot/palm"]) == 80


def test_collision_geoms_instead(tmp_path: Path) -> None:
    with Recording(tmp_path / "a.rrd", collision=True) as made:
        made.log_episode("robot", hand(), swing(hand(), 1), 0.05, 0.0, 0)
    assert "/robot/palm/hidden" in columns(made.path) and "/robot/palm/box" not in columns(made.path)


def test_morph_has_a_frame_per_model(tmp_path: Path) -> None:
    lengths = np.linspace(0.1, 0.3, 11)
    with Recording(tmp_path / "a.rrd") as made:
        made.log_morph("morph", [(f"{length:.2f}", hand(length), swing(hand(), 1)[0]) for length in lengths])
    rows = columns(made.path)
    assert [row["morph"] for row in rows["/morph/finger/bone"]] == list(range(11))
    drawn = [row["Capsules3D:lengths"][0] for row in rows["/morph/finger/bone"]]
    np.testing.assert_allclose(drawn, lengths * np.sqrt(2), rtol=1e-6)
    assert len(rows["/morph/palm"]) == 1 and len(rows["/morph/label"]) == 11


def test_tree_and_progress(tmp_path: Path) -> None:
    with Recording(tmp_path / "a.rrd") as made:
        made.log_tree(NODES, EDGES)
        for step in range(5):
            made.log_progress(step, "s to m", {"success_rate": step / 4, "distance": 1.0})
        made.log_progress(5, "m to t", {"success_rate": 0.0})
        made.log_episode("robot", hand(), swing(hand()), 0.05, 0.0, 5)
        made.log_summary("# Done")
    rows = columns(made.path)
    (tree,) = rows["/tree"]
    assert len(tree["GraphNodes:node_ids"]) == len(NODES) + len(EDGES) and len(tree["GraphEdges:edges"]) == 2 * len(EDGES)
    assert {"s (source)", "m", "t (target)", "1.00", "0.50", "0.25"} <= set(tree["GraphNodes:labels"])
    curve = rows["/metrics/s\\ to\\ m/success_rate"]
    assert [row["Scalars:scalars"] for row in curve if "iteration" in row] == [[0.0], [0.25], [0.5], [0.75], [1.0]]
    on_time = [row["time"].total_seconds() for row in curve if "time" in row]
    assert len(on_time) == 5 and on_time == sorted(on_time) and on_time[-1] < 1.0
    assert curves_of(made.path) == [("m to t", "success_rate"), ("s to m", "distance"), ("s to m", "success_rate")]


def test_tree_layout_runs_left_to_right_without_overlap() -> None:
    places = tree_layout("smtu", [(edge["from"], edge["to"]) for edge in EDGES])
    assert all(places[edge["from"]][0] < places[edge["to"]][0] for edge in EDGES)
    assert len(set(places.values())) == 4
    assert set(tree_layout("ab", [("a", "b"), ("b", "a")])) == {"a", "b"}, "a cycle ends too"


def test_bad_episodes_are_refused(tmp_path: Path) -> None:
    model = hand()
    qpos = swing(model)
    with Recording(tmp_path / "a.rrd") as made:
        with pytest.raises(ToolkitError, match=r"needs \(frames, 8\)"):
            made.log_episode("robot", model, qpos[:, 1:], 0.05, 0.0, 0)
        with pytest.raises(ToolkitError, match="no finite frame"):
            made.log_episode("robot", model, np.full_like(qpos, np.nan), 0.05, 0.0, 0)
        qpos[12:] = np.inf
        assert made.log_episode("robot", model, qpos, 0.05, 5.0, 3) == pytest.approx(5.6)
        with pytest.raises(ToolkitError, match="log episodes in order"):
            made.log_episode("robot", model, qpos, 0.05, 4.0, 3)


@pytest.mark.skipif(os.name != "posix", reason="needs SIGKILL")
def test_a_killed_run_is_readable_and_continues_in_a_part(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = tmp_path / "recording.rrd"
    program = (
        "import os, sys; from toolkit.recording import Recording\n"
        "made = Recording(sys.argv[1])\n"
        "for step in range(9): made.log_progress(step, 'a/b', {'success_rate': 0.5})\n"
        "os.kill(os.getpid(), 9)\n"
    )
    root = Path(__file__).parents[1]
    killed = subprocess.run([sys.executable, "-c", program, str(file)], cwd=root, env=os.environ | {"PYTHONPATH": str(root)})
    assert killed.returncode == -signal.SIGKILL
    (curve,) = [rows for path, rows in columns(file).items() if path.startswith("/metrics")]
    assert sum("iteration" in row for row in curve) == 9
    file.write_bytes(file.read_bytes()[:-5])  # as if killed within a write
    with Recording(file) as resumed:
        resumed.log_progress(8, "a/b", {"success_rate": 0.5})
    assert resumed.path.name == "recording-1.rrd" and curves_of(file) == [("a/b", "success_rate")] == curves_of(resumed.path)
    identities = {RrdReader(part).recordings()[0].recording_id for part in (file, resumed.path)}
    assert len(identities) == 1, "the viewer joins the parts"
    for display in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(display, raising=False)
    if sys.platform == "linux":
        assert f"rerun --serve-web {file} {resumed.path}" in show(tmp_path)


def test_show_refuses_what_it_cannot_open(tmp_path: Path) -> None:
    with Recording(tmp_path / "a.rrd") as made:
        made.log_episode("robot", hand(), swing(hand()), 0.05, 0.0, 0)
    data = made.path.read_bytes()
    for length, complaint in [(0, "not a Rerun recording"), (10, "cut off"), (len(data) // 2, "cut off")]:
        made.path.write_bytes(data[:length])
        with pytest.raises(ToolkitError, match=complaint):
            show(made.path)
    made.path.write_bytes(b"PNG" + data)
    with pytest.raises(ToolkitError, match="not a Rerun recording"):
        show(made.path)
    with pytest.raises(ToolkitError, match="no recording at"):
        show(tmp_path)


def test_training_code_needs_no_rerun() -> None:
    program = "import sys, toolkit.runs; sys.exit('rerun' in sys.modules)"
    root = Path(__file__).parents[1]
    assert subprocess.run([sys.executable, "-c", program], cwd=root, env=os.environ | {"PYTHONPATH": str(root)}).returncode == 0

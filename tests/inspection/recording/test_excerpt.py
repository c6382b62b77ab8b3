"""An excerpt: one page at one moment, every vertex where the recording has it."""

import numpy as np
import pytest
from rerun_rows import entities, seconds
from scipy.spatial.transform import Rotation

from toolkit.errors import ToolkitError
from toolkit.inspection.recording import excerpt, recordings, rollouts, viewer


@pytest.mark.parametrize("page", ["evolution", "morph", "rollouts", "learning", "summary"])
def test_an_excerpt_is_one_page_at_one_moment(tmp_path, rebuilt, rows, stored, page, capfd):
    """So little that a program that takes its picture as soon as the viewer opens is not too early for it."""
    file, out = rebuilt[0], tmp_path / f"{page}.rrd"
    at = excerpt.moment_of(file, None, page)
    assert at == (max(row["iteration"] for row in rows["/learning/sim_epochs"] if "iteration" in row) if page == "learning" else
                  pytest.approx(max(seconds(row) for own in rows.values() for row in own if "film" in row), abs=1e-6))
    at = at if page == "learning" else 0.5 * at
    excerpt.excerpt(file, page, at, recordings.page_layout(stored.folder, file, page, True), out)
    assert not capfd.readouterr().err, "nothing to warn of, as entities that hold nothing yet"
    told = entities(out)
    assert all(path.startswith((*excerpt.ROOTS[page], "/__properties", "/scene/baked")) for path in told)
    moving = [path for path, own in told.items() if any("film" in row or "iteration" in row for row in own)]
    assert all(path.startswith(("/signals", "/learning")) for path in moving), "nothing moves but the cursor along curves"
    assert sum(1 for _ in viewer.reader_of(out).stream()) <= 30 and out.stat().st_size < 5e6
    if page == "evolution":
        here = max((row for row in rows["/evolution/tree/here"] if "film" in row and seconds(row) <= at), key=seconds)
        assert told["/evolution/tree/here"][0]["Points2D:positions"] == here["Points2D:positions"]
    if page == "learning":
        whole = [row["Scalars:scalars"][0] for row in rows["/learning/success"] if "iteration" in row]
        assert [row["Scalars:scalars"][0] for row in told["/learning/success"] if "iteration" in row] == whole
    if page == "rollouts":
        _compare_baked(told, rows, at)
        times = [seconds(row) for row in told["/signals/grip"] if "film" in row]
        assert min(times) >= at - rollouts.WINDOW and max(times) <= at + rollouts.WINDOW


def _compare_baked(told, rows, at):
    """Every vertex of the robot is where the recording's meshes and poses say."""
    wanted = {}
    for own in rows.values():
        mesh = next((row for row in own if "Mesh3D:vertex_positions" in row), None)
        poses = [row for row in own if "InstancePoses3D:translations" in row and seconds(row) <= at]
        if mesh is None or not poses:
            continue
        pose = max(poses, key=seconds)
        opacity = pose.get("Mesh3D:albedo_factor", [255])[0] & 0xFF
        for place, turn in zip(pose["InstancePoses3D:translations"], pose["InstancePoses3D:quaternions"], strict=True):
            wanted.setdefault(opacity, []).append(Rotation.from_quat(turn).apply(mesh["Mesh3D:vertex_positions"]) + place)
    assert wanted and set(told) >= {f"/scene/baked/{opacity}" for opacity in wanted}
    for opacity, parts in wanted.items():
        baked = np.array(told[f"/scene/baked/{opacity}"][0]["Mesh3D:vertex_positions"])
        np.testing.assert_allclose(np.sort(baked, axis=0), np.sort(np.concatenate(parts), axis=0), atol=1e-5)


def test_an_excerpt_of_nothing_gets_one_sentence(tmp_path, rebuilt, stored):
    layout = recordings.page_layout(stored.folder, rebuilt[0], "rollouts", True)
    with pytest.raises(ToolkitError, match="shows nothing of the page rollouts at -100"):
        excerpt.excerpt(rebuilt[0], "rollouts", -100.0, layout, tmp_path / "a.rrd")

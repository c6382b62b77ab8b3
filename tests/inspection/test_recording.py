"""What is read back from a recording is what the run did and what MuJoCo says.

Pages, excerpts, films and the viewer are tried together on one run that is played and drawn here: a file to itself would draw it again.
"""

import json
import os
import subprocess
import sys
from pathlib import Path

import mujoco
import numpy as np
import pytest
from rerun_rows import entities
from scipy.spatial.transform import Rotation

from tasks import TASKS
from toolkit.errors import ToolkitError
from toolkit.expert.shelf import load_expert
from toolkit.inspection.drawn_tree import matrix
from toolkit.inspection.recording import excerpt, learning, recordings, rollouts, viewer
from toolkit.inspection.recording.recorder import SHARE, RunRecorder
from toolkit.inspection.recording.scene import Scene
from toolkit.inspection.recording.stream import Stream
from toolkit.inspection.visual import AT_THE_TABLE, visual_of
from toolkit.learning.policy import MeanActor
from toolkit.runs.phases import PhaseRecorder, landmarks, load_phases
from toolkit.runs.run import Run
from toolkit.simulation.laws import merged_plant, native_plant
from toolkit.simulation.rollout import play

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def policy():
    return load_expert("adroit", TASKS["061_foam_brick"])[0]


@pytest.fixture(scope="module")
def run(small, policy, tmp_path_factory):
    """A run folder as a transfer leaves it: two real episodes on the way, one on the native robot."""
    from robots import ROBOTS

    folder = tmp_path_factory.mktemp("runs") / "run"
    made = Run.create(folder, {"source": "adroit", "targets": ["jaco"], "task": small.task.name})
    made.write_json("tree", small.tree("l1", "steiner").to_json())
    start, end = small.space.betas
    half = start + 0.5 * (end - start)
    cost = {"train_iterations": 0, "sim_epochs": 0, "check_episodes": 2, "diverged": 0}
    recorder = PhaseRecorder(folder, TASKS["061_foam_brick"].miss)
    mean = MeanActor(policy)
    plants = {"evolve": lambda alpha: merged_plant(small.merged, alpha, *small.merged.new()),
              "settle": lambda alpha: native_plant(ROBOTS["jaco"], small.task)}
    for second, (event, stage, before, after, seeds) in enumerate(
        [("moved", "evolve", start, half, (11, 12)), ("moved", "evolve", half, end, (11,)), ("arrived", "settle", end, end, (11,))]
    ):
        played = [play(plants[stage](after), mean, seed, after) for seed in seeds]
        recorder.record("path 1", stage, ["jaco"], before, [policy] * len(played), played, False, 0)
        success = float(np.mean([episode.success for episode in played]))
        record = {"path": "path 1", "stage": stage, **cost, "seconds": 10.0 * second}
        made.append_metrics({"event": "check", "success": success, "checked": len(played), **record})
        made.append_metrics({"event": event, "target": "jaco", "distance": 0.0, **record})
        recorder.end("path 1", stage, ["jaco"], before, after)
    policy.save(folder / "jaco.policy.safetensors")
    return folder


@pytest.fixture(scope="module")
def stored(run, small, policy):
    from robots import ROBOTS

    native = lambda name: native_plant(ROBOTS[name], small.task)  # noqa: E731
    return recordings.StoredRun(run, small.merged, policy, native, {"jaco": policy})


@pytest.fixture(scope="module")
def rebuilt(stored):
    """(file, cost) of the run's recording."""
    cost = recordings.rebuild(stored)
    return stored.folder / "recording.rrd", cost


@pytest.fixture(scope="module")
def rows(rebuilt):
    return entities(rebuilt[0])


def seconds(row):
    return row["film"].total_seconds() if "film" in row else -np.inf  # furniture stands there at all times


def test_every_page_is_there_and_small(rebuilt, rows):
    file, cost = rebuilt
    pages = {path.split("/")[1] for path in rows}
    assert {"scene", "evolution", "learning", "signals", "summary"} <= pages
    assert cost.drawn == cost.known == 4 and cost.size == file.stat().st_size < 20e6
    assert "4 of 4 episodes" in str(cost) and "MB" in str(cost)
    chunks = sum(1 for _ in viewer.reader_of(file).stream())
    assert chunks < 200, f"{chunks} chunks: viewers open a recording at once while it has few"


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


def test_tree_projection_and_alpha(rows, small):
    tree = small.tree("l1", "steiner").to_json()
    labels = {label for row in rows["/evolution/tree/names"] for label in row["Points2D:labels"]}
    assert {"adroit (source)", "jaco (target)"} == labels
    names = rows["/evolution/tree/names"][0]
    across = dict(zip(names["Points2D:labels"], (place[0] for place in names["Points2D:positions"]), strict=True))
    assert across["adroit (source)"] == 0 and across["jaco (target)"] > 1000, "names stand at their nodes"
    assert rows["/evolution/tree/lengths"][0]["Points2D:labels"] == [f"{tree['edges'][0]['length']:.1f}"]
    cells = [row for row in rows["/evolution/alpha/cells"] if "film" in row]
    assert len(cells[0]["Points2D:positions"]) == small.space.size == len(cells[0]["Points2D:colors"])
    done = [row for row in rows["/evolution/tree/done"] if "film" in row]
    assert len(done) == 3 and len(done[-1]["LineStrips2D:strips"]) == 3, "one stretch per phase"
    here = sorted((row for row in rows["/evolution/tree/here"] if "film" in row), key=seconds)
    across = [row["Points2D:positions"][0][0] for row in here]
    assert across[0] == 0 and max(across) == pytest.approx(1000), "from the source to the target"


def test_curves_have_a_point_per_record_on_both_timelines(rows, run):
    records = Run.open(run).read_metrics()
    success = [row for row in rows["/learning/success"] if "iteration" in row]
    assert [row["Scalars:scalars"][0] for row in success] == [r["success"] for r in records if r["event"] == "check"]
    totals = [row for row in rows["/learning/sim_epochs"] if "iteration" in row]
    assert [row["iteration"] for row in totals] == list(range(1, len(records) + 1))
    assert len([row for row in rows["/learning/sim_epochs"] if "film" in row and "iteration" not in row]) == len(records)
    widths = {len(row["Scalars:scalars"]) for row in rows["/learning/success"] if "Scalars:scalars" in row}
    assert widths == {1}, "the viewer draws the first of several lines only if rows differ in length"
    assert rows["/learning/success"][0]["SeriesLines:names"] == ["path 1"], "the legend names the paths that there are, and no other"


def test_captions_say_which_episode_it_is_and_how_it_ended(rows):
    texts = [row["TextDocument:text"][0] for row in rows["/signals/caption"]]
    assert sum("seed 11" in text for text in texts) == 3 and any("unmodified jaco" in text for text in texts)
    assert all("**Success" in text or "**Failure" in text for text in texts if "seed" in text)


def test_contacts_and_signals_of_a_film(rows):
    forces = [row for row in rows["/scene/contacts"] if row.get("Arrows3D:vectors")]
    assert len(forces) > 20
    for key, width in (("position", 6), ("action", 7), ("distance", 2), ("grip", 1), ("reward", 2)):
        lines = [row for row in rows[f"/signals/{key}"] if "Scalars:scalars" in row]
        assert {len(row["Scalars:scalars"]) for row in lines} == {width}
    assert max(row["Scalars:scalars"][0] for row in rows["/signals/grip"] if "Scalars:scalars" in row) > 0.3


@pytest.mark.slow
def test_a_running_transfer_spends_at_most_its_share(tmp_path, stored):
    """With no time at all, curves and ways are told, and of every path the landmarks at the end; a rebuild plays the rest."""
    recorder = RunRecorder(Stream(tmp_path / "a.rrd"), stored.folder, stored.merged, stored.tree(), stored.policy, stored.native, 1e-9,
                  Run.open(stored.folder).read_metrics())
    cost = recorder.finish()
    kept = landmarks([(phase, kept) for phase in load_phases(stored.folder).values() for kept in phase.episodes])
    assert 2 <= cost.drawn == len(kept) <= cost.known == 4 and 0 < SHARE <= 0.03
    assert cost.drawn == 4 or f"meta-evolve view {stored.folder} --rebuild" in str(cost)
    told = entities(tmp_path / "a.rrd")
    assert "/learning/success" in told
    captions = [row["TextDocument:text"][0] for row in told["/signals/caption"]]
    assert any("first" in text for text in captions) and any("last" in text for text in captions)


@pytest.mark.parametrize("suffix", ["mp4", "gif"])
@pytest.mark.slow
def test_a_run_becomes_a_film(tmp_path, stored, suffix):
    """As long as it says, in colour, and its last picture is the target, standing."""
    import cv2
    from PIL import Image, ImageSequence

    from toolkit.inspection.report import video

    video_size, video.SIZE = video.SIZE, (160, 120)
    try:
        seconds = video.write_video(stored.folder, stored.merged, stored.tree(), stored.policy, stored.native, tmp_path / f"film.{suffix}")
    except ToolkitError as error:
        pytest.skip(str(error))
    finally:
        video.SIZE = video_size
    file = tmp_path / f"film.{suffix}"
    if suffix == "mp4":
        reader = cv2.VideoCapture(str(file))
        frames = []
        while (answer := reader.read())[0]:
            frames.append(answer[1][..., ::-1])
    else:
        frames = [np.array(frame.convert("RGB")) for frame in ImageSequence.Iterator(Image.open(file))]
    assert 5.0 < seconds < 60.0 and file.stat().st_size > 10_000
    if suffix == "mp4":
        assert abs(len(frames) - seconds * video.RATE) <= 1
    apart = [np.abs(a.astype(int) - b).mean() for a, b in zip(frames, frames[1:], strict=False)]
    assert max(apart) > 1.0 and min(apart) < 1.0, "something moves, and something rests"
    assert np.abs(frames[0].astype(int) - frames[-1]).mean() > 2.0, "the hand has become the Jaco"


def test_a_run_without_episodes_makes_no_film(tmp_path, stored):
    from toolkit.inspection.report import video

    with pytest.raises(ToolkitError, match="keeps no phases to show"):
        video.write_video(tmp_path, stored.merged, stored.tree(), stored.policy, stored.native, tmp_path / "film.mp4")


def test_what_is_zero_all_along_has_a_sentence(rebuilt, stored):
    """The run trained nothing; its success and its wall time are curves."""
    flat = learning.flat_curves(viewer.chunks_of(rebuilt[0]))
    assert {"sim_epochs", "train_iterations", "diverged", "kl"} <= flat and not {"success", "wall"} & flat
    assert set(learning.FLAT) == set(learning.CURVES)


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


@pytest.mark.slow
def test_a_run_without_phases_shows_its_last_policies(tmp_path, stored):
    """An older version's run: config, tree, metrics and final policies."""
    old = tmp_path / "old"
    old.mkdir()
    for name in ("config.json", "tree.json", "metrics.jsonl"):
        (old / name).write_bytes((stored.folder / name).read_bytes())
    cost = recordings.rebuild(recordings.StoredRun(old, stored.merged, stored.policy, stored.native, stored.trained))
    assert cost.drawn == 2
    assert any("at 100% of adroit to jaco" in row["TextDocument:text"][0] for row in entities(old / "recording.rrd")["/signals/caption"])


@pytest.mark.slow
def test_what_a_stopped_run_is_stuck_on_is_shown(tmp_path, stored):
    """Its last phase has no end and no record: the episodes that it holds are played all the same."""
    import shutil

    stuck = tmp_path / "stuck"
    shutil.copytree(stored.folder, stuck, ignore=shutil.ignore_patterns("*.rrd"))
    for file in stuck.glob("phases/path-1-00[12]*"):
        file.unlink()
    records = (stuck / "metrics.jsonl").read_text().splitlines(keepends=True)
    (stuck / "metrics.jsonl").write_text("".join(records[:2]))
    played = [play(merged_plant(stored.merged, stored.merged.space.betas[1], *stored.merged.new()),
                   MeanActor(stored.policy), 11, stored.merged.space.betas[1])]
    policies = [stored.policy] * len(played)
    recorder = PhaseRecorder(stuck, TASKS["061_foam_brick"].miss, {"path 1": 1})
    recorder.record("path 1", "evolve", ["jaco"], stored.merged.space.betas[0], policies, played, False, 0)
    cost = recordings.rebuild(recordings.StoredRun(stuck, stored.merged, stored.policy, stored.native, {}))
    assert cost.drawn == cost.known == 3, "two episodes of the phase that ended, one of the phase that did not"
    texts = [row["TextDocument:text"][0] for row in entities(stuck / "recording.rrd")["/signals/caption"]]
    assert any("phase 1 (evolve)" in text and "seed 11" in text for text in texts)


def test_a_run_without_any_path_done_is_shown(tmp_path, stored):
    young = tmp_path / "young"
    young.mkdir()
    for name in ("config.json", "tree.json"):
        (young / name).write_bytes((stored.folder / name).read_bytes())
    cost = recordings.rebuild(recordings.StoredRun(young, stored.merged, stored.policy, stored.native, {}))
    assert cost.known == 0
    told = entities(young / "recording.rrd")
    assert "0 records; targets reached: none yet" in told["/summary"][-1]["TextDocument:text"][0]


def test_a_run_of_another_space_is_refused_in_one_sentence(tmp_path, stored):
    other = tmp_path / "other"
    other.mkdir()
    tree = json.loads((stored.folder / "tree.json").read_bytes())
    tree["nodes"] = [node | {"alpha": node["alpha"][:-1]} for node in tree["nodes"]]
    (other / "tree.json").write_text(json.dumps(tree))
    with pytest.raises(ToolkitError, match="another version"):
        recordings.rebuild(recordings.StoredRun(other, stored.merged, stored.policy, stored.native, {}))
    (other / "tree.json").write_text("{")
    with pytest.raises(ToolkitError, match="tree.json is damaged"):
        recordings.rebuild(recordings.StoredRun(other, stored.merged, stored.policy, stored.native, {}))
    (other / "tree.json").unlink()
    with pytest.raises(ToolkitError, match="has no tree.json yet"):
        recordings.rebuild(recordings.StoredRun(other, stored.merged, stored.policy, stored.native, {}))


def test_a_morph_follows_the_tree(tmp_path, small):
    recordings.morph(small.merged, "adroit", ["jaco"], tmp_path / "m.rrd", small.tree("l1", "steiner").to_json(), frames=6)
    told = entities(tmp_path / "m.rrd")
    frames = [row for row in told["/scene/robot/bones"] if "film" in row]
    assert len(frames) == 6 and "/signals/action" not in told
    across = [row["Points2D:positions"][0][0] for row in told["/evolution/tree/here"] if "film" in row]
    assert len(across) == 6 and across == sorted(across) and across[0] == 0 and across[-1] == pytest.approx(1000)
    texts = {seconds(row): row["TextDocument:text"][0] for row in told["/evolution/changes"]}
    assert "this is the source" in texts[0.0], "the page is whole from the first frame on"


@pytest.mark.slow
def test_two_runs_stand_side_by_side(tmp_path, stored):
    films, layout = recordings.compare([("one", stored, "jaco"), ("two", stored, "jaco")], tmp_path / "c.rrd", seed=11)
    np.testing.assert_array_equal(films[0].qpos, films[1].qpos)
    assert films[0].qpos.shape[1] == stored.native("jaco").model.nq, "the unmodified robot, of which success is claimed"
    told = entities(tmp_path / "c.rrd")
    (entity,) = [path for path in told if path.endswith("/j2s7s300_link_7")]
    places = np.array(next(row for row in told[entity] if "film" in row)["InstancePoses3D:translations"])
    np.testing.assert_allclose(places[1] - places[0], [0, AT_THE_TABLE.apart, 0], atol=1e-5)
    assert sum("Mesh3D:vertex_positions" in row for row in told[entity]) == 1, "two robots, one mesh"
    assert {"/side-1/distance", "/side-2/distance"} <= set(told)
    excerpt.excerpt(tmp_path / "c.rrd", "compare", 1.0, layout(True), tmp_path / "e.rrd")
    assert {"/side-1/caption", "/side-2/caption", "/scene/goal"} <= set(entities(tmp_path / "e.rrd"))
    with pytest.raises(ToolkitError, match="has no policy for 'iiwa' yet"):
        recordings.compare([("one", stored, "jaco"), ("two", stored, "iiwa")], tmp_path / "d.rrd", seed=11)


def test_a_matrix_has_a_place_for_every_dimension(small):
    places, rows, columns = matrix(small.space)
    assert len({tuple(place) for place in places}) == small.space.size, "no two dimensions share a cell"
    assert places[:, 1].max() + 1 == len(rows) and "anchor" in columns and "arm1" in rows


def test_what_is_no_recording_gets_one_sentence(tmp_path, rebuilt):
    data = rebuilt[0].read_bytes()
    file = tmp_path / "a.rrd"
    for length, complaint in [(0, "not a Rerun recording"), (10, "cut off")]:
        file.write_bytes(data[:length])
        with pytest.raises(ToolkitError, match=complaint):
            viewer.recording_of(file)
    file.write_bytes(b"PNG" + data)
    with pytest.raises(ToolkitError, match="not a Rerun recording"):
        viewer.recording_of(file)
    with pytest.raises(ToolkitError, match="no recording at"):
        viewer.recording_of(tmp_path)


def test_without_a_display_the_viewer_is_served(rebuilt):
    import urllib.request

    process, address, proxy = viewer.serve(rebuilt[0])
    try:
        page = urllib.request.urlopen(address.split("?")[0], timeout=20).read().decode()
        assert "<html" in page.lower() and proxy.endswith("/proxy")
    finally:
        process.terminate()
        process.wait()
    with pytest.raises(OSError):  # nobody is left behind who serves on
        urllib.request.urlopen(address.split("?")[0], timeout=20)


@pytest.mark.slow
def test_without_the_viewer_a_sentence_says_how_to_have_it():
    program = (
        "import sys; sys.modules['rerun'] = None; from toolkit.cli import main\n"
        "import importlib.util; found = importlib.util.find_spec\n"
        "importlib.util.find_spec = lambda name, *more: None if name == 'rerun' else found(name, *more)\n"
        "from toolkit.quiet import silence_robosuite; silence_robosuite(); import toolkit.transfer.pipeline; main(['view', 'run.rrd'])"
    )
    done = subprocess.run([sys.executable, "-c", program], cwd=ROOT, env=os.environ | {"PYTHONPATH": str(ROOT)}, capture_output=True,
                          text=True)
    assert done.returncode == 2, done.stderr
    assert done.stderr == "meta-evolve: the Rerun viewer is not installed; pip install 'meta-evolve[viewer]'\n"


@pytest.mark.slow
def test_training_code_needs_no_rerun():
    program = "import sys, toolkit.runs.phases, toolkit.runs.run, toolkit.transfer.pipeline; sys.exit('rerun' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", program], cwd=ROOT, env=os.environ | {"PYTHONPATH": str(ROOT)}).returncode == 0

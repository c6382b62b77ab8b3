"""Robots that are changes of one model are drawn as MuJoCo has them, and a run on them is recorded, rebuilt, reported and filmed."""

import json
from dataclasses import replace
from html.parser import HTMLParser

import mujoco
import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation
from toys import CRAWL, CRAWLER_ROBOTS, HAND_ROBOTS, LIFT

import robots
import tasks
from toolkit.cli import main
from toolkit.cli.training import record_run
from toolkit.errors import ToolkitError
from toolkit.expert import shelf
from toolkit.expert.training import new_learner
from toolkit.inspection.furniture import opacity
from toolkit.inspection.recording import recordings, viewer
from toolkit.inspection.recording.scene import Scene
from toolkit.inspection.recording.stream import Stream
from toolkit.inspection.report import stills
from toolkit.inspection.trajectory import PickTrajectory, replay
from toolkit.inspection.visual import ALWAYS, SHAPE, SKIN, visual_of
from toolkit.learning.policy import MeanActor
from toolkit.morphology.lab import Lab
from toolkit.runs.phases import load_phases
from toolkit.simulation.laws import merged_plant, native_plant
from toolkit.simulation.rollout import play
from toolkit.transfer.pipeline import Job, Pipeline
from toolkit.transfer.settings import TransferConfig

HIGH = replace(CRAWL, name="crawl-high", goal=0.5, hold_steps=1)
"""Some starts are high enough, others are not, whatever the policy does: a transfer has successes, failures and a budget to spend."""
CONFIG = TransferConfig(xi=0.8, check_episodes=2, goal_episodes=2, path_budget=24, check_every=1)


@pytest.fixture(scope="module")
def crawlers():
    return Lab(CRAWLER_ROBOTS[0], CRAWLER_ROBOTS[1:], CRAWL)


@pytest.fixture(scope="module")
def hands():
    """gymnasium-robotics' ADROIT at its door, and the hand of two fingers: links whose meshes cannot shrink with them."""
    task = tasks.MODEL_TASKS["door"]
    source, target = (robots.MODEL_ROBOTS[name] for name in ("adroit-free", "two-finger"))
    return Lab(source, [target], task)


def entities(path):
    """Entity -> its rows that are on the film, in order."""
    rows = {}
    for chunk in viewer.reader_of(path).stream():
        for row in chunk.to_record_batch().to_pylist():
            if "film" in row and row["film"] is not None:
                rows.setdefault(chunk.entity_path, []).append({key: value for key, value in row.items() if value is not None})
    return {path: sorted(own, key=lambda row: row["film"]) for path, own in rows.items()}


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
    told = entities(tmp_path / "a.rrd")
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


def test_boxes_and_balls_of_another_task():
    """The toy hand lifts: a box, two capsules, a ball, over every frame of a film against mj_kinematics."""
    lab = Lab(HAND_ROBOTS[0], HAND_ROBOTS[1:], LIFT)
    visual, alpha = visual_of(lab.merged), lab.space.betas[1]
    actor = MeanActor(new_learner(LIFT, 0)[0])
    film = replay(merged_plant(lab.merged, alpha, *lab.merged.new()), actor, 3, alpha)
    assert not isinstance(film, PickTrajectory) and {name: len(drawn.colours) for name, drawn in visual.primitives.items()} == {
        "boxes": 1, "capsules": 2, "ellipsoids": 2}, "the palm, two fingers, the ball and a site"
    motion = visual.playing(film, alpha)
    model, data = lab.merged.new()
    lab.merged.become(alpha, model, data)
    for frame in range(0, len(film.qpos), 7):
        data.qpos[:] = film.qpos[frame]
        mujoco.mj_kinematics(model, data)
        for name, geoms in (("boxes", ["palm"]), ("capsules", ["thumb", "finger"]), ("ellipsoids", ["ball"])):
            places, turns, sizes = (array[frame][: len(geoms)] for array in motion.parts[name])
            ids = [model.geom(geom).id for geom in geoms]
            np.testing.assert_allclose(places, data.geom_xpos[ids], atol=1e-9)
            matrices = Rotation.from_quat(turns, scalar_first=True).as_matrix().reshape(-1, 9)
            np.testing.assert_allclose(matrices, data.geom_xmat[ids], atol=1e-9)
            own = np.full((1, 3), 0.03) if name == "ellipsoids" else model.geom_size[ids]
            np.testing.assert_allclose(sizes, own, atol=1e-12)
        np.testing.assert_allclose(motion.parts["ellipsoids"][0][frame, 1], data.site("tip").xpos, atol=1e-9)


def test_a_film_keeps_what_the_scene_has_placed(hands):
    """The door stands elsewhere in each episode, by no joint: a film that is drawn after a later episode stands where it stood."""
    visual, actor = visual_of(hands.merged), MeanActor(new_learner(hands.task, 0)[0])
    plant = native_plant(hands.targets[0], hands.task)
    films, places = [], []
    for seed in (1, 2):
        films.append(replay(plant, actor, seed, hands.space.betas[1]))
        places.append(np.array(plant.data.xpos[plant.model.body("frame").id]))
    assert np.abs(places[0] - places[1]).max() > 0.01, "the seeds place the door alike"
    model = hands.merged.template
    frame = np.flatnonzero(model.geom_bodyid == model.body("frame").id)
    cylinders = [geom for geom in visual.geoms if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_CYLINDER]
    for film, place in zip(films, places, strict=True):
        posts = visual.native(film, hands.targets[0].name).parts["cylinders"][0][0, [cylinders.index(geom) for geom in frame]]
        np.testing.assert_allclose(posts, place + model.geom_pos[frame], atol=1e-9)


def test_meshes_fade_where_shapes_change_and_nowhere_else(hands):
    """Of a finger that shrinks the mesh gives way to what touches; the forearm, which stays, keeps its mesh."""
    visual, model = visual_of(hands.merged), hands.merged.template
    column = {model.geom(geom).name: own for geom, own in visual.geoms.items()}
    assert column["V_ffproximal"] == SKIN and column["C_ffproximal"] == SHAPE and column["V_forearm"] == ALWAYS
    assert column["V_ffknuckle"] == SKIN and column["V_wrist"] == ALWAYS, "a knuckle, which touches nothing, goes with the palm"
    assert "C_forearm1" not in column, "what only touches stays hidden where a mesh shows it"
    motion = visual.standing(hands.space.betas)
    shown = opacity(motion.weights, motion.weights.max(axis=1, keepdims=True))
    np.testing.assert_array_equal(shown, [[1, 0, 1], [0, 1, 1]])


@pytest.mark.parametrize("near", [True, False])
def test_pictures_of_a_robot_that_turns(crawlers, near):
    try:
        renderer = stills.renderer_of(visual_of(crawlers.merged), (96, 96), near)
    except ToolkitError as error:
        pytest.skip(str(error))
    source, target = crawlers.space.betas[:2]
    pictures = [renderer.take(source + share * (target - source)).astype(float) for share in (0.0, 0.5, 1.0)]
    again = renderer.take(source).astype(float)
    renderer.close()
    np.testing.assert_array_equal(again, pictures[0])
    apart = [np.abs(a - b).mean() for a, b in ((pictures[0], pictures[2]), (pictures[0], pictures[1]))]
    assert apart[0] > apart[1] > 0.3, f"halfway lies between the ends: {apart}"


# ---- a run, from Lab to page -----------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def patch():
    with pytest.MonkeyPatch.context() as patch:
        yield patch


@pytest.fixture(scope="module")
def run(patch, tmp_path_factory):
    """(run folder, what was watched) of a tiny transfer with a random policy as the expert."""
    root = tmp_path_factory.mktemp("family")
    patch.chdir(root)
    patch.setattr(shelf, "SHIPPED", root / "shelf")
    patch.setattr(robots, "MODEL_ROBOTS", {robot.name: robot for robot in CRAWLER_ROBOTS})
    patch.setattr(tasks, "MODEL_TASKS", {HIGH.name: HIGH})
    shelf.save_expert(*new_learner(HIGH, 0), root / "shelf", f"crawler-{HIGH.name}", {})
    job, watched = Job(CRAWLER_ROBOTS[0], (CRAWLER_ROBOTS[2],), HIGH, CONFIG, evaluation_episodes=2), []
    Pipeline(job, root / "run", watch=watched.append, record=record_run).play()
    return root / "run", watched


def test_the_run_is_recorded_while_it_goes_on(run):
    folder, watched = run
    end = watched[-1]
    assert end["event"] == "recorded" and not end["trouble"], f"the run is not fully recorded: {end['cost']}"
    told = entities(folder / "recording.rrd")
    assert {"/scene/robot/capsules", "/signals/joints", "/signals/action", "/signals/reward", "/evolution/alpha/cells"} <= set(told)
    assert not {"/scene/goal", "/scene/trail", "/scene/target", "/scene/contacts", "/signals/grip"} & set(told)
    texts = [row["TextDocument:text"][0] for row in told["/signals/caption"]]
    assert any("F(alpha)" in text for text in texts) and any("the unmodified thick" in text for text in texts)
    assert any("**Success after" in text for text in texts) and any("**Failure: " in text for text in texts)


def test_the_curves_of_a_rebuilt_run_are_of_the_episodes_played_again(run):
    """Every episode that the phases keep: its actions, and its joints as the engine plays them."""
    from toolkit.cli.inspection import stored_run

    folder, stored = run[0], stored_run(run[0])
    cost = recordings.rebuild(stored)
    episodes = [(phase, kept) for phase in load_phases(folder).values() for kept in phase.episodes]
    assert cost.drawn == cost.known == len(episodes) > 1
    rows = [row["Scalars:scalars"] for row in entities(folder / "recording.rrd")["/signals/action"] if "Scalars:scalars" in row]
    drawn = [tuple(np.round(row, 5)) for row in rows if np.isfinite(row).all()]
    phase, kept = episodes[0]
    policy = phase.policy_of(kept, stored.policy)
    actor = policy.act if kept.noise else MeanActor(policy)
    plant = stored.native("thick") if phase.stage == "settle" else merged_plant(stored.merged, kept.alpha, *stored.merged.new())
    episode = play(plant, actor, kept.seed, kept.alpha)
    wanted = [tuple(np.round(np.clip(action, -1, 1), 5)) for action in episode.actions]
    assert set(wanted) <= set(drawn) and len(drawn) == sum(kept.steps for _, kept in episodes)


class Text(HTMLParser):
    def __init__(self):
        super().__init__()
        self.text, self.pictures = [], 0

    def handle_starttag(self, tag, attributes):
        self.pictures += tag == "img"

    def handle_data(self, data):
        self.text.append(data)


@pytest.mark.slow
def test_the_commands_look_at_it(run, tmp_path, capsys):
    folder = run[0]
    main(["view", str(folder), "--page", "rollouts", "--at", "3", "--out", str(tmp_path / "rollouts.rrd")])
    kinds = {chunk.entity_path for chunk in viewer.reader_of(tmp_path / "rollouts.rrd").stream()}
    assert {"/scene/robot/capsules", "/signals/joints", "/signals/caption"} <= kinds
    main(["view", str(folder), str(folder), "--compare", "thick", "--at", "0.5", "--out", str(tmp_path / "c.rrd")])
    kinds = {chunk.entity_path for chunk in viewer.reader_of(tmp_path / "c.rrd").stream()}
    assert {"/scene/robot/capsules", "/side-1/joints", "/side-2/joints"} <= kinds and "/scene/goal" not in kinds
    main(["morph", "--source", "crawler", "--targets", "long", "thick", "--task", "crawl-high", "--out", str(tmp_path / "m.rrd"),
          "--lineup", str(tmp_path / "l.png")])
    assert len(entities(tmp_path / "m.rrd")["/scene/robot/capsules"]) == 120
    assert Image.open(tmp_path / "l.png").size == (3 * stills.LINED_UP[0], stills.LINED_UP[1])
    capsys.readouterr()
    main(["report", str(folder), "--json"])
    page = json.loads(capsys.readouterr().out)
    parser = Text()
    parser.feed((folder / "page" / "index.html").read_text(encoding="utf-8"))
    assert "is not measured" in " ".join(parser.text) and parser.pictures == len(page["pictures"])
    names = {name.rpartition("/")[2] for name in page["pictures"]}
    assert {"tree.png", "projection.png", "curves.png", "parameters.png"} <= names and "audit.png" not in names


@pytest.mark.slow
def test_the_run_becomes_a_film(run, tmp_path):
    import cv2

    from toolkit.cli.inspection import stored_run
    from toolkit.inspection.report import video

    stored, size, video.SIZE = stored_run(run[0]), video.SIZE, (160, 120)
    try:
        seconds = video.write_video(stored.folder, stored.merged, stored.tree(), stored.policy, stored.native, tmp_path / "film.mp4")
    except ToolkitError as error:
        pytest.skip(str(error))
    finally:
        video.SIZE = size
    reader, frames = cv2.VideoCapture(str(tmp_path / "film.mp4")), []
    while (answer := reader.read())[0]:
        frames.append(answer[1].astype(int))
    assert abs(len(frames) - seconds * video.RATE) <= 1
    assert np.abs(frames[0] - frames[-1]).mean() > 0.3, "the crawler has become another"


@pytest.mark.parametrize("frequency, frames", [(20.0, list(range(11))), (100.0, [0, 5, 10]), (10.0, sorted([*range(11)] * 2))])
def test_a_films_episodes_are_as_fast_as_they_were(frequency, frames):
    """A film has 20 pictures a second, whatever the task has policy steps."""
    from toolkit.inspection.report import video

    task = replace(CRAWL, control_frequency=frequency, horizon=10, goal=9.0)
    film = replay(native_plant(CRAWLER_ROBOTS[0], task), MeanActor(new_learner(task, 0)[0]), 0, np.zeros(1))
    assert len(film.qpos) == 11 and video._frames(film) == frames


def test_what_cannot_be_for_them_is_refused_in_a_sentence(run, capsys):
    for command, why in ((["audit", "--source", "crawler", "--targets", "thick", "--task", "crawl-high"], "is no pick"),
                         (["tree", "--source", "crawler", "--targets", "thick"], "cannot play task"),
                         (["match", "--source", "crawler", "--task", "crawl-high", "--plot", "a.png"], "leave out --plot")):
        with pytest.raises(SystemExit) as stop:
            main(command)
        told = capsys.readouterr().err
        assert stop.value.code == 2 and why in told and len(told.splitlines()) == 1


def test_match_tree_and_walk_play_in_their_task(run, capsys):
    main(["match", "--source", "crawler", "--task", "crawl-high", "--episodes", "2", "--json"])
    found = json.loads(capsys.readouterr().out)
    lab = Lab(CRAWLER_ROBOTS[0], CRAWLER_ROBOTS[1:], HIGH)
    assert found["D"] == lab.space.size and [robot["name"] for robot in found["robots"]] == ["crawler", "long", "thick"]
    np.testing.assert_array_equal([robot["alpha"] for robot in found["robots"]], lab.space.betas)
    assert {one["env"] for one in found["expert"]} == {"merged", "native-compiled"}
    main(["tree", "--source", "crawler", "--targets", "long", "thick", "--task", "crawl-high", "--json"])
    assert json.loads(capsys.readouterr().out)["length"] == pytest.approx(lab.tree("l1", "steiner").length)
    main(["bench", "walk", "--source", "crawler", "--targets", "thick", "--task", "crawl-high", "--steps", "1",
          "--episodes", "2", "--json"])
    assert [point["share"] for point in json.loads(capsys.readouterr().out)["waypoints"]] == [0.0, 1.0]

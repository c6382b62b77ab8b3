"""Robots that are changes of one model are drawn as MuJoCo has them, and a run on them is recorded, rebuilt, reported and filmed."""

import json
from dataclasses import replace
from html.parser import HTMLParser

import numpy as np
import pytest
from PIL import Image
from rerun_rows import film_of
from toys import CRAWL, CRAWLER_ROBOTS

import robots
import tasks
from toolkit.cli import main
from toolkit.cli.training import record_run
from toolkit.errors import ToolkitError
from toolkit.expert import shelf
from toolkit.expert.training import new_learner
from toolkit.inspection.recording import recordings, viewer
from toolkit.inspection.report import stills
from toolkit.learning.policy import MeanActor
from toolkit.morphology.lab import Lab
from toolkit.runs.phases import load_phases
from toolkit.simulation.laws import merged_plant
from toolkit.simulation.rollout import play
from toolkit.transfer.pipeline import Job, Pipeline
from toolkit.transfer.settings import TransferConfig

HIGH = replace(CRAWL, name="crawl-high", goal=0.5, hold_steps=1)
"""Some starts are high enough, others are not, whatever the policy does: a transfer has successes, failures and a budget to spend."""
CONFIG = TransferConfig(xi=0.8, check_episodes=2, goal_episodes=2, path_budget=24, check_every=1)



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
    told = film_of(folder / "recording.rrd")
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
    rows = [row["Scalars:scalars"] for row in film_of(folder / "recording.rrd")["/signals/action"] if "Scalars:scalars" in row]
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
    assert len(film_of(tmp_path / "m.rrd")["/scene/robot/capsules"]) == 120
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

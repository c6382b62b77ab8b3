"""From names to report on real robots: a tiny transfer and its folder, and another one that is killed and resumed."""

import json
import shutil
from dataclasses import asdict

import numpy as np
import pytest

from robots import ROBOTS
from tasks import TASKS
from tasks.pick import ACTION, OBSERVATION
from toolkit.cli.training import record_run
from toolkit.errors import ToolkitError
from toolkit.expert.shelf import load_expert
from toolkit.inspection.recording.viewer import reader_of
from toolkit.learning.npg import NpgConfig
from toolkit.learning.policy import GaussianPolicy
from toolkit.runs.phases import ROLES, load_phases
from toolkit.runs.run import Run
from toolkit.transfer.pipeline import Job, Pipeline
from toolkit.transfer.settings import TransferConfig

TARGET = "kinova3"
TIMING = {"episodes_per_s", "play_s", "learn_s", "seconds"}
CONFIG = TransferConfig(xi=0.5, check_episodes=4, goal_episodes=4, path_budget=24, check_every=2)


@pytest.fixture(scope="module")
def job(task):
    return Job(ROBOTS["adroit"], (ROBOTS[TARGET],), task, CONFIG, evaluation_episodes=2)


@pytest.fixture(scope="module", autouse=True)
def log_elsewhere(tmp_path_factory):
    """MuJoCo writes its warnings to MUJOCO_LOG.TXT where it runs."""
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(tmp_path_factory.mktemp("elsewhere"))
        yield


@pytest.fixture(scope="module")
def played(job, tmp_path_factory):
    """(run folder, report, what was watched) of the shipped expert's way."""
    folder, watched = tmp_path_factory.mktemp("flow") / "run", []
    report = Pipeline(job, folder, watch=watched.append, record=record_run).play()
    return folder, report, watched


def bent_expert(source, task, name=None):
    """The shipped expert with a pull to one side: its mean action misses, its noisy ones hit now and then."""
    policy, value = load_expert(source, task)
    parameters = policy.parameters.copy()
    parameters[-2 * len(policy.action_names)] += 0.6  # bias of the first action entry
    policy.set_parameters(parameters)
    return policy, value


def timeless(folder):
    return [{k: v for k, v in record.items() if k not in TIMING} for record in Run.open(folder).read_metrics()]


def numbers(report):
    return {key: value for key, value in report.items() if key not in ("wall_s", "time")}


def test_the_report_says_where_the_time_went(played):
    spent = played[1]["time"]
    assert 0 < spent["play_s"] + spent["learn_s"] <= spent["wall_s"] <= played[1]["wall_s"]
    assert spent["outside_playing"] == pytest.approx(1 - spent["play_s"] / spent["wall_s"])


def policy_of(folder):
    return GaussianPolicy.load(folder / f"{TARGET}.policy.safetensors", OBSERVATION.names, ACTION.names)


def test_the_run_folder_explains_the_run(played, job):
    folder, report, _ = played
    files = {file.relative_to(folder).as_posix() for file in folder.rglob("*") if file.is_file()}
    phases = {f"phases/{name}.safetensors" for name in load_phases(folder)}
    assert any("evolve" in name for name in phases) and any("settle" in name for name in phases)
    assert files - phases == {
        "audit.json", "config.json", "versions.json", "git.json", "tree.json", "untrained.json", "metrics.jsonl", "report.json",
        "summary.md",
        "recording.rrd", f"{TARGET}.policy.safetensors", "checkpoints/transfer.safetensors",
    }
    content = json.loads((folder / "config.json").read_text())
    assert content["source"] == "adroit" and content["targets"] == [TARGET] and content["task"] == job.task.name
    assert content["transfer"] == json.loads(json.dumps(asdict(CONFIG)))
    assert json.loads((folder / "report.json").read_text()) == json.loads(json.dumps(report))


def test_the_report_keeps_its_contract(played):
    _, report, _ = played
    assert {"targets", "train_iterations", "sim_epochs", "totals", "wall_s", "seed", "kind", "metric"} <= report.keys()
    assert report["targets"].keys() == {TARGET}
    for env, result in report["targets"][TARGET].items():
        assert {"target", "env", "episodes", "successes", "success_rate", "ci95"} <= result.keys()
        assert (result["target"], result["env"], result["episodes"]) == (TARGET, env, 2)
        assert 0 <= result["ci95"][0] <= result["success_rate"] <= result["ci95"][1] <= 1
    assert report["targets"][TARGET].keys() == {"native", "merged"}
    assert report["targets"][TARGET]["merged"]["successes"] >= 1, "the shipped expert arrives on F(beta) without a success"
    assert report["routes"] == {"path 1": ["adroit", TARGET]}


def test_the_report_counts_what_was_watched(played):
    folder, report, watched = played
    updates = sum(record["event"] == "update" for record in watched)
    checked = sum(record["checked"] for record in watched if record["event"] in ("check", "look", "explore"))
    batch = CONFIG.npg.batch_size
    assert report["train_iterations"] == {"path 1": updates} and report["totals"]["train_iterations"] == updates
    assert report["sim_epochs"] == {"path 1": updates * batch} and report["totals"]["sim_epochs"] <= CONFIG.path_budget
    assert report["check_episodes"] == {"path 1": checked}
    on_disk = [record["event"] for record in Run.open(folder).read_metrics()]
    around = ("preparing", "audited", "untrained", "evaluating", "recorded")
    assert on_disk == [record["event"] for record in watched if record["event"] not in around]
    assert next(record for record in watched if record["event"] == "audited")["verdict"] == report["audit"]
    spent = [record for record in watched if record["event"] == "budget"]
    held = [record for record in watched if record["event"] in ("check", "look")][-1]["held"]
    assert held or spent, "the path ended without success, and did not say that its budget was spent"


def test_the_schedule_went_the_whole_way(played):
    _, _, watched = played
    moves = [record for record in watched if record["event"] == "moved"]
    tree = json.loads((played[0] / "tree.json").read_text())
    source, target = (np.array(node["alpha"]) for node in tree["nodes"])
    way = float(np.linalg.norm(target - source))
    assert abs(sum(move["stride"] for move in moves) - way) < CONFIG.xi + 1e-9
    assert moves[-1]["distance"] < 1e-9
    assert watched[-3]["event"] == "arrived" and watched[-3]["stage"] == "settle", "the last hop was left out"


def test_the_policy_is_the_experts_child(played):
    """Changed exactly if it was trained, and otherwise the expert bit for bit."""
    folder, report, watched = played
    policy, (expert, _) = policy_of(folder), load_expert("adroit", TASKS["061_foam_brick"])
    learned = any(record["event"] == "update" and record["kl"] > 0 for record in watched)
    assert np.array_equal(policy.parameters, expert.parameters) is not learned


def test_the_recording_shows_the_run_and_says_what_it_cost(played):
    """Logging may take 3 % of the wall time; a run this short has hardly any, so curves and ways only are sure."""
    folder, _, watched = played
    shown = {path for chunk in reader_of(folder / "recording.rrd").stream() for path in [chunk.entity_path]}
    assert {"/learning/success", "/learning/sim_epochs", "/evolution/tree/here", "/scene/robot/bones", "/summary"} <= shown
    cost = watched[-1]["cost"]
    assert cost.known >= 2 and cost.size == (folder / "recording.rrd").stat().st_size < 50e6
    assert 0 < cost.seconds < cost.wall


def test_the_summary_is_the_report_in_words(played):
    folder, report, _ = played
    text = (folder / "summary.md").read_text()
    native = report["targets"][TARGET]["native"]
    untrained = report["untrained"][TARGET]
    assert f"| {TARGET} | {untrained['successes']} of 2 | {native['successes']} of {native['episodes']} |" in text
    was = "was" if untrained["success_rate"] < 0.8 else "was not"
    assert f"Training {was} needed for {TARGET} ({untrained['successes']} of 2 untrained)." in text
    assert f"| total | {report['totals']['train_iterations']} | {report['totals']['sim_epochs']} |" in text


@pytest.mark.slow
def test_killed_in_training_and_resumed_is_the_same_run(job, tmp_path, monkeypatch):
    """A copy of the folder, made when an update is on disk and its checkpoint is not, is what a kill leaves there."""
    monkeypatch.setattr("toolkit.transfer.pipeline.load_expert", bent_expert)
    npg = NpgConfig(batch_size=6)
    short = TransferConfig(xi=4.0, check_episodes=2, goal_episodes=2, path_budget=12, check_every=2, npg=npg)
    trained = Job(job.source, job.targets, job.task, short, evaluation_episodes=1)
    whole, killed = tmp_path / "whole", tmp_path / "killed"

    def watch(record):
        if record["event"] == "update" and record["train_iterations"] == 2:
            shutil.copytree(whole, killed)

    report = Pipeline(trained, whole, watch=watch, record=record_run).play()
    assert killed.is_dir(), "nothing was trained, so the test saw nothing"
    again = Pipeline(trained, killed, resume=True, record=record_run).play()
    assert timeless(killed) == timeless(whole), "metrics.jsonl differs"
    assert numbers(again) == numbers(report)
    policy = f"{TARGET}.policy.safetensors"
    assert (killed / policy).read_bytes() == (whole / policy).read_bytes()
    assert not np.array_equal(policy_of(whole).parameters, bent_expert("adroit", job.task)[0].parameters)
    assert report["sim_epochs"] == {"path 1": 12} and report["train_iterations"] == {"path 1": 2}
    kept = [{name: [phase.episode(role) and (phase.episode(role).seed, phase.episode(role).update) for role in ROLES]
             for name, phase in load_phases(folder).items()} for folder in (whole, killed)]
    assert kept[0] == kept[1], "a resumed run keeps the same episodes to be seen"


@pytest.mark.slow
def test_a_finished_run_resumed_reports_the_same(played, job):
    """Last, since it adds to the folder."""
    folder, report, _ = played
    before = timeless(folder)
    again = Pipeline(job, folder, resume=True, record=record_run).play()
    assert numbers(again) == numbers(report) and again["wall_s"] >= 0
    assert timeless(folder) == before, "a finished run wrote more metrics"


def test_another_job_cannot_resume_the_run(played, job):
    other = Job(job.source, job.targets, job.task, CONFIG, evaluation_episodes=3)
    with pytest.raises(ToolkitError, match="evaluation_episodes = 2, not 3"):
        Pipeline(other, played[0], resume=True)


def test_a_run_of_other_robots_cannot_be_resumed(played, job, tmp_path):
    """Its alphas would be read as those of today's robots, whatever has been added to these or measured anew."""
    def shortened(alpha):
        return alpha[:-1]

    def moved(alpha):
        return [alpha[0] + (0.01 if alpha[0] < 0.5 else -0.01), *alpha[1:]]

    for change in (shortened, moved):
        folder = tmp_path / change.__name__
        shutil.copytree(played[0], folder)
        tree = json.loads((folder / "tree.json").read_text())
        for node in tree["nodes"]:
            node["alpha"] = change(node["alpha"])
        (folder / "tree.json").write_text(json.dumps(tree))
        with pytest.raises(ToolkitError, match=f"{change.__name__} was begun with another {job.source.name}.*have changed since.*go on by"):
            Pipeline(job, folder, resume=True)

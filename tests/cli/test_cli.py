"""The command line: bad input gets one sentence and exit status 2, --json keeps its contract, --help answers at once."""

import json
import re
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

import toolkit.transfer.pipeline
from toolkit import cli
from toolkit.cli import main
from toolkit.cli.names import TARGETS, TASK, find_task
from toolkit.runs.run import Run

COMMANDS = (
    "robots", "match", "tree", "audit", "expert", "transfer", "evaluate", "view", "report", "morph", "export", "verify", "stress",
    "deploy", "twin", "doctor", "recordings", "bench",
)
POINTS = {
    "source": {"name": "hand", "alpha": [0.0, 0.0, 0.0]},
    "targets": [{"name": "left", "alpha": [0.8, 0.6, 0.2]}, {"name": "right", "alpha": [0.8, 0.2, 0.9]}],
}
HEAVY = ("torch", "robosuite", "mujoco", "numba", "pinocchio", "rerun", "scipy", "matplotlib")


@pytest.fixture(autouse=True)
def at_home(tmp_path, monkeypatch):
    """Every command runs in a folder of its own."""
    monkeypatch.chdir(tmp_path)


@pytest.fixture
def learner(monkeypatch):
    """An untrained learner instead of the shipped expert, which these tests do not need."""
    from toolkit.expert.training import new_learner
    from toolkit.transfer import pipeline

    monkeypatch.setattr(pipeline, "load_expert", lambda source, task, name: new_learner(task, 0))


@pytest.fixture
def trained(tmp_path):
    """A run folder with a policy for kinova3, as `evaluate` and `export` want it."""
    from toolkit.expert.training import new_learner

    run = Run.create(tmp_path / "trained", {"source": "adroit", "targets": ["kinova3", "iiwa"], "task": TASK})
    new_learner(find_task(TASK), 0)[0].save(run.path / "kinova3.policy.safetensors")
    return "trained"


def answer(capsys, *arguments):
    """The one JSON object that a command prints, and nothing but it."""
    main([*map(str, arguments), "--json"])
    out, _ = capsys.readouterr()
    assert len(out.splitlines()) == 1, out[:500]
    return json.loads(out)


def refusal(capsys, *arguments):
    """What a command says on stderr when it refuses: one sentence, exit status 2, nothing on stdout."""
    with pytest.raises(SystemExit) as stop:
        main([*map(str, arguments)])
    out, err = capsys.readouterr()
    assert stop.value.code == 2, f"exit status {stop.value.code}: {err}"
    assert out == "" and len(err.splitlines()) == 1, f"{arguments} said:\n{out}{err}"
    assert err.startswith("meta-evolve: ") and "Traceback" not in err
    return err.removeprefix("meta-evolve: ").strip()


def shell(*arguments):
    return subprocess.run([sys.executable, "-m", "toolkit.cli", *arguments], capture_output=True, text=True, timeout=120)


@pytest.fixture
def importable(monkeypatch):
    """Child processes find the packages also when they are not installed."""
    monkeypatch.setenv("PYTHONPATH", str(Path(cli.__file__).parents[2]))


# -- names ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("command", ["match", "tree", "transfer", "expert"])
def test_an_unknown_source_is_named(capsys, command):
    said = refusal(capsys, command, "--source", "panda9000")
    assert "'panda9000' is unknown" in said and "adroit, iiwa, jaco, kinova3" in said


@pytest.mark.parametrize("command", ["match", "tree", "transfer"])
def test_an_unknown_target_is_named(capsys, command):
    assert "'panda9000' is unknown" in refusal(capsys, command, "--targets", "jaco", "panda9000")


@pytest.mark.parametrize("command", ["transfer", "expert"])
def test_an_unknown_task_is_named(capsys, command):
    assert "'juggle' is unknown; there are: 061_foam_brick" in refusal(capsys, command, "--task", "juggle")


def test_an_unknown_preset_is_named(capsys):
    assert refusal(capsys, "transfer", "--preset", "heroic") == "preset 'heroic' is unknown; there are: quick, full, paper"


@pytest.mark.parametrize("command", ["match", "tree", "transfer"])
def test_a_source_among_the_targets_is_refused(capsys, learner, command):
    said = refusal(capsys, command, "--source", "adroit", "--targets", "jaco", "adroit")
    assert said == "'adroit' is both source and target; leave it out of the targets"


def test_a_source_without_an_expert_gets_the_command_that_trains_one(capsys):
    said = refusal(capsys, "transfer", "--source", "jaco", "--targets", "iiwa")
    assert said.endswith(f"train one with: meta-evolve expert --source jaco --task {TASK}")


def test_a_robot_named_twice_is_refused(capsys, learner):
    assert "name each once" in refusal(capsys, "transfer", "--targets", "jaco", "jaco")


@pytest.mark.parametrize("option, value", [("--kind", "star"), ("--metric", "l3"), ("--step", "leap"), ("--seed", "x")])
def test_values_outside_a_choice_are_named(capsys, option, value):
    with pytest.raises(SystemExit) as stop:
        main(["transfer", option, value])
    out, err = capsys.readouterr()
    assert stop.value.code == 2 and out == "" and f"'{value}'" in err and "Traceback" not in err


# -- run folders ---------------------------------------------------------------------------------------------


def test_a_used_run_folder_asks_for_resume(capsys, learner, tmp_path):
    (tmp_path / "used").mkdir()
    (tmp_path / "used" / "notes.txt").write_text("mine")
    said = refusal(capsys, "transfer", "--run", "used")
    assert said == "run folder used exists; add --resume to continue it, or choose another --run"
    assert [file.name for file in (tmp_path / "used").iterdir()] == ["notes.txt"]


def test_resuming_what_is_not_there_says_so(capsys, learner):
    assert "run folder nowhere does not exist" in refusal(capsys, "transfer", "--run", "nowhere", "--resume")


@pytest.mark.parametrize(
    "asked, said",
    [(["--seed", "1"], "transfer.seed = 0, not 1"), (["--metric", "l2"], "transfer.metric = l1, not l2"),
     (["--targets", "jaco"], "targets = ['kinova3', 'iiwa'], not ['jaco']"),
     (["--expert", "adroit-061_foam_brick"], "expert = adroit-061_foam_brick-wide-recordings, not adroit-061_foam_brick"),
     (["--preset", "paper", "--targets", "kinova3", "iiwa"], "transfer.step = adaptive, not fixed")],
)
def test_resuming_with_another_config_names_the_difference(capsys, learner, asked, said):
    from robots import ROBOTS
    from tasks import TASKS
    from toolkit.expert.shelf import taught_by_hands
    from toolkit.transfer.pipeline import PRESETS, Job, transfer_config

    started = transfer_config("quick", "steiner", "l1", 0)
    goals = tuple(ROBOTS[name] for name in PRESETS["quick"]["targets"])
    job = Job(ROBOTS["adroit"], goals, TASKS[TASK], started, PRESETS["quick"]["evaluation_episodes"], taught_by_hands("adroit", TASK))
    Run.create("started", job.config())
    assert said in refusal(capsys, "transfer", "--run", "started", "--resume", *asked)


@pytest.mark.parametrize("targets", [["jaco", "adroit"], ["jaco", "jaco"], []])
def test_a_refused_transfer_leaves_no_folder(capsys, learner, tmp_path, targets):
    refusal(capsys, "transfer", "--run", "run", "--targets", *targets)
    assert not (tmp_path / "run").exists(), sorted(file.name for file in (tmp_path / "run").iterdir())


# -- evaluate, view, export ----------------------------------------------------------------------------------


def test_evaluating_what_is_no_run(capsys, tmp_path):
    (tmp_path / "folder").mkdir()
    assert "holds no config.json, so it is not a run folder" in refusal(capsys, "evaluate", "folder")
    assert "nowhere does not exist" in refusal(capsys, "evaluate", "nowhere")


def test_evaluating_a_torn_config(capsys, trained):
    (Path(trained) / "config.json").write_text('{"source": "adr')
    assert "truncated or damaged" in refusal(capsys, "evaluate", trained)


def test_evaluating_before_the_policy_is_there_says_how_to_finish(capsys, trained):
    said = refusal(capsys, "evaluate", trained, "--target", "iiwa")
    assert said.endswith(f"finish it with: meta-evolve transfer --run {trained} --resume")


def test_evaluating_an_expert_before_it_is_trained_says_how_to_finish(capsys):
    Run.create("expert", {"source": "adroit", "task": TASK, "demos": None})
    assert "finish it with its own command and --resume" in refusal(capsys, "evaluate", "expert")


def test_an_expert_has_one_target_its_source(capsys):
    name = f"adroit-{TASK}"
    assert refusal(capsys, "evaluate", name, "--target", "iiwa") == f"target 'iiwa' is not in {name}; it has: adroit"
    assert "task 'juggling' is unknown" in refusal(capsys, "evaluate", name, "--task", "juggling")


@pytest.mark.parametrize("kept", ["name", "folder"])
def test_an_expert_is_evaluated_by_name_and_from_its_run_folder(capsys, monkeypatch, kept):
    from toolkit.evaluation import success as evaluation
    from toolkit.expert.shelf import load_expert

    policy, _ = load_expert("adroit", find_task(TASK))
    Run.create("expert", {"source": "adroit", "task": TASK, "demos": None})
    policy.save(Path("expert/adroit.policy.safetensors"))
    asked = []

    def played(policy, robot, task, episodes, seed, progress, cluster):
        asked.append((policy.parameters, robot.name, task.name))
        return evaluation.Evaluation(robot.name, "native", episodes, episodes, 0, seed)

    monkeypatch.setattr(evaluation, "evaluate_native", played)
    found = answer(capsys, "evaluate", f"adroit-{TASK}" if kept == "name" else "expert", "--task", f"{TASK}-wide", "--native")
    assert (found["target"], found["env"], found["episodes"]) == ("adroit", "native", 100)
    (parameters, robot, task), = asked
    assert (robot, task) == ("adroit", f"{TASK}-wide")
    np.testing.assert_array_equal(parameters, policy.parameters)


def test_evaluating_a_damaged_policy(capsys, trained):
    file = Path(trained) / "kinova3.policy.safetensors"
    file.write_bytes(file.read_bytes()[:-40])
    assert "is damaged" in refusal(capsys, "evaluate", trained, "--target", "kinova3")


@pytest.mark.parametrize("arguments", [["evaluate"], ["export", "--out", "bundle"]])
def test_an_unknown_target_of_a_run_is_named(capsys, trained, arguments):
    said = refusal(capsys, arguments[0], trained, "--target", "panda9000", *arguments[1:])
    assert said == f"target 'panda9000' is not in {trained}; it has: kinova3, iiwa"
    assert not Path("bundle").exists()


def test_viewing_what_has_no_recording(capsys, trained):
    assert f"no recording at {trained}" in refusal(capsys, "view", trained)
    assert "make it with --rebuild" in refusal(capsys, "view", trained)


@pytest.mark.parametrize("option, name", [("--still", "a.jpg"), ("--still", "a"), ("--video", "a.avi"), ("--video", "a")])
def test_a_picture_or_film_that_cannot_be_is_refused_before_the_work(capsys, trained, option, name):
    said = refusal(capsys, "view", trained, option, name)
    assert f"cannot be written to {name}; name a {'.png file' if option == '--still' else '.mp4 or .gif file'}" in said
    assert not Path(name).exists()


def test_viewing_needs_one_run_or_two_to_compare(capsys, trained):
    assert "takes one run folder" in refusal(capsys, "view", trained, trained)
    assert "compare two targets" in refusal(capsys, "view", trained, "--compare", "kinova3")


@pytest.mark.parametrize("command", [["view", "nowhere", "--rebuild"], ["report", "nowhere"]])
def test_looking_at_what_is_no_run(capsys, command):
    assert "nowhere does not exist" in refusal(capsys, *command)


def test_following_waits_for_a_run_that_is_still_to_begin(capsys, monkeypatch):
    """A Ctrl-C while it waits is no failure; a folder of something else is refused at once."""
    Run.create("other", {"colour": "green"})
    assert "no transfer's run folder" in refusal(capsys, "view", "other", "--live")

    def interrupted(seconds):
        raise KeyboardInterrupt

    monkeypatch.setattr(time, "sleep", interrupted)
    main(["view", "nowhere", "--live"])
    said = capsys.readouterr().out
    assert "waiting for the transfer of nowhere to begin" in said and "stopped looking" in said and not Path("nowhere").exists()


@pytest.mark.parametrize("arguments", [["evaluate"], ["export", "--target", "kinova3", "--out", "bundle"]])
def test_a_config_of_something_else_is_refused(capsys, arguments):
    Run.create("other", {"colour": "green"})
    refusal(capsys, arguments[0], "other", *arguments[1:])


@pytest.mark.parametrize("option, value", [("--episodes", 0), ("--episodes", -3), ("--seed", -2000)])
def test_an_evaluation_of_nothing_is_refused(capsys, trained, option, value):
    assert str(value) in refusal(capsys, "evaluate", trained, "--target", "kinova3", "--native", "--episodes", 1, option, value)


@pytest.mark.parametrize("arguments", [["evaluate"], ["export", "--target", "kinova3", "--out", "bundle"]])
def test_advice_fits_the_command(capsys, arguments):
    assert "--resume" not in refusal(capsys, arguments[0], "nowhere", *arguments[1:])


@pytest.mark.parametrize("arguments", [["evaluate", "nowhere"], ["match", "--source", "panda9000"]], ids=lambda arguments: arguments[0])
def test_a_terminal_sees_one_sentence(importable, arguments):
    """In a process of its own, where nothing has been imported yet."""
    done = shell(*arguments)
    assert done.returncode == 2 and done.stdout == ""
    assert len(done.stderr.splitlines()) == 1, done.stderr


# -- tree ----------------------------------------------------------------------------------------------------


@pytest.fixture
def points(tmp_path):
    (tmp_path / "points.json").write_text(json.dumps(POINTS))
    return "points.json"


def check_tree(found, source, targets):
    """The contract of `tree --json`, and that it is a tree which joins them all."""
    keys = {"metric", "kind", "length", "optimal", "lower_bound", "nodes", "edges"}
    assert keys <= found.keys(), keys - found.keys()
    kinds = {node["name"]: node["kind"] for node in found["nodes"]}
    assert [name for name, kind in kinds.items() if kind == "source"] == [source]
    assert {name for name, kind in kinds.items() if kind == "target"} == set(targets)
    assert set(kinds.values()) <= {"source", "target", "meta"} and len(found["edges"]) == len(kinds) - 1
    alpha = {node["name"]: np.array(node["alpha"]) for node in found["nodes"]}
    for edge in found["edges"]:
        order = 1 if found["metric"] == "l1" else 2
        assert edge["length"] == pytest.approx(np.linalg.norm(alpha[edge["to"]] - alpha[edge["from"]], order), abs=1e-9)
    assert {edge["to"] for edge in found["edges"]} == set(kinds) - {source}
    assert found["length"] == pytest.approx(sum(edge["length"] for edge in found["edges"]))


@pytest.mark.parametrize("kind", ["steiner", "geometric-median", "independent"])
@pytest.mark.parametrize("metric", ["l1", "l2"])
def test_a_tree_of_points(capsys, points, kind, metric):
    found = answer(capsys, "tree", "--points", points, "--kind", kind, "--metric", metric)
    assert (found["kind"], found["metric"]) == (kind, metric)
    check_tree(found, "hand", ["left", "right"])


def test_a_tree_in_words_and_as_a_picture(capsys, points):
    main(["tree", "--points", points, "--plot", "tree.png"])
    out, _ = capsys.readouterr()
    assert "proven shortest" in out and "ratio 1.52" in out
    assert Path("tree.png").read_bytes().startswith(b"\x89PNG")


def test_a_tree_of_points_as_its_targets_join(capsys, points):
    found = answer(capsys, "tree", "--points", points, "--growth")
    assert [cost["length"] for cost in found["growth"]] == pytest.approx([1.6, 2.3]) and found["length"] == pytest.approx(2.3)
    assert "leave out --points or --arms" in refusal(capsys, "tree", "--points", points, "--arms")
    assert "effort is -1" in refusal(capsys, "tree", "--points", points, "--effort", "-1")
    main(["tree", "--points", points, "--growth"])
    assert "Targets joining one by one" in capsys.readouterr().out


def test_ticks_are_timed(capsys):
    found = answer(capsys, "bench", "tick", "kinova3", "--ticks", "100")
    assert found["bundle"] == "kinova3" and found["ticks"] == 100 and list(found["forms"]) == ["osc", "pose", "joint"]
    for row in found["forms"].values():
        assert 0 < row["observe_ms"] < row["p50_ms"] <= row["p99_ms"] <= row["max_ms"]
    assert "ticks is 5" in refusal(capsys, "bench", "tick", "--ticks", "5")


@pytest.mark.slow
def test_trees_are_timed(capsys):
    found = answer(capsys, "bench", "tree", "--terminals", "4", "8", "--dimensions", "20", "--longer", "2")
    assert [(t["metric"], t["terminals"], t["optimal"]) for t in found["trees"]] == [
        ("l1", 4, True), ("l1", 8, True), ("l2", 4, True), ("l2", 8, False),
    ]
    for timing in found["trees"]:
        assert timing["seconds"] > 0 and timing["length"] >= timing["best_known"] > 0 and timing["excess"] >= 0
        assert timing["gap"] == pytest.approx(max(0, 1 - timing["lower_bound"] / timing["length"]))
    assert "terminals are 1" in refusal(capsys, "bench", "tree", "--terminals", "1")
    assert "dimensions is 0" in refusal(capsys, "bench", "tree", "--dimensions", "0")


def test_truncated_points_are_refused(capsys, points):
    Path(points).write_text(json.dumps(POINTS)[:60])
    assert refusal(capsys, "tree", "--points", points).startswith("points.json is not JSON")


@pytest.mark.parametrize(
    "text, said",
    [("[]", "points.json"), ('{"source": {"name": "a", "alpha": [0, 2]}, "targets": [{"name": "b", "alpha": [0, 1]}]}', "alpha[1]"),
     ('{"source": {"name": "a", "alpha": [0]}, "targets": []}', "list at least one robot"), (None, "cannot be read")],
)
def test_other_points_are_refused(capsys, points, text, said):
    if text is None:
        Path(points).unlink()
    else:
        Path(points).write_text(text)
    assert said in refusal(capsys, "tree", "--points", points)


def test_a_picture_of_an_unknown_kind_is_refused(capsys, points):
    assert "name a .png or .svg file" in refusal(capsys, "tree", "--points", points, "--plot", "tree.foo")


# -- JSON of what is real ------------------------------------------------------------------------------------


def test_robots(capsys):
    from robots import ROBOTS
    from tasks import MODEL_TASKS, TASKS

    found = answer(capsys, "robots")
    assert {row["name"] for row in found["robots"]} == set(ROBOTS) and set(found["tasks"]) == {*TASKS, *MODEL_TASKS}
    assert {row["name"] for row in found["robots"] if row["role"] == "source"} == {"adroit"}
    main(["robots"])
    out, _ = capsys.readouterr()
    assert all(name in out for name in ROBOTS)


@pytest.fixture
def lab(monkeypatch, space, merged, task):
    """The tests' own merged robot, for commands that would merge the same robots again."""
    from robots import ROBOTS
    from toolkit.morphology.lab import Lab

    made = Lab.__new__(Lab)
    made.source, *targets = (ROBOTS[name] for name in space.matching.names)
    made.targets, made.task, made.space, made.merged = tuple(targets), task, space, merged

    def same(source, targets, what):
        assert [source.name, *(robot.name for robot in targets)] == list(space.matching.names) and what == task
        return made

    monkeypatch.setattr(toolkit.morphology.lab, "Lab", same)
    return made


def test_the_tree_of_the_robots(capsys, monkeypatch, space):
    """With what the tree would cost for the hand on the other arms, and as the targets join."""
    import toolkit.morphology.survey

    made = []

    def as_points(robots, task=None):
        made.append([robot.name for robot in robots])
        points = {name: toolkit.morphology.survey.Terminal(name, space.beta(name)) for name in space.matching.names}
        # the hand on another arm stands where the source does, a little aside
        return [points.get(r.name, toolkit.morphology.survey.Terminal(r.name, 0.9 * points["adroit"].alpha + 0.05)) for r in robots]

    monkeypatch.setattr(toolkit.morphology.survey, "as_points", as_points)
    found = answer(capsys, "tree", "--arms", "--growth")
    check_tree(found, "adroit", TARGETS)
    assert found["optimal"] and all(len(node["alpha"]) == space.size for node in found["nodes"])
    assert made == [["adroit", *TARGETS], ["adroit", "adroit_on_jaco", "adroit_on_iiwa", *TARGETS]]
    lengths = [cost["length"] for cost in found["arms"]]
    assert lengths == sorted(lengths) and {cost["arm"] for cost in found["arms"]} == {"Kinova3", "Jaco", "IIWA"}
    assert [cost["targets"] for cost in found["growth"]] == [list(TARGETS[:1]), list(TARGETS[:2]), list(TARGETS)]
    assert found["growth"][-1]["length"] == found["length"]


@pytest.mark.slow
def test_the_audit_of_the_robots(capsys, lab, tmp_path):
    """Two robots per edge are its ends, and the refined ones; test_capability.py holds what they must be able to do."""
    names = lab.space.matching.names
    found = answer(capsys, "audit", "--targets", *names[1:], "--kind", "independent", "--robots", "2", "--episodes", "0", "--no-causes",
                   "--plot", tmp_path / "audit.svg")
    assert [(edge["from"], edge["to"]) for edge in found["edges"]] == [(names[0], name) for name in names[1:]]
    for edge in found["edges"]:
        shares = [robot["share"] for robot in edge["robots"]]
        assert shares == sorted(shares) and (shares[0], shares[-1]) == (0.0, 1.0) and len(shares) > 3
        assert {"share", "grip_n", "balance", "height_mm", "opening_mm", "closing_steps", "script"} <= set(edge["robots"][0])
        assert all(set(violation) == {"share", "quantity", "value", "allowed", "cause"} for violation in edge["violations"])
    assert (tmp_path / "audit.svg").read_text().count("adroit") >= len(names) - 1
    assert "2 robots per edge or more" in refusal(capsys, "audit", "--targets", *names[1:], "--robots", "1")


@pytest.mark.slow
def test_the_match_of_the_robots(capsys, lab):
    """Parity is measured, 4 s per robot, so here for two of them; test_parity.py holds the figures of all."""
    lab.targets = lab.targets[:1]
    found = answer(capsys, "match", "--theta", "--episodes", "2")
    assert [(row["env"], row["episodes"]) for row in found["expert"]] == [("merged", 2), ("native-compiled", 2)]
    assert found["expert"][0]["seed"] == found["expert"][1]["seed"]
    assert found["dropped_meshes"]["kinova3"] > 0 == found["dropped_meshes"]["adroit"] and 0.0 < found["become_ms"] < 1e3
    assert found["source"] == "adroit" and found["D"] == lab.space.size
    assert [row["name"] for row in found["robots"]] == list(lab.space.matching.names[:2])
    figures = {
        "arm_fk_error_m", "arm_mass_matrix_rel_error", "pad_position_error_m", "pad_angle_error_deg", "pad_force_rel_error",
    }
    for row in found["robots"]:
        assert figures <= row.keys(), figures - row.keys()
        assert all(isinstance(row[key], float) and np.isfinite(row[key]) for key in figures), row
    assert len(found["theta"]) == found["parameters"]


@pytest.mark.slow
def test_doctor(capsys):
    try:
        main(["doctor", "--json"])
        status = 0
    except SystemExit as stop:
        status = stop.code
    found = json.loads(capsys.readouterr().out)["checks"]
    assert all({"name", "ok", "detail", "mend"} == row.keys() and row["ok"] in (True, False, None) for row in found)
    assert {"python", "mujoco", "robosuite", "torch"} <= {row["name"] for row in found}
    assert status == (1 if any(row["ok"] is False for row in found) else 0)
    assert all(row["mend"] for row in found if row["ok"] is False), "a broken thing without a word on how to mend it"


# -- help ----------------------------------------------------------------------------------------------------


def test_help_answers_at_once(importable):
    shell("--help")  # a fresh environment compiles its modules once
    start = time.perf_counter()
    done = shell("--help")
    seconds = time.perf_counter() - start
    assert done.returncode == 0 and seconds < 3.0, f"--help took {seconds:.1f} s"
    listed = set(re.findall(r"• (\w+)", done.stdout))
    assert set(COMMANDS) <= listed, set(COMMANDS) - listed


def test_no_help_loads_anything_heavy(importable):
    program = f"""
import sys, time
from toolkit.cli import main
for command in {COMMANDS!r}:
    start = time.perf_counter()
    try:
        main([command, "--help"])
    except SystemExit as stop:
        assert not stop.code, command
    assert time.perf_counter() - start < 3.0, command
print([name for name in {HEAVY!r} if name in sys.modules], file=sys.stderr)
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
    assert done.stderr.strip() == "[]", f"--help loads {done.stderr}"
    assert done.stdout.count("usage: meta-evolve ") == len(COMMANDS)


def test_every_command_of_the_contract_is_there(importable):
    done = shell("--help")
    assert {"deploy", "bench"} <= set(re.findall(r"• (\w+)", done.stdout))


def test_no_command_is_the_help(capsys):
    main([])
    bare, _ = capsys.readouterr()
    main(["--help"])
    assert bare == capsys.readouterr().out and "usage: meta-evolve" in bare


def test_the_version_is_said(capsys):
    from toolkit import __version__

    main(["--version"])
    assert capsys.readouterr().out == f"meta-evolve {__version__}\n"


@pytest.mark.parametrize("typed, meant", [("trnasfer", "transfer"), ("repot", "report"), ("docter", "doctor")])
def test_a_mistyped_command_is_guessed(capsys, typed, meant):
    assert refusal(capsys, typed) == f"{typed!r} is no command; did you mean: meta-evolve {meant}"


def test_what_resembles_no_command_is_sent_to_the_help(capsys):
    assert refusal(capsys, "xyzzy") == "'xyzzy' is no command; meta-evolve --help lists them"


@pytest.mark.parametrize("command", [*COMMANDS[:-2], "replay", "recordings retarget", "bench transfer", "bench engine", "bench fuzz"])
def test_help_says_what_to_give_and_no_more(capsys, command):
    """No default that is nothing, one form of every switch, lines as wide as the terminal and not as wide as the source."""
    main([*command.split(), "--help"])
    out, _ = capsys.readouterr()
    assert "None" not in out and "--no-json" not in out and "(default: )" not in out and "(default: False)" not in out


def test_help_keeps_defaults_that_say_something(capsys):
    main(["transfer", "--help"])
    out = " ".join(capsys.readouterr().out.replace("│", " ").split())
    assert "--seed INT of everything random. (default: 0)" in out and "--xi FLOAT" in out
    assert "first an offset of what the policy sees, held for an episode" in out


@pytest.mark.parametrize("width", [40, 200])
def test_a_narrow_terminal_breaks_no_name(capsys, monkeypatch, width):
    """On a terminal of any width every name of a table is there in one piece."""
    import rich.console

    from robots import ROBOTS

    monkeypatch.setattr(rich.console.Console, "is_terminal", True)
    monkeypatch.setenv("COLUMNS", str(width))
    main(["robots"])
    out = re.sub(r"\x1b\[[0-9;]*m", "", capsys.readouterr().out).split("Tasks:")[0]
    assert max(map(len, out.splitlines())) <= width
    for robot in ROBOTS.values():
        assert robot.name in out.split() and robot.gripper.robosuite_type in out.split(), out


def test_a_document_is_drawn_on_a_terminal_alone(capsys, monkeypatch):
    import rich.console

    from toolkit.cli.terminal import document

    text = "# adroit to jaco\n\n| target | unmodified robot |\n|---|---|\n| jaco | 3 of 4 |\n"
    document(text)
    assert capsys.readouterr().out == text + "\n", "a file gets Markdown"
    monkeypatch.setattr(rich.console.Console, "is_terminal", True)
    document(text)
    out = capsys.readouterr().out
    assert "|---|" not in out and "3 of 4" in out and "─" in out


# -- stopped -------------------------------------------------------------------------------------------------


def test_ctrl_c_is_no_traceback(capsys, monkeypatch, points):
    from toolkit import evolution

    def stopped(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(evolution, "load_points", stopped)
    with pytest.raises(SystemExit) as stop:
        main(["tree", "--points", points])
    out, err = capsys.readouterr()
    assert stop.value.code == 130 and out == "" and err == "meta-evolve: stopped\n", "a tree leaves nothing to go on with"


@pytest.mark.parametrize("given", [[], ["--resume"]])
def test_ctrl_c_says_the_whole_command_that_goes_on(capsys, monkeypatch, given):
    from toolkit.transfer import pipeline

    def stopped(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(pipeline, "Pipeline", stopped)
    with pytest.raises(SystemExit) as stop:
        main(["transfer", "--targets", "jaco", "--run", "my run", *given])
    assert stop.value.code == 130
    assert capsys.readouterr().err == "meta-evolve: stopped; continue with: meta-evolve transfer --targets jaco --run 'my run' --resume\n"


def test_an_unfinished_run_is_continued_by_the_command_that_started_it(capsys, monkeypatch, trained):
    """Quoted anew, whatever the file says: it may come from anywhere."""
    from toolkit.transfer import pipeline

    class Stopped:
        def __init__(self, *_):
            self.run = Run.open(trained)

        def play(self):
            raise KeyboardInterrupt

    monkeypatch.setattr(pipeline, "Pipeline", Stopped)
    with pytest.raises(SystemExit):
        main(["transfer", "--targets", "kinova3", "iiwa", "--seed", "3", "--run", trained])
    capsys.readouterr()
    said = refusal(capsys, "evaluate", trained, "--target", "iiwa")
    assert said.endswith(f"finish it with: meta-evolve transfer --targets kinova3 iiwa --seed 3 --run {trained} --resume")
    Path(trained, "command.json").write_text('{"words": ["transfer", "; rm -r $HOME"]}')
    assert refusal(capsys, "evaluate", trained, "--target", "iiwa").endswith(
        f"meta-evolve transfer '; rm -r $HOME' --run {trained} --resume")


# -- recordings ------------------------------------------------------------------------------------------------


def test_a_standin_is_made_listed_and_refused_when_broken(capsys):
    made = answer(capsys, "recordings", "make", "hands", "--objects", TASK, "--each", 2, "--frames", 10)
    assert made["synthetic"] and len(made["recordings"]) == 2 and 0 < made["bytes"] < 10**6
    listed = answer(capsys, "recordings", "list", "hands", "--frame-rate", 30)
    assert [row["recording"] for row in listed["recordings"]] == made["recordings"] and listed["broken"] == []
    assert {row["object"] for row in listed["recordings"]} == {TASK} and listed["recordings"][0]["seconds"] == pytest.approx(0.33)
    assert "hands exists and is not an empty folder" in refusal(capsys, "recordings", "make", "hands")
    assert "cup" in refusal(capsys, "recordings", "make", "more", "--objects", "cup")
    (Path("hands") / made["recordings"][0] / "pose.npz").unlink()
    with pytest.raises(SystemExit) as stop:
        main(["recordings", "list", "hands", "--json"])
    out, err = capsys.readouterr()
    listed = json.loads(out)
    assert stop.value.code == 2 and "pose.npz: expected a file, found none" in err
    assert [row["recording"] for row in listed["recordings"]] == made["recordings"][1:] and len(listed["broken"]) == 1


@pytest.mark.parametrize("command", [("list", "nowhere"), ("retarget", "nowhere")])
def test_a_folder_without_recordings_is_said(capsys, command):
    assert "expected folders <subject>/<time>/meta.yml, found none" in refusal(capsys, "recordings", *command)


def test_an_expert_of_nothing_is_refused(capsys):
    assert "give at least one episode" in refusal(capsys, "expert", "--episodes", 0)
    assert "found none" in refusal(capsys, "expert", "--demos", "nowhere")

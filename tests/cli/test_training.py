"""transfer and expert: what cannot be is refused before the work and leaves no folder; what was stopped says how it goes on."""

from pathlib import Path

import pytest
from command_line import refusal

from toolkit.cli import main
from toolkit.cli.names import TASK
from toolkit.runs.run import Run

pytestmark = pytest.mark.usefixtures("at_home")


def test_an_unknown_preset_is_named(capsys):
    assert refusal(capsys, "transfer", "--preset", "heroic") == "preset 'heroic' is unknown; there are: quick, full, paper"


def test_a_source_without_an_expert_gets_the_command_that_trains_one(capsys):
    said = refusal(capsys, "transfer", "--source", "jaco", "--targets", "iiwa")
    assert said.endswith(f"train one with: meta-evolve expert --source jaco --task {TASK}")


@pytest.mark.parametrize("option, value", [("--kind", "star"), ("--metric", "l3"), ("--step", "leap"), ("--seed", "x")])
def test_values_outside_a_choice_are_named(capsys, option, value):
    with pytest.raises(SystemExit) as stop:
        main(["transfer", option, value])
    out, err = capsys.readouterr()
    assert stop.value.code == 2 and out == "" and f"'{value}'" in err and "Traceback" not in err


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


def test_an_expert_of_nothing_is_refused(capsys):
    assert "give at least one episode" in refusal(capsys, "expert", "--episodes", 0)
    assert "found none" in refusal(capsys, "expert", "--demos", "nowhere")

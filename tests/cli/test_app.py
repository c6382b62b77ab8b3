"""The command line as a whole: its commands, its help at once, one sentence for what is no command, and Ctrl-C."""

import re
import subprocess
import sys
import time

import pytest
from command_line import COMMANDS, refusal, shell

from toolkit.cli import main

pytestmark = pytest.mark.usefixtures("at_home")
HEAVY = ("torch", "robosuite", "mujoco", "numba", "pinocchio", "rerun", "scipy", "matplotlib")


@pytest.mark.parametrize("arguments", [["evaluate", "nowhere"], ["match", "--source", "panda9000"]], ids=lambda arguments: arguments[0])
def test_a_terminal_sees_one_sentence(importable, arguments):
    """In a process of its own, where nothing has been imported yet."""
    done = shell(*arguments)
    assert done.returncode == 2 and done.stdout == ""
    assert len(done.stderr.splitlines()) == 1, done.stderr


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


def test_ctrl_c_is_no_traceback(capsys, monkeypatch, points):
    from toolkit import evolution

    def stopped(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(evolution, "load_points", stopped)
    with pytest.raises(SystemExit) as stop:
        main(["tree", "--points", points])
    out, err = capsys.readouterr()
    assert stop.value.code == 130 and out == "" and err == "meta-evolve: stopped\n", "a tree leaves nothing to go on with"

"""The help of a command says what to give, and no more."""

import pytest
from command_line import COMMANDS

from toolkit.cli import main

pytestmark = pytest.mark.usefixtures("at_home")


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

"""Commands given to the command line, and what they answer: one JSON object, or one sentence of refusal."""

import json
import subprocess
import sys

import pytest

from toolkit.cli import main

COMMANDS = (
    "robots", "match", "tree", "audit", "expert", "transfer", "evaluate", "view", "report", "morph", "export", "verify", "stress",
    "deploy", "twin", "doctor", "recordings", "bench",
)
NAMES = (
    "a[/right]", "a[left]", "[bold red]x[/]", "[link=file:///etc]x[/link]", "a|b", "**a**", "_a_",
    "<b>a</b>", "<span onmouseover=x>a</span>",
    "a&amp;b", "a$b$", "$x^$", "$\\frac{", "a\\b", "a`b`", "[a](http://b)", "a b", "'; rm -rf x; '", '"', "$(touch pwned)",
    "a\x1b[31mb", "a\tb",
    "a\nb", "\u202eabc", "\u00e4\u6f22", "%s{x}", "#1", "-x", "~", "*",
)
"""Of robots, runs and files, that a terminal, a page, a picture or a shell could take for something else."""
POINTS = {
    "source": {"name": "hand", "alpha": [0.0, 0.0, 0.0]},
    "targets": [{"name": "left", "alpha": [0.8, 0.6, 0.2]}, {"name": "right", "alpha": [0.8, 0.2, 0.9]}],
}


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

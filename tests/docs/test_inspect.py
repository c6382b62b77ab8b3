"""docs/inspect.md: its pictures are there, its commands are read, and the robot that it breaks on purpose is broken."""

import functools
import json
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest
import tyro

from toolkit.cli import inspection

ROOT = Path(__file__).parents[2]
TEXT = (ROOT / "docs" / "inspect.md").read_text(encoding="utf-8")
COMMANDS = sorted(set(re.findall(r"meta-evolve (?:view|report|morph) [^`\n#]+", TEXT)))


def test_every_picture_is_there():
    pictures = re.findall(r"\]\((images/[^)]+)\)", TEXT)
    assert {"evolution", "morph", "rollouts", "learning", "summary", "compare"} <= {Path(name).stem for name in pictures}
    assert [name for name in pictures if not (ROOT / "docs" / name).is_file()] == []


@pytest.mark.parametrize("command", COMMANDS)
def test_a_command_of_the_page_is_understood(command):
    """Its options are those that the command has, and its values are read."""
    _, name, *arguments = shlex.split(command.strip())
    told = functools.wraps(getattr(inspection, name))(lambda *values, **options: True)
    assert tyro.cli(told, args=arguments)


def test_the_walks_robot_has_fingers_without_friction():
    """In a process of its own: the card is for docs/slippery.py alone."""
    program = (
        "import json, runpy; runpy.run_path('docs/slippery.py')\n"
        "from robots import ROBOTS; from tasks import TASKS; from toolkit.morphology.posture import native_env\n"
        "model = native_env(ROBOTS['greased'], TASKS['061_foam_brick']).sim.model._model\n"
        "names = [model.body(int(body)).name for body in model.geom_bodyid]\n"
        "touching = [(n, f) for n, f, c in zip(names, model.geom_friction.tolist(), model.geom_contype) if c]\n"
        "print(json.dumps({key: [f for n, f in touching if n.startswith(key)] for key in ('gripper0', 'object')}))"
    )
    told = subprocess.run([sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True, check=True).stdout
    found = json.loads(told.splitlines()[-1])
    for key, frictions in found.items():
        assert frictions and all(friction == [0.0, 0.0, 0.0] for friction in frictions), f"{key} still has friction: {frictions}"

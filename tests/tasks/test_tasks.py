"""Tasks are found by themselves."""

import os
import subprocess
import sys
from pathlib import Path


def test_a_task_is_one_file_found_by_itself(tmp_path):
    """A file in tasks/ adds its tasks, and one that does not load is named and costs the others nothing."""
    (tmp_path / "carry.py").write_text(
        "from tasks.objects import OBJECTS\nfrom tasks.pick import PickTask\n"
        "CARRY = PickTask(OBJECTS['061_foam_brick'], goal_offset=(0.0, 0.3, 0.1), title='carry')\n"
    )
    (tmp_path / "spoilt.py").write_text(
        "from tasks.objects import OBJECTS\nfrom tasks.pick import PickTask\nBAD = PickTask(OBJECTS['061_foam_brick'], title='a/b')\n"
    )
    code = (
        "import sys, tasks\ntasks.__path__.append(sys.argv[1])\nfrom toolkit.cli.names import broken_cards, find_task\n"
        "assert find_task('carry').goal_offset[1] == 0.3 and 'carry' in tasks.TASKS and '061_foam_brick' in tasks.TASKS\n"
        "(broken,) = broken_cards()\nassert 'a card in tasks/ does not load' in broken and 'tasks/spoilt.py' in broken, broken\n"
    )
    environment = os.environ | {"PYTHONPATH": str(Path(__file__).parents[2])}
    done = subprocess.run([sys.executable, "-c", code, str(tmp_path)], capture_output=True, text=True, env=environment)
    assert done.returncode == 0, done.stderr

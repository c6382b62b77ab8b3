"""The public name: what importing it loads, what it offers, and whose files may lie around it."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

import meta_evolve

ROOT = Path(__file__).parents[1]
OURS = ("toolkit", "robots", "grippers", "tasks")


@pytest.fixture
def crowded(tmp_path):
    """A folder with files that have the names of our packages, and say so when they are run."""
    for name in OURS:
        (tmp_path / f"{name}.py").write_text(f"print('the {name} of somebody else')\n")
    return tmp_path


def python(folder, *words):
    """Python in a folder, which it searches first; returns the finished process."""
    return subprocess.run([sys.executable, *words], cwd=folder, env=os.environ | {"PYTHONPATH": str(ROOT)}, capture_output=True, text=True)


def test_the_import_is_silent_and_light(tmp_path):
    """By what is loaded, so that a slow machine changes nothing."""
    heavy = ("torch", "rerun", "robosuite", "mujoco", "scipy", "matplotlib", "onnx", "numba", "tyro")
    done = python(tmp_path, "-c", f"import sys, meta_evolve; sys.exit(' '.join(name for name in {heavy!r} if name in sys.modules))")
    assert (done.stdout, done.stderr.strip()) == ("", ""), f"import meta_evolve loads {done.stderr}"


def test_it_offers_what_it_lists():
    assert {"robots", "match", "tree", "transfer", "evaluate", "export", "make_env"} <= set(meta_evolve.__all__)
    assert all(getattr(meta_evolve, name).__doc__ for name in meta_evolve.__all__ if name != "__version__")


@pytest.mark.slow
def test_cards_and_names_are_alike(task):
    cards = meta_evolve.robots()
    by_card = meta_evolve.tree(cards["adroit"], [cards["kinova3"]])
    assert by_card.length == meta_evolve.tree("adroit", ["kinova3"]).length > 0
    with pytest.raises(meta_evolve.ToolkitError, match="'kinova' is unknown"):
        meta_evolve.match("adroit", ["kinova"], task)


@pytest.mark.parametrize("arguments, said", [
    ({"policy": "kinova3", "robot": "jaco"}, "written in bundle kinova3"), ({"policy": "nowhere"}, "nowhere does not exist"),
    ({"policy": "kinova3", "episodes": 0}, "at least one"),
])
def test_what_cannot_be_evaluated_is_refused(arguments, said):
    with pytest.raises(meta_evolve.ToolkitError, match=said):
        meta_evolve.evaluate(**arguments)


# -- the environment ---------------------------------------------------------------------------------------------------


def test_a_family_plays_in_its_own_environment_and_no_other():
    maze = meta_evolve.tasks()["ant-maze"]
    made = meta_evolve.make_env("ant", maze)
    assert made.observation_space.contains(made.reset(seed=0)[0])
    made.close()
    with pytest.raises(meta_evolve.ToolkitError, match="cannot play task"):
        meta_evolve.make_env("kinova3", maze)


# -- files of the same names -------------------------------------------------------------------------------------------


def test_the_import_passes_files_of_the_same_names(crowded):
    code = "import meta_evolve, robots, toolkit; print(*meta_evolve.robots()); print(robots.__file__, toolkit.__file__)"
    done = python(crowded, "-c", code)
    assert done.returncode == 0 and "somebody else" not in done.stdout, done.stdout + done.stderr
    names, places = done.stdout.splitlines()
    assert "kinova3" in names and places.split() == [str(ROOT / name / "__init__.py") for name in ("robots", "toolkit")]


def test_empty_folders_of_the_same_names_are_passed(tmp_path):
    """Python takes a folder without __init__.py for a package: of meshes, say."""
    for name in OURS:
        (tmp_path / name).mkdir()
    done = python(tmp_path, "-c", "import meta_evolve; print(*meta_evolve.robots())")
    assert done.returncode == 0 and "kinova3" in done.stdout, done.stderr


@pytest.mark.parametrize("module", ["meta_evolve", "toolkit.cli"])
def test_the_command_line_passes_files_of_the_same_names(crowded, module):
    if module == "toolkit.cli":  # python -m runs somebody's toolkit.py before anything of ours
        (crowded / "toolkit.py").unlink()
    done = python(crowded, "-m", module, "robots", "--json")
    assert done.returncode == 0, done.stderr
    assert {"adroit", "kinova3"} <= {row["name"] for row in json.loads(done.stdout)["robots"]}


@pytest.mark.slow
def test_workers_pass_files_of_the_same_names(crowded):
    """They load what the parent sends them, in the parent's folder."""
    done = python(crowded, "-c", "import meta_evolve; print(meta_evolve.evaluate('kinova3', episodes=4, processes=2).episodes)")
    assert done.returncode == 0 and done.stdout == "4\n", done.stdout + done.stderr


@pytest.mark.parametrize("name", ["toolkit", "robots"])
def test_a_file_that_was_imported_before_is_named(crowded, name):
    done = python(crowded, "-c", f"import {name}\nimport meta_evolve")
    assert done.returncode == 1
    assert done.stderr.splitlines()[-1] == (
        f"ImportError: {crowded / name}.py was imported as {name}, the name of a package of meta-evolve; rename that file"
    )

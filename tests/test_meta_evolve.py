"""The public name: what importing it loads, what it offers, and whose files may lie around it."""

import json
import os
import subprocess
import sys
from pathlib import Path

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import meta_evolve
from toolkit.demonstrations.scripts import PickScript
from toolkit.simulation.watching import States

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


@pytest.fixture(scope="module")
def env():
    made = gymnasium.make(meta_evolve.ENVIRONMENT, robot="kinova3", render_mode="rgb_array")
    yield made
    made.close()


@pytest.mark.slow
def test_gymnasium_finds_nothing_wrong(env):
    check_env(env.unwrapped, skip_render_check=False)


def test_a_family_plays_in_its_own_environment_and_no_other():
    maze = meta_evolve.tasks()["ant-maze"]
    made = meta_evolve.make_env("ant", maze)
    assert made.observation_space.contains(made.reset(seed=0)[0])
    made.close()
    with pytest.raises(meta_evolve.ToolkitError, match="cannot play task"):
        meta_evolve.make_env("kinova3", maze)


def test_an_episode_is_the_native_robots(env, native):
    """Same start, same observations, same end as the robot that success is claimed on."""
    script, robot, states = PickScript(), native("kinova3"), States()
    assert robot.play(script, 7, states)
    observation, info = env.reset(seed=7)
    assert info == {"seed": 7}
    rewards, ended = [], False
    while not ended:
        np.testing.assert_array_equal(env.unwrapped.robot.data.qpos, states.qpos[len(rewards)])
        observation, reward, terminated, truncated, info = env.step(np.clip(script(observation), -1, 1))
        rewards.append(reward)
        ended = terminated or truncated
    assert terminated and not truncated and info == {"success": True, "lost": False, "diverged": False}
    assert rewards == [0.0] * (len(states.qpos) - 2) + [1.0]
    named = env.unwrapped.named(observation)
    assert np.linalg.norm(named["goal_from_object"]) < env.unwrapped.task.goal_tolerance
    np.testing.assert_array_equal(np.concatenate(list(named.values())), observation)


def test_the_horizon_truncates_and_a_blown_up_simulation_ends(env):
    idle = np.zeros(env.action_space.shape)
    env.reset(seed=1)
    steps = 0
    while not (ended := env.step(idle))[3]:
        assert not ended[2]
        steps += 1
    assert steps + 1 == env.unwrapped.task.horizon
    env.reset(seed=1)
    env.unwrapped.robot.data.qvel[:] = 1e12
    observation, reward, terminated, _, info = env.step(idle)
    assert terminated and info["diverged"] and reward == 0.0 and np.isfinite(observation).all()


def test_starts_without_a_seed_differ_and_follow_from_the_one_before(env):
    seeds = []
    for _ in range(2):
        env.reset(seed=5)
        seeds.append([env.reset()[1]["seed"] for _ in range(3)])
    assert seeds[0] == seeds[1] and len(set(seeds[0])) == 3


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

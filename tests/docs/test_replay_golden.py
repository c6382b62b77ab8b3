"""docs/replay_golden.py replays a bundle's episode in robosuite without the toolkit, and notices a manifest that is wrong."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
ALONE = """
import runpy, sys
for name in ("toolkit", "tasks", "robots", "grippers", "mink", "torch", "onnxruntime"):
    sys.modules[name] = None  # not to be imported
sys.argv = sys.argv[1:]
runpy.run_path(sys.argv[0], run_name="__main__")
"""


def replay(folder):
    command = [sys.executable, "-I", "-c", ALONE, str(ROOT / "docs" / "replay_golden.py"), str(folder)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=200)
    return done, json.loads(done.stdout.splitlines()[-1]) if done.stdout else {}


@pytest.mark.slow
@pytest.mark.parametrize("name", ["jaco", "kinova3", "iiwa"])
def test_golden_actions_replay_in_robosuite_without_the_toolkit(unpacked, name):
    folder = unpacked(name)
    done, said = replay(folder)
    assert done.returncode == 0, done.stdout + done.stderr
    golden = json.loads((folder / "manifest.json").read_text())["golden"]
    assert golden["success"] and said["steps"] == golden["steps"] - 1 and said["arm_rad"] < 1e-5 and said["object_m"] < 1e-5, said


@pytest.mark.slow
@pytest.mark.parametrize("harm", [
    lambda m: m["simulation"]["actuators"][0].update(start=-m["simulation"]["actuators"][0]["start"]),
    lambda m: m["start"]["arm_rad"].__setitem__(1, m["start"]["arm_rad"][1] + 0.02),
    lambda m: m["task"]["object"].update(half_size_m=[0.03, 0.03, 0.03]),
])
def test_a_replay_from_a_wrong_manifest_fails(unpacked, harm):
    """The script compares: a gripper that starts otherwise, an arm that does, another object are not the recording."""
    folder = unpacked("jaco")
    broken = json.loads((folder / "manifest.json").read_text())
    harm(broken)
    (folder / "manifest.json").write_text(json.dumps(broken))
    done, said = replay(folder)
    assert done.returncode == 1 and said and max(said["arm_rad"], said["object_m"]) > 1e-4, done.stderr

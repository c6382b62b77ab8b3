"""A bundle is whole, acts as the policy does on robosuite's robot, and says in one sentence what is wrong with it."""

import hashlib
import json
import shutil
import subprocess
import sys
import zipfile

import numpy as np
import pytest

from robots import ROBOTS
from tasks.pick import ACTION, ACTION_SIZE, OBSERVATION, OBSERVATION_SCALE, OBSERVATION_SIZE
from toolkit.bundle import FORMAT_VERSION, MANIFEST, check_bundle, load_bundle, write_bundle
from toolkit.errors import ToolkitError
from toolkit.expert import entry_names
from toolkit.learning.policy import GaussianPolicy
from toolkit.morphology.posture import arm_joints

TARGET = "kinova3"
TARGETS = [name for name, robot in ROBOTS.items() if robot.gripper.rate is not None]
CONFIG = {"source": "adroit", "targets": [TARGET], "transfer": {"seed": 3}}


@pytest.fixture(scope="module")
def policy():
    """Random, and restless enough to reach the clip."""
    rng = np.random.default_rng(0)
    policy = GaussianPolicy(entry_names(OBSERVATION), entry_names(ACTION), rng)
    policy.set_parameters(0.4 * rng.standard_normal(len(policy.parameters)))
    policy.set_normalisation(0.1 * rng.standard_normal(OBSERVATION_SIZE), OBSERVATION_SCALE)
    return policy


@pytest.fixture(scope="module")
def exported(policy, task, tmp_path_factory):
    """(folder, manifest) by target; nobody changes the folder."""
    done = {}

    def export(name):
        if name not in done:
            folder = tmp_path_factory.mktemp("bundles") / name
            done[name] = folder, write_bundle(policy, ROBOTS[name], task, CONFIG, folder)
        return done[name]

    return export


@pytest.fixture
def copy(exported, tmp_path):
    """A bundle of one's own, to break."""
    return shutil.copytree(exported(TARGET)[0], tmp_path / "bundle")


def edit(folder, change):
    manifest = json.loads((folder / MANIFEST).read_text())
    change(manifest)
    (folder / MANIFEST).write_text(json.dumps(manifest))


def observations(policy, count, seed=1):
    layers = policy.layers()
    return layers.shift + layers.scale * np.random.default_rng(seed).standard_normal((count, OBSERVATION_SIZE))


# -- what is in it -------------------------------------------------------------------------------------------


def test_a_bundle_reads_back_as_it_was_written(exported, policy):
    folder, manifest = exported(TARGET)
    assert sorted(file.name for file in folder.iterdir()) == ["manifest.json", "policy.onnx", "policy.safetensors"]
    bundle = load_bundle(folder)
    assert bundle.manifest == manifest and manifest["run"] == CONFIG
    assert bundle.policy.record == OBSERVATION
    loaded = GaussianPolicy.load(folder / "policy.safetensors", entry_names(OBSERVATION), entry_names(ACTION))
    np.testing.assert_array_equal(loaded.parameters, policy.parameters)


def test_hashes_are_the_files_own(exported):
    folder, manifest = exported(TARGET)
    for name, digest in manifest["sha256"].items():
        assert hashlib.sha256((folder / name).read_bytes()).hexdigest() == digest


def test_a_zip_of_a_bundle_is_a_bundle(exported, tmp_path, policy):
    folder, manifest = exported(TARGET)
    archive = shutil.make_archive(str(tmp_path / "b"), "zip", folder.parent, folder.name)
    bundle = load_bundle(archive)
    assert bundle.manifest == manifest and check_bundle(bundle)["golden_ok"]


@pytest.mark.parametrize("name", TARGETS)
def test_the_bundle_acts_as_the_policy_does_on_robosuites_robot(exported, native, policy, name):
    bundle, robot = load_bundle(exported(name)[0]), native(name)
    seen = observations(policy, 300)
    found = np.array([bundle(observation) for observation in seen])
    wanted = np.array([robot.robosuite_action(policy.mean(observation)) for observation in seen])
    error = float(np.abs(found - wanted).max())
    assert error <= 1e-5, f"{name}: the bundle's action is {error:.1e} from the evaluated one"
    assert 0.05 < (np.abs(wanted) == 1.0).mean() < 0.95, "the test should see both sides of the clip"
    assert wanted[:, 6].std() > 0.1, "the gripper should open and close"


@pytest.mark.parametrize("name", TARGETS)
def test_onnx_was_measured_on_a_real_episode(exported, name):
    manifest = exported(name)[1]
    assert manifest["recorded_episode"]["steps"] >= 20
    assert manifest["onnx_max_abs_error"] <= 1e-5, f"{name}: ONNX {manifest['onnx_max_abs_error']:.1e} from NumPy"


@pytest.mark.parametrize("name", TARGETS)
def test_golden_vectors_hold(exported, policy, name):
    manifest = exported(name)[1]
    result = check_bundle(load_bundle(exported(name)[0]))
    assert len(manifest["golden"]["observations"]) == 8
    assert result["golden_ok"] and result["onnx_max_abs_error"] <= 1e-5 and result["limits_ok"], result


@pytest.mark.parametrize("name", TARGETS)
def test_the_manifest_says_how_to_drive_the_robot(exported, native, name):
    manifest, robot = exported(name)[1], native(name)
    model, osc = robot.model, robot.env.robots[0].composite_controller.part_controllers["right"]
    assert manifest["rate_hz"] == robot.env.control_freq == 20
    assert manifest["controller"]["kp"] == osc.kp[0] == 150 and manifest["controller"]["damping_ratio"] == 1
    assert manifest["controller"]["output_scale"] == {"translation_m": 0.05, "rotation_rad": 0.5}
    assert manifest["controller"]["base_frame"]["turns_with_first_joint"] == (name == "iiwa")
    assert manifest["gripper"]["rate_per_step"] == robot.env.robots[0].gripper["right"].speed
    assert [entry["size"] for entry in manifest["observation"]] == list(OBSERVATION.values())
    for entry in manifest["observation"] + manifest["action"]:
        assert entry["unit"] and entry["frame"] and entry["meaning"], f"{entry['name']} is not explained"
    assert len(manifest["arm"]) == len(manifest["start"]["arm_rad"]) == len(arm_joints(model))
    for row, angle in zip(manifest["arm"], manifest["start"]["arm_rad"], strict=True):
        joint = model.joint("robot0_" + row["joint"])
        low, high = row["limits_rad"] or (-np.inf, np.inf)
        assert low < angle < high
        assert row["limits_rad"] is None or row["limits_rad"] == list(joint.range)
        assert row["torque_limits_n_m"][0] < 0 < row["torque_limits_n_m"][1]


@pytest.mark.parametrize("name", TARGETS)
def test_the_finger_map_gives_the_observation(exported, native, name):
    """sign * (angle - start) from robosuite's own joint angles is what the policy sees."""
    robot = native(name)
    action = np.ones(ACTION_SIZE)
    action[:6] = (0, 0, 0.5, 0, 0, 0)
    for _ in range(8):
        observation = robot.step(action)
    manifest, seen = exported(name)[1], {}
    for entry, row in manifest["finger_map"].items():
        angle = float(robot.data.joint("gripper0_right_" + row["joint"]).qpos[0])
        seen[entry] = row["sign"] * (angle - row["start_rad"])
    wanted = dict(zip(entry_names(OBSERVATION), observation, strict=True))
    fingers = {key: wanted[key] for key in OBSERVATION if key.startswith("finger/")}
    assert {key: seen.get(key, 0.0) for key in fingers} == pytest.approx(fingers, abs=1e-12)
    hinges = [role for role in ROBOTS[name].gripper.joints if f"finger/{role}" in OBSERVATION]
    assert len(seen) == len(hinges) and (not hinges or max(map(abs, seen.values())) > 0.01)


def test_loading_needs_neither_torch_nor_robosuite(exported):
    code = (
        "import sys; from toolkit.bundle import load_bundle, check_bundle\n"
        "assert check_bundle(load_bundle(sys.argv[1]))['golden_ok']\n"
        "heavy = {'torch', 'robosuite', 'mujoco', 'onnx'} & set(sys.modules)\n"
        "assert not heavy, heavy"
    )
    done = subprocess.run([sys.executable, "-c", code, exported(TARGET)[0]], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


# -- what is refused -----------------------------------------------------------------------------------------


def test_a_hand_is_refused(policy, task, tmp_path):
    with pytest.raises(ToolkitError, match="'adroit' has a hand"):
        write_bundle(policy, ROBOTS["adroit"], task, CONFIG, tmp_path / "b")
    assert not (tmp_path / "b").exists()


def test_a_file_in_the_place_of_the_folder_is_refused(policy, task, tmp_path):
    (tmp_path / "b").write_text("mine")
    with pytest.raises(ToolkitError, match="choose another --out"):
        write_bundle(policy, ROBOTS[TARGET], task, CONFIG, tmp_path / "b")


def test_a_config_that_is_not_json_is_refused_and_leaves_no_manifest(policy, task, tmp_path):
    with pytest.raises(ToolkitError, match="not JSON"):
        write_bundle(policy, ROBOTS[TARGET], task, {"rate": float("nan")}, tmp_path / "b")
    assert not (tmp_path / "b" / MANIFEST).exists()


def test_nothing_there(tmp_path):
    with pytest.raises(ToolkitError, match="does not exist; write it: meta-evolve export"):
        load_bundle(tmp_path / "nowhere")


@pytest.mark.parametrize("name", ["policy.onnx", "policy.safetensors", "manifest.json"])
def test_a_missing_file_is_named(copy, name):
    (copy / name).unlink()
    with pytest.raises(ToolkitError, match=f"has no {name}"):
        load_bundle(copy)


@pytest.mark.parametrize("name", ["policy.onnx", "policy.safetensors"])
@pytest.mark.parametrize("harm", ["truncated", "one byte"])
def test_a_changed_file_is_named(copy, name, harm):
    data = (copy / name).read_bytes()
    (copy / name).write_bytes(data[: len(data) // 2] if harm == "truncated" else data[:-1] + bytes([data[-1] ^ 1]))
    with pytest.raises(ToolkitError, match=f"{name} is not the file that the manifest names"):
        load_bundle(copy)


@pytest.mark.parametrize("share", [0.0, 0.3, 0.99])
def test_a_truncated_manifest(copy, share):
    data = (copy / MANIFEST).read_bytes()
    (copy / MANIFEST).write_bytes(data[: int(share * len(data))])
    with pytest.raises(ToolkitError, match="truncated or no JSON"):
        load_bundle(copy)


@pytest.mark.parametrize("text", ["[]", "{}", '{"format": "another"}', '"meta-evolve bundle"'])
def test_a_foreign_manifest(copy, text):
    (copy / MANIFEST).write_text(text)
    with pytest.raises(ToolkitError, match="is no manifest"):
        load_bundle(copy)


def test_another_format_version(copy):
    edit(copy, lambda m: m.update(format_version=FORMAT_VERSION + 1))
    with pytest.raises(ToolkitError, match=f"this release reads {FORMAT_VERSION}"):
        load_bundle(copy)


@pytest.mark.parametrize("key", ["golden", "sha256", "observation", "action", "rate_hz"])
def test_a_manifest_without_an_entry(copy, key):
    edit(copy, lambda m: m.pop(key))
    with pytest.raises(ToolkitError, match=f"lacks or garbles '{key}'"):
        load_bundle(copy)


@pytest.mark.parametrize("value", [None, 3, "text", [1, 2]])
def test_a_manifest_with_a_garbled_record(copy, value):
    edit(copy, lambda m: m.update(observation=value))
    with pytest.raises(ToolkitError, match="lacks or garbles 'observation'"):
        load_bundle(copy)


def test_a_manifest_of_another_policy(copy):
    edit(copy, lambda m: m["observation"].reverse())
    with pytest.raises(ToolkitError, match="describes another policy"):
        load_bundle(copy)


@pytest.mark.parametrize("data", [b"", b"PK\x03\x04 rest", b"hello"])
def test_a_file_that_is_no_zip(tmp_path, data):
    (tmp_path / "b.zip").write_bytes(data)
    with pytest.raises(ToolkitError, match="is no bundle"):
        load_bundle(tmp_path / "b.zip")


def test_a_zip_without_a_bundle(tmp_path):
    with zipfile.ZipFile(tmp_path / "b.zip", "w") as archive:
        archive.writestr("../../escape.txt", "no")
    with pytest.raises(ToolkitError, match=r"has no manifest\.json"):
        load_bundle(tmp_path / "b.zip")


def test_the_check_notices_golden_vectors_of_another_policy(copy):
    edit(copy, lambda m: m["golden"]["actions"][0].__setitem__(0, 0.123))
    result = check_bundle(load_bundle(copy))
    assert not result["golden_ok"] and result["onnx_max_abs_error"] > 1e-5


def test_the_check_notices_narrower_limits(copy):
    edit(copy, lambda m: m["action"][0].update(high=0.5))
    assert not check_bundle(load_bundle(copy))["limits_ok"]


@pytest.mark.parametrize(
    "golden", [{}, {"observations": [], "actions": [], "tolerance": 1}, {"observations": [[1], [1, 2]]}]
)
def test_broken_golden_vectors(copy, golden):
    edit(copy, lambda m: m.update(golden=golden))
    with pytest.raises(ToolkitError, match="golden"):
        check_bundle(load_bundle(copy))


def test_an_observation_of_the_wrong_size(exported):
    with pytest.raises(ToolkitError, match=rf"has shape \(3,\); this bundle takes \({OBSERVATION_SIZE},\)"):
        load_bundle(exported(TARGET)[0])(np.zeros(3))

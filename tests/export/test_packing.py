"""What is packed into a bundle: it is whole, acts as the policy does on robosuite's robot, and whoever follows its manifest and knows
nothing else does what robosuite does.

What reads bundles is tried on shipped ones, in tests/bundle.
"""

import hashlib
import json
from dataclasses import replace

import mujoco
import numpy as np
import onnx
import onnxruntime
import pytest
import torch
from exported_targets import TARGET, TARGETS
from json_schema import complaints
from safetensors.torch import load_file

from robots import ROBOTS
from tasks import TASKS
from tasks.pick import ACTION, OBSERVATION, OBSERVATION_SIZE, is_lost
from toolkit.bundle.onnx_graph import load_onnx
from toolkit.bundle.reading import FILES, MANIFEST, check_bundle, load_bundle, shipped_bundles
from toolkit.bundle.schema import manifest_schema
from toolkit.deploy.runtime import replay_golden
from toolkit.errors import ToolkitError
from toolkit.export.packing import LOST_BELOW, check_records, check_task, task_card, write_bundle
from toolkit.learning.policy import GaussianPolicy
from toolkit.morphology.native_scene import NativeScene, model_sha256


def observations(policy, count, seed=1):
    layers = policy.layers()
    return layers.shift + layers.scale * np.random.default_rng(seed).standard_normal((count, OBSERVATION_SIZE))


# -- the task ----------------------------------------------------------------------------------------------------------


def test_a_tasks_goal_horizon_and_tolerance_are_its_own(task):
    own = replace(task, goal_offset=(0.1, -0.05, 0.3), goal_tolerance=0.02, hold_steps=3, horizon=70, title="mine")
    card = task_card(own)
    assert (card.name, card.goal_offset_m, card.goal_tolerance_m) == ("mine", (0.1, -0.05, 0.3), 0.02)
    assert (card.hold_steps, card.horizon_steps) == (3, 70)


@pytest.mark.parametrize("name", sorted(shipped_bundles()))
def test_a_shipped_bundles_task_is_the_one_of_its_name(name):
    bundle = load_bundle(name)
    check_task(bundle.manifest, TASKS[bundle.manifest.task.name], bundle.path)


@pytest.mark.parametrize("change, said", [
    ({"goal_offset": (0.0, 0.0, 0.2)}, "goal_offset_m"), ({"horizon": 100}, "horizon_steps"), ({"goal_tolerance": 0.1}, "goal_tolerance_m"),
    ({"control_frequency": 10.0}, "policy_hz"),
])
def test_a_bundle_of_another_task_of_the_same_name_is_refused(change, said):
    """Its label would be compared with what was measured on something else."""
    bundle = load_bundle("kinova3")
    other = replace(TASKS[bundle.manifest.task.name], **change)
    assert other.name == bundle.manifest.task.name
    with pytest.raises(ToolkitError, match=f"{said} is .*, here it is .*"):
        check_task(bundle.manifest, other, bundle.path)


@pytest.mark.parametrize("change, culprit", [
    (lambda e: {"unit": "deg"} if e.name == "finger/THJ4" else {}, "observation 17 is 'finger/THJ4' .*'deg'"),
    (lambda e: {"frame": "world"} if e.name == "goal_from_object" else {}, "observation 27 is 'goal_from_object'"),
    (lambda e: {"name": "object_in_camera"} if e.name == "object_from_grasp" else {}, "observation 25 is 'object_in_camera'"),
])
def test_a_record_that_this_release_does_not_give_is_refused_by_name(change, culprit):
    manifest = load_bundle("kinova3").manifest
    changed = replace(manifest, observation=tuple(replace(e, **change(e)) for e in manifest.observation))
    check_records(manifest, "b")
    with pytest.raises(ToolkitError, match=culprit):
        check_records(changed, "b")


# -- what is in it -----------------------------------------------------------------------------------------------------


def test_a_bundle_reads_back_as_it_was_written(exported, policy, says):
    folder, manifest = exported(TARGET)
    assert sorted(file.name for file in folder.iterdir()) == sorted(FILES)
    bundle = load_bundle(folder)
    assert bundle.manifest == manifest and manifest.run == says.config and manifest.lineage == says.lineage
    assert bundle.policy.record == OBSERVATION
    loaded = GaussianPolicy.load(folder / "policy.safetensors", OBSERVATION.names, ACTION.names)
    np.testing.assert_array_equal(loaded.parameters, policy.parameters)


def test_hashes_are_the_files_own(exported):
    folder, manifest = exported(TARGET)
    assert sorted(manifest.sha256) == sorted(set(FILES) - {MANIFEST})
    for name, digest in manifest.sha256.items():
        assert hashlib.sha256((folder / name).read_bytes()).hexdigest() == digest


def test_the_onnx_file_carries_the_manifest(exported):
    folder, manifest = exported(TARGET)
    assert load_onnx(folder / "policy.onnx").metadata == {k: v for k, v in manifest.to_json().items() if k != "sha256"}


def test_the_zip_beside_the_folder_is_the_same_bundle(exported):
    folder, manifest = exported(TARGET)
    bundle = load_bundle(folder.with_name(folder.name + ".zip"))
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
    assert manifest.golden.steps >= 20
    assert manifest.golden.onnx_max_abs_error <= 1e-5, f"{name}: ONNX {manifest.golden.onnx_max_abs_error:.1e} from NumPy"


@pytest.mark.parametrize("name", TARGETS)
def test_golden_vectors_hold(exported, name):
    bundle = load_bundle(exported(name)[0])
    result = check_bundle(bundle)
    assert bundle.golden["observations"].shape == (8, OBSERVATION_SIZE)
    assert result["golden_ok"] and result["onnx_max_abs_error"] <= 1e-5 and result["limits_ok"], result


@pytest.mark.parametrize("name", TARGETS)
def test_the_manifest_says_how_to_drive_the_robot(exported, native, name):
    manifest, robot = exported(name)[1], native(name)
    model, osc = robot.model, robot.env.robots[0].composite_controller.part_controllers["right"]
    assert manifest.policy_hz == robot.env.control_freq == 20 and manifest.controller_hz == 500
    assert manifest.controller.kp == osc.kp[0] == 150 and manifest.controller.damping_ratio == 1
    assert (manifest.controller.translation_m, manifest.controller.rotation_rad) == (0.05, 0.5)
    assert manifest.controller.turns_with_first_joint == (name == "iiwa")
    assert manifest.gripper.rate == robot.env.robots[0].gripper["right"].speed
    assert [entry.size for entry in manifest.observation] == list(OBSERVATION.values())
    for entry in (*manifest.observation, *manifest.action):
        assert entry.unit and entry.frame in manifest.frames and entry.meaning, f"{entry.name} is not explained"
    assert len(manifest.joints) == len(manifest.start.arm_rad) == len(NativeScene(model).arm)
    for row, angle in zip(manifest.joints, manifest.start.arm_rad, strict=True):
        joint = model.joint("robot0_" + row.name)
        assert (row.low if row.low is not None else -np.inf) < angle < (row.high if row.high is not None else np.inf)
        assert row.low is None or [row.low, row.high] == list(joint.range)
        assert row.effort == model.actuator_ctrlrange[joint.id, 1]
    speeds = ROBOTS[name].joint_speeds
    assert all(row.speed <= fastest for row, fastest in zip(manifest.joints, speeds, strict=True))
    assert manifest.robot.model_sha256 == model_sha256(model)
    assert is_lost(np.array([0, 0, LOST_BELOW - 1e-9])) and not is_lost(np.array([0, 0, LOST_BELOW + 1e-9]))


@pytest.mark.parametrize("name", TARGETS)
def test_the_recorded_episode_replays_through_the_robot_pcs_own_kinematics(exported, name):
    found = replay_golden(load_bundle(exported(name)[0]))
    assert max(found.values()) <= 1e-5, found


# -- what is refused ---------------------------------------------------------------------------------------------------


def test_a_hand_is_refused(policy, says, task, tmp_path):
    with pytest.raises(ToolkitError, match="'adroit' has a hand"):
        write_bundle(policy, ROBOTS["adroit"], task, says.config, says.lineage, says.label, tmp_path / "b")
    assert not (tmp_path / "b").exists()


def test_a_file_in_the_place_of_the_folder_is_refused(policy, says, task, tmp_path):
    (tmp_path / "b").write_text("mine")
    with pytest.raises(ToolkitError, match="choose another --out"):
        write_bundle(policy, ROBOTS[TARGET], task, says.config, says.lineage, says.label, tmp_path / "b")


def test_a_config_that_is_not_json_is_refused_and_leaves_no_manifest(policy, says, task, tmp_path):
    with pytest.raises(ToolkitError, match="not JSON"):
        write_bundle(policy, ROBOTS[TARGET], task, {"rate": float("nan")}, says.lineage, says.label, tmp_path / "b")
    assert not (tmp_path / "b" / MANIFEST).exists()


# -- the schema --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", TARGETS)
def test_the_manifest_is_valid_by_the_schema_beside_it(alone, name):
    folder, manifest = alone(name)
    schema = json.loads((folder / "manifest.schema.json").read_text())
    assert schema == json.loads(json.dumps(manifest_schema()))
    assert list(complaints(manifest, schema, schema)) == []
    assert schema["$schema"].startswith("https://json-schema.org/draft/2020-12")
    for name, record in (("manifest", schema), *schema["$defs"].items()):
        assert len(record["description"]) > 20 and record["required"], f"{name} is not explained"
        for entry in record["required"]:
            assert entry in record["description"], f"{name}.{entry} is not explained"


# -- the policy in other people's forms --------------------------------------------------------------------------------


def rows(policy, count=200):
    layers = policy.layers()
    draws = np.random.default_rng(2).standard_normal((count, OBSERVATION_SIZE))
    return (layers.shift + 3.0 * layers.scale * draws).astype(np.float32)


@pytest.mark.parametrize("name", TARGETS)
def test_layers_flat_graph_and_named_graph_give_one_action(alone, policy, native, name):
    """torch's own Linear layers from actor.safetensors, onnxruntime on a batch, and robosuite's action of the policy itself."""
    folder = alone(name)[0]
    tensors = load_file(folder / "actor.safetensors")
    net = []
    for i in range(sum(key.endswith(".weight") for key in tensors)):
        W = tensors[f"layer_{i}.weight"]
        linear = torch.nn.Linear(W.shape[1], W.shape[0], dtype=torch.float64)
        linear.load_state_dict({"weight": W, "bias": tensors[f"layer_{i}.bias"]})
        net += [linear, torch.nn.Tanh()]
    net = torch.nn.Sequential(*net[:-1])
    seen = rows(policy)
    with torch.no_grad():
        x = (torch.from_numpy(seen.astype(float)) - tensors["observation.shift"]) / tensors["observation.scale"]
        acted = net(x.clamp(-tensors["observation.clip"], tensors["observation.clip"])).clamp(-1, 1).numpy()
    session = onnxruntime.InferenceSession(folder / "policy_flat.onnx", providers=["CPUExecutionProvider"])
    flat = session.run(["actions"], {"obs": seen})[0]
    bundle, robot = load_bundle(folder), native(name)
    named = np.array([bundle(row) for row in seen])
    wanted = np.array([robot.robosuite_action(policy.mean(row.astype(float))) for row in seen])
    assert acted.shape == flat.shape == named.shape == (200, 7)
    for what, found in (("actor.safetensors in torch", acted), ("policy_flat.onnx", flat), ("policy.onnx", named)):
        error = float(np.abs(found - wanted).max())
        assert error < 1e-6, f"{name}, {what}: {error:.1e}"
    assert 0.05 < (np.abs(wanted) == 1.0).mean() < 0.95 and wanted[:, 6].std() > 0.1
    one = session.run(None, {"obs": seen[:1]})[0]
    assert one.shape == (1, 7) and np.abs(one - flat[:1]).max() < 1e-6, "a batch of one, too"


@pytest.mark.parametrize("name", TARGETS)
def test_the_keys_that_isaac_lab_and_mjlab_read_are_there(alone, native, name):
    folder, manifest = alone(name)
    for file in ("policy.onnx", "policy_flat.onnx"):
        words = {entry.key: entry.value for entry in onnx.load(folder / file).metadata_props}
        assert {"run_path", "joint_names", "joint_stiffness", "joint_damping", "default_joint_pos", "command_names", "observation_names",
                "action_scale"} <= set(words)
        joints = words["joint_names"].split(",")
        numbers = {key: [float(v) for v in words[key].split(",")] for key in ("joint_stiffness", "joint_damping", "default_joint_pos")}
        model, data = native(name).model, native(name).data
        for place, joint in enumerate(joints):
            own = next(model.joint(prefix + joint) for prefix in ("robot0_", "gripper0_right_")
                       if mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_JOINT, prefix + joint) >= 0)
            motor = int(np.flatnonzero(model.actuator_trnid[:, 0] == own.id)[0])
            servo = model.actuator_biastype[motor] == mujoco.mjtBias.mjBIAS_AFFINE
            assert numbers["joint_stiffness"][place] == (model.actuator_gainprm[motor, 0] if servo else 0.0)
            assert numbers["joint_damping"][place] == (-model.actuator_biasprm[motor, 2] if servo else 0.0)
            assert numbers["default_joint_pos"][place] == data.qpos[own.qposadr[0]], "to the bit"
        assert len(joints) == model.nu, "every motor's joint"
        assert words["observation_names"].split(",") == list(OBSERVATION) and words["command_names"] == ""
        assert [float(v) for v in words["action_scale"].split(",")] == [0.05] * 3 + [0.5] * 3 + [1.0]
        assert json.loads(words["meta_evolve"])["robot"] == manifest["robot"]


def test_the_config_tells_the_flat_graphs_shapes(alone):
    folder, manifest = alone(TARGET)
    config = json.loads((folder / "config.json").read_text())
    session = onnxruntime.InferenceSession(folder / config["onnx"], providers=["CPUExecutionProvider"])
    (entry,), (out,) = session.get_inputs(), session.get_outputs()
    assert entry.shape[1:] == config["input_features"]["observation.state"]["shape"] == [len(config["observation_names"])]
    assert out.shape[1:] == config["output_features"]["action"]["shape"] == [len(config["action_names"])]
    assert isinstance(entry.shape[0], str), "the batch is free"
    assert len(set(config["observation_names"])) == OBSERVATION_SIZE and (folder / config["safetensors"]).is_file()
    assert {config["input_features"]["observation.state"]["type"], config["output_features"]["action"]["type"]} == {"STATE", "ACTION"}
    assert set(config["normalization_mapping"].values()) == {"IDENTITY"}, "the graph normalises by itself"

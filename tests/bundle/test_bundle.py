"""A bundle is whole, acts as the policy does on robosuite's robot, and says in one sentence what is wrong with it.

What writes bundles, what describes robots in them and what reads them are tried together on one that is measured here: that takes ten
seconds, and a file to itself would measure it again.
"""

import dataclasses
import hashlib
import json
import shutil
import subprocess
import sys
import zipfile

import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from robots import ROBOTS
from tasks.pick import ACTION, ACTION_SIZE, OBSERVATION, OBSERVATION_SIZE, is_lost
from toolkit.bundle.manifest import FORMAT_VERSION, read_manifest
from toolkit.bundle.onnx_graph import load_onnx
from toolkit.bundle.reading import FILES, MANIFEST, check_bundle, load_bundle
from toolkit.deploy.kinematics import Kinematics
from toolkit.deploy.runtime import replay_golden
from toolkit.errors import ToolkitError
from toolkit.export.packing import LOST_BELOW, check_records, write_bundle
from toolkit.learning.policy import GaussianPolicy
from toolkit.morphology.native_scene import NativeScene, model_sha256

TARGET = "kinova3"
# Three hinged grippers and one that slides.
TARGETS = (TARGET, *(pytest.param(name, marks=pytest.mark.slow) for name in ("jaco", "iiwa", "panda")))


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
def test_the_response_says_how_far_robosuites_own_step_moves(exported, native, name):
    """One delta through robosuite's env.step: the grasp frame moves by the measured share of it."""
    response, robot = exported(name)[1].controller.response, native(name)
    site = robot.model.site("gripper0_right_grip_site").id
    for axis in range(3):
        robot.begin(0)
        before, native_action = robot.data.site_xpos[site].copy(), np.zeros(7)
        for step in range(len(response.impulse[axis])):
            native_action[axis], native_action[6] = (response.amplitude if step == 0 else 0.0), -1.0
            robot.apply(native_action)
        moved = (robot.data.site_xpos[site] - before)[axis]
        wanted = response.steady[axis] * response.amplitude * 0.05
        assert moved == pytest.approx(wanted, abs=2e-5), f"{name}, axis {axis}: {moved:.5f} m, the manifest says {wanted:.5f} m"
        assert 0.1 < response.steady[axis] < 0.4


@pytest.mark.parametrize("name", TARGETS)
def test_the_gripper_opens_and_closes(exported, name):
    gripper = exported(name)[1].gripper
    assert gripper.opening_m[0] > 0.06 and gripper.opening_m[-1] < 0.01, f"{name}: {gripper.opening_m[0]} to {gripper.opening_m[-1]} m"


@pytest.mark.parametrize("name", TARGETS)
def test_the_finger_map_gives_the_observation(exported, native, name):
    """sign * (angle - start) from robosuite's own joint angles is what the policy sees."""
    robot = native(name)
    action = np.ones(ACTION_SIZE)
    action[:6] = (0, 0, 0.5, 0, 0, 0)
    for _ in range(8):
        observation = robot.step(action)
    manifest, seen = exported(name)[1], {}
    for entry, row in manifest.fingers.items():
        angle = float(robot.data.joint("gripper0_right_" + row.joint).qpos[0])
        seen[entry] = row.sign * (angle - row.start_rad)
    wanted = dict(zip(OBSERVATION.names, observation, strict=True))
    fingers = {key: wanted[key] for key in OBSERVATION if key.startswith("finger/")}
    assert {key: seen.get(key, 0.0) for key in fingers} == pytest.approx(fingers, abs=1e-12)
    hinges = [role for role in ROBOTS[name].gripper.joints if f"finger/{role}" in OBSERVATION]
    assert len(seen) == len(hinges) and (not hinges or max(map(abs, seen.values())) > 0.01)


@pytest.mark.parametrize("name", TARGETS)
def test_the_mjcf_is_the_simulated_arm(exported, native, name):
    """Random arm and finger angles: same grasp frame, same lowest point of the gripper, every shape of it enclosed."""
    manifest, robot = exported(name)[1], native(name)
    bundle, model, data = load_bundle(exported(name)[0]), robot.model, mujoco.MjData(robot.model)
    kinematics = Kinematics.of(manifest, bundle.mjcf)
    arm = [model.joint("robot0_" + joint.name).qposadr[0] for joint in manifest.joints]
    fingers = [model.joint("gripper0_right_" + joint).qposadr[0] for joint in manifest.gripper.joints]
    hung = [g for g in range(model.ngeom) if model.geom(g).name.startswith("gripper0_right_") and model.geom_group[g] == 0]
    rng, site, bundle_model = np.random.default_rng(0), model.site("gripper0_right_grip_site").id, kinematics.model
    for _ in range(20):
        data.qpos[:] = robot.data.qpos
        data.qpos[arm] += rng.uniform(-0.5, 0.5, 7)
        data.qpos[fingers] += rng.uniform(-0.2, 0.2, len(fingers))
        mujoco.mj_kinematics(model, data)
        kinematics.place(data.qpos[arm], data.qpos[fingers])
        assert np.abs(kinematics.position - data.site_xpos[site]).max() < 1e-12
        assert np.abs(kinematics.rotation - data.site_xmat[site].reshape(3, 3)).max() < 1e-12
        points = [data.geom_xpos[g] + corners(model, g) @ data.geom_xmat[g].reshape(3, 3).T for g in hung]
        lowest = min(float(p[:, 2].min()) for p in points)
        assert abs(kinematics.lowest() - lowest) < 1e-6, f"{name}: the lowest point is off by {kinematics.lowest() - lowest:.1e} m"
        shapes = [bundle_model.geom(model.geom(g).name.removeprefix("gripper0_right_")).id for g in hung]
        for shape, cloud in zip(shapes, points, strict=True):
            local = (cloud - kinematics.data.geom_xpos[shape]) @ kinematics.data.geom_xmat[shape].reshape(3, 3)
            assert encloses(bundle_model, shape, local), f"{name}: {bundle_model.geom(shape).name} does not enclose its mesh"


def encloses(model, geom, points):
    """Whether a box or capsule holds points (n, 3) given in its frame."""
    size, kind = model.geom_size[geom], model.geom_type[geom]
    if kind == mujoco.mjtGeom.mjGEOM_BOX:
        return bool((np.abs(points) <= size + 1e-6).all())
    assert kind == mujoco.mjtGeom.mjGEOM_CAPSULE
    axis = np.column_stack([0 * points[:, :2], np.clip(points[:, 2], -size[1], size[1])])
    return bool((np.linalg.norm(points - axis, axis=1) <= size[0] + 1e-6).all())


def corners(model, geom):
    """Vertices (n, 3) of a mesh or box in its geom's frame."""
    if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_MESH:
        mesh = model.geom_dataid[geom]
        return model.mesh_vert[model.mesh_vertadr[mesh] : model.mesh_vertadr[mesh] + model.mesh_vertnum[mesh]]
    return np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, -1).T * model.geom_size[geom]


@pytest.mark.parametrize("name", TARGETS)
def test_the_recorded_episode_replays_through_the_robot_pcs_own_kinematics(exported, name):
    found = replay_golden(load_bundle(exported(name)[0]))
    assert max(found.values()) <= 1e-5, found


def test_loading_needs_neither_torch_nor_robosuite(exported):
    code = (
        "import sys; from toolkit.bundle.reading import load_bundle, check_bundle\n"
        "assert check_bundle(load_bundle(sys.argv[1]))['golden_ok']\n"
        "heavy = {'torch', 'robosuite', 'onnx', 'rerun', 'pinocchio', 'scipy', 'numba'} & set(sys.modules)\n"
        "assert not heavy, heavy"
    )
    done = subprocess.run([sys.executable, "-c", code, exported(TARGET)[0]], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


# -- what is refused -----------------------------------------------------------------------------------------


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


@pytest.mark.parametrize("name", FILES)
def test_a_missing_file_is_named(copy, name):
    (copy / name).unlink()
    with pytest.raises(ToolkitError, match=f"has no {name}"):
        load_bundle(copy)


@pytest.mark.parametrize("name", sorted(set(FILES) - {MANIFEST}))
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
    with pytest.raises(ToolkitError, match="not JSON"):
        load_bundle(copy)


@pytest.mark.parametrize("text", ["[]", "{}", '{"format": "another"}', '"meta-evolve bundle"'])
def test_a_foreign_manifest(copy, text):
    (copy / MANIFEST).write_text(text)
    with pytest.raises(ToolkitError, match="is no manifest"):
        load_bundle(copy)


def test_another_format_version(copy):
    edit(copy, lambda m: m.update(format_version=FORMAT_VERSION + 1))
    with pytest.raises(ToolkitError, match=f"this release reads 2 to {FORMAT_VERSION}; export the bundle again"):
        load_bundle(copy)


FREE = ("run", "object", "config")


def paths(value, path=()):
    """Every path in nested JSON, but inside the free-form run, object and configuration of the controller."""
    if path and path[-1] in FREE:
        return
    items = value.items() if isinstance(value, dict) else enumerate(value[:1]) if isinstance(value, list) else ()
    for key, item in items:
        yield (*path, key)
        yield from paths(item, (*path, key))


@settings(max_examples=150, deadline=None)
@given(data=st.data())
def test_a_manifest_that_lacks_or_garbles_any_entry_is_refused(exported, data):
    """Whatever is taken out, or replaced by what has no place there, one sentence names the file and the entry."""
    content = exported(TARGET)[1].to_json()
    path = data.draw(st.sampled_from(sorted(paths(content), key=str)))
    where = content
    for key in path[:-1]:
        where = where[key]
    free = path[0] in ("frames", "versions", "sha256", "fingers") or path[-2:-1] in (("targets",), ("fingers",), ("materials",))
    garble = data.draw(st.sampled_from(["drop", {"odd": 1}, float("nan"), True, ["x", {}]]))
    if garble == "drop" and (isinstance(where, list) or (free and len(path) > 1)):
        return  # a shorter list may be a list still, and a mapping may have fewer keys
    if garble == "drop":
        del where[path[-1]]
    elif (isinstance(garble, bool) and isinstance(where[path[-1]], bool)) or (isinstance(garble, dict) and path[-1] in FREE):
        return
    else:
        where[path[-1]] = garble
    with pytest.raises(ToolkitError, match="a/manifest.json (lacks or garbles|is no manifest|has format version)"):
        read_manifest(content, "a/manifest.json")


def test_a_manifest_of_another_policy_is_refused_by_the_entry_that_differs(copy):
    edit(copy, lambda m: m["observation"].reverse())
    with pytest.raises(ToolkitError, match="observation 0 is 'goal_from_object' of size 3 in the manifest, 'finger/FFJ3' of size 1"):
        load_bundle(copy)


def test_a_manifest_that_was_edited_by_hand_is_refused(copy):
    edit(copy, lambda m: m["joints"][2].update(speed=0.5))
    with pytest.raises(ToolkitError, match="differ in 'joints'"):
        load_bundle(copy)


@pytest.mark.parametrize("change, culprit", [
    (lambda e: {"unit": "deg"} if e.name == "finger/THJ4" else {}, "observation 17 is 'finger/THJ4' .*'deg'"),
    (lambda e: {"frame": "world"} if e.name == "goal_from_object" else {}, "observation 27 is 'goal_from_object'"),
    (lambda e: {"name": "object_in_camera"} if e.name == "object_from_grasp" else {}, "observation 25 is 'object_in_camera'"),
])
def test_a_record_that_this_release_does_not_give_is_refused_by_name(exported, change, culprit):
    manifest = exported(TARGET)[1]
    changed = dataclasses.replace(manifest, observation=tuple(dataclasses.replace(e, **change(e)) for e in manifest.observation))
    check_records(manifest, "b")
    with pytest.raises(ToolkitError, match=culprit):
        check_records(changed, "b")


def zipped(path, entries):
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in entries:
            archive.writestr(name, content)
    return path


def test_a_zip_writes_nothing_and_takes_nothing_from_outside(exported, tmp_path):
    folder = exported(TARGET)[0]
    files = [(name, (folder / name).read_bytes()) for name in FILES]
    inside = tmp_path / "a" / "b"
    inside.mkdir(parents=True)
    traversal = zipped(inside / "b.zip", [(f"../../{name}", content) for name, content in files] + [("/tmp/evil", b"no")])
    with pytest.raises(ToolkitError, match="has no manifest.json"):
        load_bundle(traversal)
    assert [p.name for p in tmp_path.rglob("*") if p.is_file()] == ["b.zip"]
    assert load_bundle(zipped(inside / "top.zip", files)).manifest == exported(TARGET)[1], "files may also lie at the top"


def test_a_zip_with_a_file_twice_is_refused(exported, tmp_path):
    folder = exported(TARGET)[0]
    files = [(name, (folder / name).read_bytes()) for name in FILES]
    with pytest.raises(ToolkitError, match="holds manifest.json twice"):
        load_bundle(zipped(tmp_path / "b.zip", [*files, ("x/manifest.json", b"{}")]))


def test_a_zip_bomb_is_refused_before_it_is_unpacked(tmp_path, monkeypatch):
    monkeypatch.setattr("toolkit.bundle.reading.LARGEST_FILE", 10**6)
    with pytest.raises(ToolkitError, match="policy.onnx has more than 1000000 bytes"):
        load_bundle(zipped(tmp_path / "b.zip", [("policy.onnx", bytes(10**7))]))


def rehash(folder, name):
    edit(folder, lambda m: m["sha256"].update({name: hashlib.sha256((folder / name).read_bytes()).hexdigest()}))


@pytest.mark.parametrize("spoil", [
    lambda arrays: arrays.pop("actions"),
    lambda arrays: arrays.update(observations=arrays["observations"][:, :3]),
    lambda arrays: arrays.update(episode_goal=np.full(3, np.nan)),
    lambda arrays: arrays.update(actions=arrays["actions"].astype(np.float32)),
])
def test_broken_golden_arrays_are_named(copy, spoil):
    with np.load(copy / "golden.npz") as file:
        arrays = dict(file)
    spoil(arrays)
    np.savez(copy / "golden.npz", **arrays)
    rehash(copy, "golden.npz")
    with pytest.raises(ToolkitError, match="golden array '(actions|observations|episode_goal)'"):
        load_bundle(copy)


def test_golden_arrays_that_hold_objects_are_refused(copy):
    np.savez(copy / "golden.npz", observations=np.array([{"a": 1}], dtype=object))
    rehash(copy, "golden.npz")
    with pytest.raises(ToolkitError, match="golden array .* dtype float64"):
        load_bundle(copy)


def test_the_check_notices_golden_vectors_of_another_policy(copy):
    with np.load(copy / "golden.npz") as file:
        arrays = dict(file)
    arrays["actions"][0, 0] += 0.01
    np.savez(copy / "golden.npz", **arrays)
    rehash(copy, "golden.npz")
    result = check_bundle(load_bundle(copy))
    assert not result["golden_ok"] and result["onnx_max_abs_error"] > 1e-5


def test_the_check_notices_narrower_limits(exported):
    bundle = load_bundle(exported(TARGET)[0])
    first = dataclasses.replace(bundle.manifest.action[0], high=0.5)
    narrow = dataclasses.replace(bundle.manifest, action=(first, *bundle.manifest.action[1:]))
    assert not check_bundle(dataclasses.replace(bundle, manifest=narrow))["limits_ok"]


@pytest.mark.parametrize("text", ["", "<mujoco><include file='/etc/passwd'/></mujoco>", "<mujoco><worldbody/></mujoco>", "not xml"])
def test_a_robot_file_that_is_none_is_refused(exported, text):
    bundle = load_bundle(exported(TARGET)[0])
    with pytest.raises(ToolkitError, match="export the bundle again"):
        Kinematics.of(bundle.manifest, text)


def test_an_observation_of_the_wrong_size(exported):
    with pytest.raises(ToolkitError, match=rf"has shape \(3,\); this bundle takes \({OBSERVATION_SIZE},\)"):
        load_bundle(exported(TARGET)[0])(np.zeros(3))

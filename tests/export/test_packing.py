"""What is packed into a bundle: it is whole, acts as the policy does on robosuite's robot, and whoever follows its manifest and knows
nothing else does what robosuite does.

Whatever an export writes (datasheet, control law, world, robot, graphs, their schema) is tried on one bundle that is measured here: that
takes ten seconds, and a file to itself would measure it again. What reads bundles is tried on shipped ones, in tests/bundle.
"""

import hashlib
import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import mujoco
import numpy as np
import onnx
import onnxruntime
import pytest
import torch
from json_schema import complaints
from safetensors.torch import load_file

from robots import ROBOTS
from tasks import TASKS
from tasks.env import Pick
from tasks.pick import ACTION, ACTION_SIZE, OBSERVATION, OBSERVATION_SIZE, START_POSITION, is_lost
from tasks.table import TABLE_FRICTION
from toolkit.bundle.onnx_graph import load_onnx
from toolkit.bundle.reading import FILES, MANIFEST, check_bundle, load_bundle, shipped_bundles
from toolkit.bundle.schema import manifest_schema
from toolkit.deploy.kinematics import Kinematics
from toolkit.deploy.runtime import replay_golden
from toolkit.errors import ToolkitError
from toolkit.export.packing import LOST_BELOW, check_records, check_task, task_card, write_bundle
from toolkit.learning.policy import GaussianPolicy
from toolkit.morphology.native_scene import NativeScene, model_sha256

TARGET = "jaco"
# Grippers that are hinged, the first of three fingers that start half closed; one whose arm's base turns with joint 1; one that slides.
TARGETS = (TARGET, *(pytest.param(name, marks=pytest.mark.slow) for name in ("kinova3", "iiwa", "panda")))
ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def alone(exported):
    """name -> (folder, its manifest.json as plain JSON)."""

    def read(name):
        folder, _ = exported(name)
        return folder, json.loads((folder / "manifest.json").read_text())

    return read


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


# -- the controller ----------------------------------------------------------------------------------------------------


def rotation(vector):
    out = np.empty(9)
    quaternion = np.empty(4)
    angle = np.linalg.norm(vector)
    mujoco.mju_axisAngle2Quat(quaternion, np.asarray(vector, float) / angle, angle)
    mujoco.mju_quat2Mat(out, quaternion)
    return out.reshape(3, 3)


@pytest.mark.parametrize("name", TARGETS)
def test_torques_follow_from_the_manifests_law(alone, native, name):
    """The written law on MuJoCo's own Jacobian and mass matrix gives robosuite's torques, the arm in motion and away from its posture."""
    manifest, robot = alone(name)[1], native(name)
    says, law, model, data = manifest["controller"], manifest["simulation"]["osc"], robot.model, robot.data
    controller = robot.env.robots[0].composite_controller.part_controllers["right"]
    for _ in range(5):
        robot.apply(np.array([0.6, -0.8, 0.5, 0.3, 0.4, 0.9, -1.0]))
    joints = [model.joint("robot0_" + joint["name"]) for joint in manifest["joints"]]
    q, v = [j.qposadr[0] for j in joints], [j.dofadr[0] for j in joints]
    mujoco.mj_forward(model, data)
    robot.env.robots[0].composite_controller.update_state()  # robosuite tells the controller where its base is once per physics step
    controller.update(force=True)
    delta = np.array([0.9, -0.3, 0.5, -0.4, 0.7, 0.2])
    controller.set_goal(delta)
    found = controller.clip_torques(controller.run_controller())
    site, base = model.site("gripper0_right_grip_site").id, model.site(says["base_site"]).id
    jacobian, base_jacobian = np.zeros((6, model.nv)), np.zeros((6, model.nv))
    mujoco.mj_jacSite(model, data, jacobian[:3], jacobian[3:], site)
    mujoco.mj_jacSite(model, data, base_jacobian[:3], base_jacobian[3:], base)
    mass = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, mass, data.qM)
    J, M, inverse = jacobian[:, v], mass[np.ix_(v, v)], np.linalg.inv(mass[np.ix_(v, v)])
    R, now = data.site_xmat[base].reshape(3, 3), data.site_xmat[site].reshape(3, 3)
    assert law["goal_from"] == "achieved" and law["reference_frame"] == "base" and law["decoupled"]
    wanted = R @ rotation(says["rotation_rad"] * delta[3:]) @ R.T @ now
    e_p = says["translation_m"] * R @ delta[:3]
    e_r = 0.5 * sum(np.cross(now[:, i], wanted[:, i]) for i in range(3))
    kp, kd = says["kp"], 2 * says["damping_ratio"] * np.sqrt(says["kp"])
    speed = J @ data.qvel[v] - base_jacobian @ data.qvel
    force, torque = kp * e_p - kd * speed[:3], kp * e_r - kd * speed[3:]
    inertia = lambda rows: np.linalg.inv(rows @ inverse @ rows.T)  # noqa: E731
    null = law["null_space"]
    pull = null["kp"] * (np.array(null["posture_rad"]) - data.qpos[q]) - null["kd"] * data.qvel[v]
    N = np.eye(len(v)) - inverse @ J.T @ inertia(J) @ J
    tau = J.T @ np.concatenate([inertia(J[:3]) @ force, inertia(J[3:]) @ torque]) + N.T @ M @ pull + data.qfrc_bias[v]
    limit = np.array(law["torque_limit_nm"])
    np.testing.assert_allclose(np.clip(tau, -limit, limit), found, rtol=0, atol=1e-4)
    assert np.abs(N.T @ M @ pull).max() > 1e-3 and (np.abs(found) < limit).any(), "the test should see posture and law"
    assert np.linalg.norm(speed) > 0.05
    start = data.site_xpos[base] if not says["turns_with_first_joint"] else law["base_position_m"]
    assert law["base_position_m"] == pytest.approx(list(start), abs=1e-9)
    for key, value in law["config"].items():
        assert not isinstance(value, str) or "object at 0x" not in value, f"{key} is no setting"
    assert law["config"]["kp"] == says["kp"] and law["config"]["output_max"][:3] == [says["translation_m"]] * 3


# -- the gripper -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", TARGETS)
def test_gripper_targets_follow_from_start_sign_and_line(alone, native, name):
    manifest, robot = alone(name)[1], native(name)
    gripper, motors = manifest["gripper"], manifest["simulation"]["actuators"]
    state = np.array([motor["start"] for motor in motors])
    row = [robot.model.actuator("gripper0_right_" + motor["name"]).id for motor in motors]
    own = [int(a) for a in robot.env.robots[0]._ref_joint_gripper_actuator_indexes["right"]]
    assert row == own, "in robosuite's order"
    seen = []
    for closing in (1, 1, 0.3, -1, 0, 1, -0.2, -1, -1, -1):
        robot.apply(np.array([0, 0, 0, 0, 0, 0, closing]))
        state = np.clip(state + np.array([motor["sign"] for motor in motors]) * gripper["rate"] * np.sign(closing), -1, 1)
        wanted = [motor["low"] + 0.5 * (s + 1) * (motor["high"] - motor["low"]) for motor, s in zip(motors, state, strict=True)]
        assert robot.data.ctrl[row].tolist() == pytest.approx(wanted, abs=1e-9)
        seen.append(wanted)
    assert np.ptp(np.array(seen), axis=0).min() > 1e-3 and all(motor["nonlinearity"] < 1e-9 for motor in motors)
    for motor in motors:
        joint = robot.model.joint("gripper0_right_" + motor["joint"]).id
        assert robot.model.actuator_trnid[robot.model.actuator("gripper0_right_" + motor["name"]).id, 0] == joint
        assert motor["stiffness"] == robot.model.actuator("gripper0_right_" + motor["name"]).gainprm[0] > 0
    assert {m["joint"]: tuple(sorted((m["low"], m["high"]))) for m in motors} == {
        joint: pytest.approx(tuple(sorted(pair))) for joint, pair in gripper["targets"].items()
    }


@pytest.mark.parametrize("name", TARGETS)
def test_closing_progress_is_its_formula(alone, native, name):
    manifest, robot = alone(name)[1], native(name)
    says, gripper = manifest["simulation"]["closing_progress"], manifest["gripper"]
    place, command, found = OBSERVATION.names.index("closing_progress"), gripper["preshape"], []
    value = lambda at: eval(says["formula"], {}, {"command": at, "preshape": gripper["preshape"]})  # noqa: E731
    for closing in (0, -1, -1, 1, 1, 1, -1, *[1] * 12):
        observation = robot.apply(np.array([0, 0, 0.2, 0, 0, 0, closing]))
        command = float(np.clip(command + gripper["rate"] * np.sign(closing), -1, 1))
        assert observation[place] == pytest.approx(value(command), abs=1e-12)
        found.append(observation[place])
    assert says["low"] == pytest.approx(value(-1.0)) and says["high"] == pytest.approx(value(1.0))
    assert says["low"] <= min(found) and max(found) <= says["high"] + 1e-12
    assert (says["low"] < -1) == (name == "jaco"), "the Jaco starts half closed"


# -- the world ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", TARGETS)
def test_materials_are_the_tasks(alone, native, name, task):
    simulation, model = alone(name)[1]["simulation"], native(name).model
    made = simulation["materials"]
    assert made["object"]["friction"] == list(task.object.friction) and made["table"]["friction"] == list(TABLE_FRICTION)
    half = alone(name)[1]["task"]["object"]["half_size_m"]
    body = model.body(native(name).env.item.root_body)
    assert 8 * np.prod(half) * simulation["object_density_kg_m3"] == pytest.approx(float(body.mass[0])) == pytest.approx(task.object.mass)
    shapes = {model.geom(g).name.removeprefix("gripper0_right_"): g for g in range(model.ngeom)}
    for shape, says in made.items():
        geom = shapes[{"table": "table_collision", "object": "object_g0"}.get(shape, shape)]
        assert says["solref"] == model.geom_solref[geom].tolist() and says["condim"] == model.geom_condim[geom]
    assert len(made) > 4, "the fingers' shapes are there"
    physics = simulation["physics"]
    assert physics["timestep_s"] * physics["substeps"] == pytest.approx(1 / alone(name)[1]["policy_hz"])
    assert (physics["integrator"], physics["cone"], physics["solver"]) == ("EULER", "ELLIPTIC", "NEWTON")


@pytest.mark.parametrize("name", TARGETS)
def test_poses_are_as_old_as_the_manifest_says_in_robosuites_own_step(alone, native, name, monkeypatch):
    """Every physics step of robosuite's env.step is watched: at which of them does the site stand where the observation has it?"""
    robot, says = native(name), alone(name)[1]["simulation"]["sampling"]
    times, places, angles = [], [], []
    fresh = mujoco.MjData(robot.model)
    inner = robot.env.sim.step2

    def watched():
        times.append(robot.data.time)
        fresh.qpos[:] = robot.data.qpos
        mujoco.mj_kinematics(robot.model, fresh)
        places.append(fresh.site("gripper0_right_grip_site").xpos.copy())
        inner()
        angles.append(robot.data.qpos.copy())

    monkeypatch.setattr(robot.env.sim, "step2", watched)
    seen = robot.apply(np.array([0.8, 0.4, 0.2, 0, 0, 0, -1.0]))
    at = list(np.repeat(list(OBSERVATION), list(OBSERVATION.values()))).index("grasp_position")
    away = [np.abs(START_POSITION + seen[at : at + 3] - place).max() for place in places]
    best = int(np.argmin(away))
    assert away[best] < 1e-9 and min(away[:best] + away[best + 1 :]) > 1e-6
    assert robot.data.time - times[best] == pytest.approx(says["pose_age_s"], abs=1e-9)
    assert says["joint_age_s"] == 0 and np.array_equal(angles[-1], robot.data.qpos)
    assert len(times) == alone(name)[1]["simulation"]["physics"]["substeps"]


@pytest.mark.parametrize("name", [TARGET])
def test_starts_can_be_drawn_from_the_manifest_alone(alone, native, says, name):
    manifest, robot = alone(name)[1], native(name)
    starts, task = manifest["simulation"]["starts"], manifest["task"]
    assert (starts["seed"], starts["episodes"]) == (says.label.seed, says.label.episodes)
    for number in range(starts["episodes"]):
        rng = np.random.default_rng(starts["seed"] + number)
        drawn = {what: rng.uniform(*ends) for what, *ends in zip(starts["draws"], starts["low"], starts["high"], strict=True)}
        robot.begin(starts["seed"] + number)
        place = np.array([*task["object_xy_m"], task["table_top_m"] + task["object"]["half_size_m"][-1]])
        place[:2] += drawn["shift_x"], drawn["shift_y"]
        np.testing.assert_allclose(robot.env.object_position, place, atol=1e-9)
        np.testing.assert_allclose(robot.env.goal, place + task["goal_offset_m"], atol=1e-12)
        if number < len(starts["examples"]):
            assert starts["examples"][number] == pytest.approx([*place, drawn["yaw"], *robot.env.goal], abs=1e-12)


def test_a_start_that_turns_is_told_with_its_yaw(says):
    from toolkit.export.loop import _starts

    task = TASKS["061_foam_brick-wide"]
    starts = _starts(task, says.label)
    rng = np.random.default_rng(says.label.seed)
    shift, turn = rng.uniform(-task.noise_xy, task.noise_xy, 2), rng.uniform(starts.low[2], starts.high[2])
    assert starts.examples[0][3] == pytest.approx(turn, abs=1e-12) and abs(turn) > 0.01
    assert starts.examples[0][0] == pytest.approx(-0.10 + shift[0])


def test_steps_at_the_goal_count_as_the_manifest_says(alone, task):
    """Five hundred random courses of distances, counted by the manifest's words and by the task."""
    says, tolerance, needed = alone(TARGET)[1]["simulation"]["holding"], task.goal_tolerance, task.hold_steps
    rng, outcomes = np.random.default_rng(0), []
    for _ in range(500):
        course = rng.choice([0.0, tolerance, 1.1 * tolerance], 40, p=[0.86, 0.07, 0.07])
        shown = SimpleNamespace(task=task, goal=np.zeros(3), _judge=task.judge(), lost=False)
        count, done = 0, False
        for distance in course:
            shown.object_position = np.array([0, 0, distance])
            reward = Pick.reward(shown)
            near = distance < tolerance if says["strict"] else distance <= tolerance
            count = count + 1 if near else 0 if says["consecutive"] else count
            done = count >= needed
            assert done == bool(reward)
        outcomes.append(done)
    assert 0.05 < np.mean(outcomes) < 0.95, "both must occur"


@pytest.mark.slow
def test_braking_distances_are_those_of_robosuites_own_step(alone, native):
    robot, braking = native("panda"), alone("panda")[1]["braking"]
    for form in ("osc", "pose", "joint"):
        rows = [row for row in braking["distances"] if row["form"] == form]
        assert len(rows) == 3 and all(a["speed_m_s"] < b["speed_m_s"] and a["distance_m"] < b["distance_m"]
                                      for a, b in zip(rows, rows[1:], strict=False))
        assert 0.15 < rows[-1]["speed_m_s"] < 0.4 and rows[-1]["distance_m"] < 0.06 and 0 < rows[-1]["time_s"] <= 0.8
    site = robot.model.site("gripper0_right_grip_site").id
    says, speeds, gone = next(row for row in braking["distances"][::-1] if row["form"] == "osc"), [], []
    for direction in ((1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1)):
        robot.begin(0)
        places = []
        for step in range(24):
            robot.apply((step < 8) * np.array([*direction, 0, 0, 0, -1.0]))  # held, a gripper does not go on either
            mujoco.mj_kinematics(robot.model, robot.data)  # after a step, poses are a substep older than angles
            places.append(robot.data.site_xpos[site].copy())
        speeds.append(np.linalg.norm(places[7] - places[6]) * 20)
        gone.append(max(np.linalg.norm(place - places[7]) for place in places[8:]))
    assert max(speeds) == pytest.approx(says["speed_m_s"], abs=1e-4)
    assert max(gone) == pytest.approx(says["distance_m"], abs=3e-4)  # its limits let the deltas grow from rest, here they are whole at once
    assert says["distance_m"] > 0.005, "robosuite's arm yields"


# -- the schema and the licence ----------------------------------------------------------------------------------------


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


def test_the_licence_is_the_projects(alone):
    text = (ROOT / "pyproject.toml").read_text()
    assert f'license = "{alone(TARGET)[1]["licence"]}"' in text


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

"""What closes the loop around a policy, as the manifest tells it, against robosuite's own controller, gripper and step."""

from pathlib import Path
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
from exported_targets import TARGET, TARGETS

from tasks import TASKS
from tasks.env import Pick
from tasks.pick import OBSERVATION, START_POSITION
from tasks.table import TABLE_FRICTION

ROOT = Path(__file__).parents[2]


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


def test_the_licence_is_the_projects(alone):
    text = (ROOT / "pyproject.toml").read_text()
    assert f'license = "{alone(TARGET)[1]["licence"]}"' in text

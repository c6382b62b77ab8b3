"""What closes the loop around a policy where its label is measured: read from robosuite's environment, never written down twice.

Everything here ends in ``Manifest.simulation``. Numbers are asked of the objects that play: of robosuite's controller, gripper and null
space function by calling them, of the task's count by showing it a few steps, of the compiled model by its arrays.
"""

import tomllib
from importlib import metadata
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from robosuite.utils.control_utils import nullspace_torques

from grippers.gripper import COMMANDED_ROLES
from robots.robot import Robot
from tasks.env import Pick
from tasks.pick import PickTask, at_goal
from toolkit.bundle.manifest import (
    Actuator,
    ClosingProgress,
    Holding,
    Material,
    NullSpace,
    Osc,
    Physics,
    Sampling,
    Simulation,
    Starts,
    Success,
)
from toolkit.export.datasheet import vector
from toolkit.morphology.native_scene import BASE_SITE, GRIPPER_PREFIX, plain_name
from toolkit.morphology.posture import native_env
from toolkit.simulation.plant import Plant

PART = "right"
"""robosuite's name of the only arm of a robot with one arm."""
STATES = 21
"""States of the gripper at which its targets are compared with a straight line."""
EXAMPLES = 3
"""Starts that are written out."""

LAW = (
    "tau = J^T [L_p (kp e_p - kd v); L_r (kp e_R - kd w)] + N^T M (null_space.law) + compensation, cut to torque_limit_nm; "
    "L_p = (J_p M^-1 J_p^T)^-1 and L_r likewise, L = (J M^-1 J^T)^-1; kd = 2 damping_ratio sqrt(kp); v, w relative to the base site"
)
COUPLED = "tau = J^T L [kp e_p - kd v; kp e_R - kd w] + N^T M (null_space.law) + compensation, cut to torque_limit_nm"
NULL_LAW = "kp (posture_rad - q) - kd dq"
ORIENTATION_ERROR = "e_R = (r1 x d1 + r2 x d2 + r3 x d3) / 2 with the columns r of the rotation that is and d of the one wanted"
PROGRESS = "2 * (command - preshape) / (1 - preshape) - 1"


def licence() -> str:
    """SPDX expression under which the package, and with it a bundle, is given: as a checkout or else its installation says."""
    project = Path(__file__).parents[2] / "pyproject.toml"
    if project.is_file():
        return str(tomllib.loads(project.read_text(encoding="utf-8"))["project"]["license"])
    about = metadata.metadata("meta-evolve")
    found = {key: about[key] for key in ("License-Expression", "License") if key in about}
    return next(iter(found.values()), "unknown")


def read_simulation(robot: Robot, task: PickTask, plant: Plant, label: Success) -> Simulation:
    """All that ``Manifest.simulation`` says.

    Args:
        robot, task: what is read.
        plant: the same robot under the compiled control step; is begun anew.
        label: whose starts are told.
    """
    env = native_env(robot, task)
    env.begin(0)
    model = env.sim.model._model
    return Simulation(
        environment=f"{type(env).__module__}.{type(env).__name__} on robosuite's {type(env).__bases__[0].__name__}, {robot.arm} with "
                    f"{robot.gripper.robosuite_type}",
        mount_position_m=vector(robot.base_position), osc=_osc(env), actuators=_actuators(env), closing_progress=_progress(plant),
        materials=_materials(env), object_density_kg_m3=float(task.object.mass / task.object.volume), physics=_physics(model, task),
        sampling=_sampling(plant), starts=_starts(task, label), holding=_holding(task), stopping=(),
    )


# ---- the controller --------------------------------------------------------------------------------------------------


def _osc(env: Pick) -> Osc:
    robot = env.robots[0]
    controller, model, data = robot.composite_controller.part_controllers[PART], env.sim.model._model, env.sim.data._data
    site, quaternion = model.site(BASE_SITE).id, np.empty(4)
    mujoco.mju_mat2Quat(quaternion, data.site_xmat[site])
    low, high = (np.asarray(side, float) for side in (controller.actuator_min, controller.actuator_max))
    if not np.array_equal(low, -high):
        raise ValueError(f"robosuite's {robot.name} pushes by {high} and pulls by {low}; the manifest has one limit for both")
    if not np.allclose(controller.torque_compensation, data.qfrc_bias[controller.qvel_index]):
        raise ValueError("robosuite's controller compensates for something else than MuJoCo's qfrc_bias")
    return Osc(
        config=_plain(robot.part_controller_config[PART]), goal_from=controller._goal_update_mode,
        reference_frame=controller.input_ref_frame, base_position_m=vector(data.site_xpos[site]), base_quaternion=vector(quaternion),
        decoupled=bool(controller.uncoupling), null_space=_null_space(controller.initial_joint), torque_limit_nm=vector(high),
        compensation="gravity and Coriolis torques: MuJoCo's qfrc_bias",
        law=LAW if controller.uncoupling else COUPLED, orientation_error=ORIENTATION_ERROR,
    )


def _null_space(posture: np.ndarray) -> NullSpace:
    """robosuite's gains, which are no setting of it: answers of its own function to a unit error and to a unit speed."""
    one, none = np.ones(1), np.zeros(1)
    unit = np.eye(1)
    kp = float(nullspace_torques(unit, unit, one, none, none)[0])
    kd = -float(nullspace_torques(unit, unit, none, none, one)[0])
    return NullSpace(vector(posture), kp, kd, NULL_LAW)


def _plain(value: Any) -> Any:
    """A configuration as JSON: arrays as lists, and nothing of the simulation itself."""
    if isinstance(value, dict):
        return {str(key): _plain(item) for key, item in value.items() if key != "sim"}
    if isinstance(value, list | tuple | np.ndarray):
        return [_plain(item) for item in value]
    return value.item() if isinstance(value, np.generic) else value


# ---- the gripper -----------------------------------------------------------------------------------------------------


def _actuators(env: Pick) -> tuple[Actuator, ...]:
    """robosuite's gripper, asked by its own functions: which way it integrates, and which target each state is."""
    robot, model = env.robots[0], env.sim.model._model
    gripper, grip = robot.gripper[PART], robot.composite_controller.part_controllers[f"{PART}_gripper"]
    start = np.array(gripper.current_action, float)
    gripper.current_action = np.zeros_like(start)
    signs = np.sign(np.broadcast_to(gripper.format_action(np.ones(1)), start.shape))
    gripper.current_action = start
    states = np.linspace(-1.0, 1.0, STATES)
    targets = []
    for state in states:
        grip.set_goal(np.full(len(start), state))
        targets.append(np.array(grip.run_controller(), float))
    table = np.array(targets)
    out = []
    for place, actuator in enumerate(map(int, robot._ref_joint_gripper_actuator_indexes[PART])):
        column = table[:, place]
        straight = np.interp(states, states[[0, -1]], column[[0, -1]])
        limited = bool(model.actuator_forcelimited[actuator])
        out.append(Actuator(
            name=plain_name(model.actuator(actuator).name), joint=plain_name(model.joint(model.actuator_trnid[actuator, 0]).name),
            start=float(start[place]), sign=float(signs[place]), low=float(column[0]), high=float(column[-1]),
            nonlinearity=float(np.abs(column - straight).max()), stiffness=float(0.0 - model.actuator_biasprm[actuator, 1]),
            damping=float(0.0 - model.actuator_biasprm[actuator, 2]),
            force=vector(model.actuator_forcerange[actuator]) if limited else None,
        ))
    return tuple(out)


def _progress(plant: Plant) -> ClosingProgress:
    low, high = (float(plant.law.progress(np.full(len(COMMANDED_ROLES), end))) for end in (-1.0, 1.0))
    return ClosingProgress(PROGRESS, low, high)


# ---- the world -------------------------------------------------------------------------------------------------------


def _materials(env: Pick) -> dict[str, Material]:
    model = env.sim.model._model
    item = {g for g in range(model.ngeom) if model.geom_bodyid[g] == env.object_body and model.geom_contype[g]}
    found: dict[str, Material] = {}
    for geom in range(model.ngeom):
        name = model.geom(geom).name
        if geom in item:
            name = "object"
        elif name == "table_collision":
            name = "table"
        elif not name.startswith(GRIPPER_PREFIX) or model.geom_group[geom] != 0:
            continue
        found[plain_name(name)] = Material(
            vector(model.geom_friction[geom]), vector(model.geom_solref[geom]), vector(model.geom_solimp[geom]),
            float(model.geom_margin[geom]), float(model.geom_gap[geom]), int(model.geom_condim[geom]), int(model.geom_priority[geom]),
        )
    return found


def _physics(model: mujoco.MjModel, task: PickTask) -> Physics:
    option = model.opt
    word = lambda kind, value, cut: kind(value).name.removeprefix(cut)  # noqa: E731
    return Physics(
        timestep_s=float(option.timestep), substeps=int(round(1.0 / task.control_frequency / option.timestep)),
        integrator=word(mujoco.mjtIntegrator, option.integrator, "mjINT_"), cone=word(mujoco.mjtCone, option.cone, "mjCONE_"),
        solver=word(mujoco.mjtSolver, option.solver, "mjSOL_"), iterations=int(option.iterations), tolerance=float(option.tolerance),
        impratio=float(option.impratio), noslip_iterations=int(option.noslip_iterations), gravity_m_s2=vector(option.gravity),
    )


def _sampling(plant: Plant) -> Sampling:
    """How old what a policy sees is: the last physics step of a policy step is played alone, and looked at from both sides."""
    plant.begin(0)
    action = np.zeros(6 + len(COMMANDED_ROLES))
    action[:3] = 0.5
    plant.set_command(action)
    plant.play_substeps(action, plant.substeps - 1, sets_goal=True)
    before = _grasp_at(plant, plant.data.qpos)
    plant.play_substeps(action, 1, sets_goal=False)
    after, seen = _grasp_at(plant, plant.data.qpos), plant.grasp_position
    step = float(plant.model.opt.timestep)
    ages = [age for age, place in ((0.0, after), (step, before)) if np.abs(seen - place).max() < 1e-12]
    if not ages:
        raise ValueError("the poses that a policy sees are those of neither end of the last physics step")
    when = (
        "once per policy step, after its last physics step; the first after the start's poses are computed. Joint angles are those of "
        f"that instant, poses {1e3 * ages[0]:g} ms older: of the instant before that physics step. At the start, and in golden.npz, both "
        "are of one instant"
    )
    return Sampling(when, 0.0, ages[0], 0.0)


def _grasp_at(plant: Plant, qpos: np.ndarray) -> np.ndarray:
    """Origin (3,) [m] of the grasp frame at a configuration (nq,)."""
    data = mujoco.MjData(plant.model)
    data.qpos[:] = qpos
    mujoco.mj_kinematics(plant.model, data)
    return np.array(data.site_xpos[plant._site])


# ---- the task --------------------------------------------------------------------------------------------------------


def _starts(task: PickTask, label: Success) -> Starts:
    rows = []
    for seed in range(label.seed, label.seed + EXAMPLES):
        pose, goal = task.sample_start(np.random.default_rng(seed))
        if not np.allclose(goal - pose[:3], task.goal_offset, rtol=0.0, atol=1e-12):
            raise ValueError("the goal does not count from where the object starts, as the manifest says")
        rows.append((*vector(pose[:3]), float(2.0 * np.arctan2(pose[6], pose[3])), *vector(goal)))
    noise = (task.noise_xy, task.noise_xy, float(task.noise_yaw))
    return Starts(
        generator="numpy.random.default_rng(seed), its uniform(low, high)", seed=label.seed, episodes=label.episodes,
        draws=("shift_x", "shift_y", "yaw"), low=tuple(0.0 - n for n in noise), high=noise,
        meaning="the object stands upright at object_xy_m + (shift_x, shift_y), turned by yaw about z; the arm always starts alike",
        goal_from="the object's centre at the start of the episode, its shift included, its yaw not", examples=tuple(rows),
    )


def _holding(task: PickTask) -> Holding:
    """The task's own count, shown steps at the goal and away from it."""

    def counts(distances: list[float]) -> bool:
        judge = task.judge()
        for distance in distances:
            judge.tell(at_goal(np.array([0.0, 0.0, distance]), np.zeros(3), task.goal_tolerance))
        return judge.succeeded

    near, edge, away = 0.0, task.goal_tolerance, 2.0 * task.goal_tolerance
    long, short = [near] * task.hold_steps, [near] * (task.hold_steps - 1)
    if not counts(long) or counts(short):
        raise ValueError(f"the task does not succeed after its {task.hold_steps} steps at the goal")
    return Holding(
        consecutive=not counts([*short, away, near]), strict=not counts([edge] * task.hold_steps),
        counted="once after every policy step, from where the object is then, at the goal or on its way through it",
    )

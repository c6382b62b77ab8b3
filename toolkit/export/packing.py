"""Writing a bundle: play the robot, measure it, describe it, and put everything into one folder and one .zip."""

import hashlib
import io
import itertools
import json
import os
import zipfile
from collections.abc import Callable, Mapping
from dataclasses import asdict, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import mujoco
import numpy as np

from grippers.gripper import COMMANDED_ROLES
from robots.robot import Robot
from tasks.pick import ACTION_SIZE, OBJECT_XY, OBSERVATION, START_POSITION, START_ROTATION, PickTask
from tasks.table import TABLE_FULL_SIZE, TABLE_TOP
from toolkit.bundle.manifest import (
    FORMAT,
    FORMAT_VERSION,
    SINCE,
    Acted,
    Braking,
    Cartesian,
    Controller,
    Finger,
    Golden,
    Graph,
    Held,
    Joint,
    Lineage,
    Manifest,
    Observed,
    RobotCard,
    Start,
    Success,
    TaskCard,
    Watch,
)
from toolkit.bundle.onnx_graph import IR_VERSION, OPSET, ActionMap, export_actor, export_onnx, onnx_max_abs_error, peer_words
from toolkit.bundle.reading import (
    ACTOR,
    CONFIG,
    FLAT_ONNX,
    GOLDEN,
    HASHED,
    MANIFEST,
    MJCF,
    ONNX,
    README,
    SAFETENSORS,
    SCENE,
    SCHEMA,
    SIGNATURE,
    URDF,
)
from toolkit.bundle.schema import manifest_schema
from toolkit.bundle.signing import sign
from toolkit.deploy.kinematics import Kinematics
from toolkit.errors import ToolkitError
from toolkit.export import datasheet
from toolkit.export.braking import lowest_rest, measure_braking
from toolkit.export.datasheet import Played, vector
from toolkit.export.loop import licence, read_simulation
from toolkit.export.robot_xml import robot_mjcf
from toolkit.export.scene import scene_mjcf
from toolkit.export.urdf import GRASP, couplings, robot_urdf
from toolkit.io.atomic import write_atomically
from toolkit.io.claims import claim, give_up
from toolkit.learning.policy import GaussianPolicy
from toolkit.morphology.native_scene import ARM_PREFIX, BASE_SITE, GRIP_SITE, GRIPPER_PREFIX, NativeScene, model_sha256, plain_name
from toolkit.runs.provenance import git_state, recorded_versions
from toolkit.simulation.laws import native_plant
from toolkit.simulation.plant import CLOSING, Plant, finger_map

ZIPPED = "bundle.zip"
"""Name of the .zip while it lies beside the files that are in it."""
GOLDEN_VECTORS, GOLDEN_TOLERANCE = 8, 1e-5
RECORDED_SEED = 2 * 10**9
"""Of the recorded episode; those that are only measured follow. Training and evaluation stay below."""
UNDISTURBED, NOISY = 12, 8
"""Episodes from which ranges are taken, without and with the exploration noise of training."""
LOST_BELOW = TABLE_TOP - 0.02
"""Height [m] of tasks.pick.is_lost."""

# Limits are what undisturbed episodes needed, times a margin, but at least a floor; joint speeds never above the datasheet's.
SPEED_MARGIN, SPEED_FLOOR = 1.5, 0.2
"""Joint speed; floor [rad/s]."""
ACCELERATION_MARGIN, ACCELERATION_FLOOR = 2.0, 4.0
"""Joint acceleration; floor [rad/s^2]."""
CARTESIAN_SPEED_FLOOR, CARTESIAN_ACCELERATION_FLOOR = (0.1, 0.3), (1.5, 4.0)
"""[m/s, rad/s] and [m/s^2, rad/s^2]; margins as for joints."""
BOX_MARGIN = (0.05, 0.05, 0.05, 0.2, 0.2, 0.2)
"""[m, rad] around what the grasp frame visited; downwards LOW_MARGIN."""
LOW_MARGIN, CLEARANCE_MARGIN = 0.01, 0.005
"""[m] below the lowest grasp frame, and below the lowest point of the gripper, but then never more than halfway to the table unless
the gripper comes so close to it that it brushes it."""
LEAD = (0.05, 0.05, 0.05, 0.25, 0.25, 0.25)
"""[m, rad] by which a commanded pose may run ahead: as far as one full delta of robosuite's goal does."""
START_ERRORS = (0.01, 0.02, 0.035, 0.05)
"""[rad] half widths of the arm joints' uniform error at the start that are tried, until one is not borne: an arm that stands three degrees
off is not where it was sent, whatever the policy bears."""
STEP_MARGIN, STEP_FLOOR = 1.5, 0.2
"""Change of an action entry per tick."""
JUMP_MARGIN = 3.0
OBJECT = "object"
"""What scene.xml calls the object, and robosuite's prefix of an arm's names."""
GOAL = "set once per policy step from the achieved pose, in the base site's frame, with which it moves until the next"
FRAMES = {
    "task": "origin on the floor under the table's centre, z up, x from the robot's side of the table towards its far side",
    "base": "robot.base_body: the arm's base, placed in the task frame by robot.base_position_m and robot.base_quaternion",
    "controller": "axes of the task frame at the start; turns with the first joint if controller.turns_with_first_joint",
    "grasp": "robosuite's grip site between the pads: x the closing axis towards the thumb, z the approach axis",
    "joint": "the joint's own axis and zero in robot.xml",
    "gripper": "no frame: the gripper's own command",
    "quaternions": "w first",
}
ACTION_NAMES = (*(f"grasp_{kind}_{axis}" for kind in ("translation", "rotation") for axis in "xyz"), "gripper")
ACTION_UNITS = ("controller.translation_m",) * 3 + ("controller.rotation_rad",) * 3 + ("1",)
"""1 is one of these; the gripper's entry counts by its sign."""


def gripper_action_map() -> ActionMap:
    """From the policy's action record to robosuite's action for an arm with a gripper: 6 deltas, 1 closing entry."""
    matrix = np.zeros((7, ACTION_SIZE))
    matrix[:6, :6] = np.eye(6)
    matrix[6, 6 + CLOSING] = 1.0 / len(CLOSING)
    return ActionMap(matrix, np.zeros(7))


def check_records(manifest: Manifest, where: Path) -> None:
    """Refuse, by name, a bundle whose observation or action is not what this release's robots give and take.

    Raises:
        ToolkitError: an entry of another name, place, size, unit or frame.
    """
    wanted = [(name, entry.size, entry.unit, entry.frame) for name, entry in OBSERVATION.entries.items()]
    found = [(entry.name, entry.size, entry.unit, entry.frame) for entry in manifest.observation]
    wanted_action = list(zip(ACTION_NAMES, ACTION_UNITS, strict=True))
    found_action = [(entry.name, entry.unit) for entry in manifest.action]
    for kind, has, needs in (("observation", found, wanted), ("action", found_action, wanted_action)):
        for place in range(max(len(has), len(needs))):
            said, right = (rows[place] if place < len(rows) else ("nothing",) for rows in (has, needs))
            if said != right:
                raise ToolkitError(
                    f"bundle {where} does not fit this release: {kind} {place} is {said[0]!r} {said[1:]}, here it is {right[0]!r} "
                    f"{right[1:]}; export the bundle again"
                )


def check_task(manifest: Manifest, task: PickTask, where: Path) -> None:
    """Refuse a bundle whose task is not the one that has its name here: its label was measured on another.

    Raises:
        ToolkitError: the first entry that differs.
    """
    said = {"policy_hz": manifest.policy_hz, **asdict(manifest.task)}
    here = {"policy_hz": task.control_frequency, **asdict(task_card(task))}
    for entry, value in here.items():
        if said[entry] != value:
            raise ToolkitError(
                f"bundle {where} is of another task {task.name!r}: its {entry} is {said[entry]}, here it is {value}; give the task that "
                "it was made for its values, or export the bundle again"
            )


def write_bundle(
    policy: GaussianPolicy,
    robot: Robot,
    task: PickTask,
    config: Mapping[str, Any],
    lineage: Lineage,
    success: Success,
    out: Path,
    progress: Callable[[str], None] = lambda what: None,
    episodes: tuple[int, int] = (UNDISTURBED, NOISY),
    key: Path | None = None,
    holds: tuple[Held, ...] = (),
) -> Manifest:
    """Export a policy for a robot with a gripper, as the folder ``out`` and the file ``out``.zip.

    They are made beside their place and moved there when all is done: an export that fails leaves an earlier bundle as it was.

    Args:
        policy: what is exported; its mean action is what plays.
        robot: a target.
        task: what it was trained on.
        config: of the run, copied into the manifest.
        lineage: where the policy comes from.
        success: its label.
        out: folder; made if needed, files of an earlier bundle are replaced.
        progress: told what is being done.
        episodes: from which ranges and limits are taken, without and with the noise of training.
        holds: what ``meta-evolve stress`` measured of it; empty: nothing.
        key: OpenSSH private key that signs the manifest; None: nobody signs.

    Raises:
        ToolkitError: the robot has a hand, the policy has other records, or ``out`` cannot be written.
    """
    if robot.gripper.rate is None:
        raise ToolkitError(
            f"robot {robot.name!r} has a hand ({robot.gripper.name}), but a bundle drives a gripper by one entry; "
            "export a target with a gripper"
        )
    out = Path(out)
    try:
        json.dumps(dict(config), allow_nan=False)
    except (TypeError, ValueError) as error:
        raise ToolkitError(f"the run's config is not JSON ({error}); give strings, numbers and lists") from error
    try:
        out.mkdir(parents=True, exist_ok=True)
        claim(out, "wait until it has ended, or choose another --out")
    except OSError as error:
        raise ToolkitError(f"{out} cannot be a bundle's folder ({error.strerror}); choose another --out") from error
    try:
        with TemporaryDirectory(prefix=".export-", dir=out) as folder:  # an earlier bundle stays whole until this one is
            manifest = _write(policy, robot, task, dict(config), lineage, success, Path(folder), out.name, progress, episodes,
                              key, holds)
            for name in (MANIFEST, SIGNATURE):
                (out / name).unlink(missing_ok=True)
            for name in (*HASHED, MANIFEST, *([SIGNATURE] if key else [])):
                os.replace(Path(folder) / name, out / name)
            os.replace(Path(folder) / ZIPPED, _zip_of(out))
    except OSError as error:
        raise ToolkitError(f"{out} cannot be written ({error.strerror}); choose another --out") from error
    finally:
        give_up(out)
        if not any(out.iterdir()):
            out.rmdir()
    return manifest


def _write(
    policy: GaussianPolicy, robot: Robot, task: PickTask, config: dict[str, Any], lineage: Lineage, success: Success, folder: Path,
    name: str, progress: Callable[[str], None], episodes: tuple[int, int], key: Path | None,
    holds: tuple[Held, ...],
) -> Manifest:
    """All files of the bundle ``name``, and its .zip as ZIPPED, into an empty folder."""
    action_map = gripper_action_map()
    export_onnx(policy, folder / ONNX, action_map, OBSERVATION)  # to be measured; once more below, with its metadata
    manifest, files = _describe(policy, robot, task, action_map, folder / ONNX, config, lineage, success, progress, episodes, holds)
    words = _peer_words(manifest)
    export_onnx(policy, folder / ONNX, action_map, OBSERVATION, manifest.label(), words)
    export_onnx(policy, folder / FLAT_ONNX, action_map, OBSERVATION, manifest.label(), words, flat=True)
    policy.save(folder / SAFETENSORS)
    export_actor(policy, folder / ACTOR, action_map, {"licence": manifest.licence or "", "observation_names": words["observation_names"],
                                                      "action_names": ",".join(ACTION_NAMES)})
    files |= {SCHEMA: _json(manifest_schema()), CONFIG: _json(policy_config(manifest))}
    for file, content in files.items():
        write_atomically(folder / file, content)
    digests = {file: hashlib.sha256((folder / file).read_bytes()).hexdigest() for file in HASHED}
    manifest = Manifest(**(manifest.__dict__ | {"sha256": digests}))
    written = _json(manifest.to_json())
    write_atomically(folder / MANIFEST, written)
    if key:
        write_atomically(folder / SIGNATURE, sign(written, key))
    write_atomically(folder / ZIPPED, _zipped(folder, name))
    return manifest


def _json(content: dict[str, Any]) -> bytes:
    return (json.dumps(content, indent=1) + "\n").encode()


def _peer_words(manifest: Manifest) -> dict[str, str]:
    """The manifest in the keys of Isaac Lab and mjlab: arm joints, moved by torques, then the gripper's motors."""
    if manifest.simulation is None:
        raise ValueError("a manifest without its simulation is one of format version 2, which is read and never written")
    actuators, start = manifest.simulation.actuators, manifest.start
    none = [0.0] * len(manifest.joints)
    return peer_words(
        [*(joint.name for joint in manifest.joints), *(motor.joint for motor in actuators)],
        [*none, *(motor.stiffness for motor in actuators)], [*none, *(motor.damping for motor in actuators)],
        [*start.arm_rad, *(start.fingers[motor.joint] for motor in actuators)], [entry.name for entry in manifest.observation],
        [getattr(manifest.controller, entry.unit.removeprefix("controller."), 1.0) for entry in manifest.action],
        "/".join((*manifest.lineage.route, manifest.task.name)),
    )


def policy_config(manifest: Manifest) -> dict[str, Any]:
    """Inputs and outputs in the form of a LeRobot policy's config.json: typed features with shapes, and how they are normalised (not
    at all, outside of the graph); after them what that form has no place for."""
    inputs = sum(entry.size for entry in manifest.observation)
    return {
        "type": "meta_evolve", "n_obs_steps": 1, "n_action_steps": 1,
        "input_features": {"observation.state": {"type": "STATE", "shape": [inputs]}},
        "output_features": {"action": {"type": "ACTION", "shape": [len(manifest.action)]}},
        "normalization_mapping": {"STATE": "IDENTITY", "ACTION": "IDENTITY"}, "device": "cpu", "license": manifest.licence,
        "fps": manifest.policy_hz, "robot_type": manifest.robot.name,
        "observation_names": [f"{entry.name}.{axis}" if entry.size > 1 else entry.name for entry in manifest.observation
                              for axis in ("xyz" if entry.size == 3 else range(entry.size))],
        "action_names": [entry.name for entry in manifest.action], "onnx": FLAT_ONNX, "safetensors": ACTOR,
    }


def _zip_of(out: Path) -> Path:
    return out.with_name(out.name + ".zip")


def _zipped(folder: Path, bundle: str) -> bytes:
    """The folder's files below the bundle's name, with the same dates always: same bundle, same bytes."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        for name in (MANIFEST, *HASHED, *([SIGNATURE] if (folder / SIGNATURE).exists() else [])):
            entry = zipfile.ZipInfo(f"{bundle}/{name}", date_time=(2024, 1, 1, 0, 0, 0))
            entry.compress_type, entry.external_attr = zipfile.ZIP_DEFLATED, 0o644 << 16
            archive.writestr(entry, (folder / name).read_bytes())
    return buffer.getvalue()


def _describe(
    policy: GaussianPolicy, robot: Robot, task: PickTask, action_map: ActionMap, onnx: Path, config: dict[str, Any], lineage: Lineage,
    success: Success, progress: Callable[[str], None], episodes: tuple[int, int], holds: tuple[Held, ...],
) -> tuple[Manifest, dict[str, bytes]]:
    """The manifest without the files' hashes, and the files that are neither policy nor manifest."""
    plant = native_plant(robot, task)
    plant.begin(RECORDED_SEED)
    mjcf, start, scene, coupled = robot_mjcf(plant, robot.name), _start(plant), *_scene(robot, plant)
    native = NativeScene(plant.model)
    flange = plain_name(plant.model.body(native.flange).name)
    kinematics = Kinematics(mjcf, native.arm_names, list(start.fingers), flange, START_ROTATION)
    # What depends on the posture is read here, at the start.
    card, base, fingers = _robot_card(robot, plant, flange), native.osc_base(plant.data)[:3], _fingers(robot, plant)
    progress("measuring the arm's response and the gripper")
    gripper, response = datasheet.measure_gripper(robot, plant), datasheet.measure_response(plant)
    low = _lowest(plant, kinematics)
    undisturbed, disturbed = episodes
    seeds = [RECORDED_SEED + 1 + i for i in range(undisturbed + disturbed)]
    progress(f"playing {undisturbed} undisturbed episodes")
    calm = datasheet.watch(plant, policy, seeds[:undisturbed], False, low)
    progress(f"playing {disturbed} episodes with the noise of training")
    noisy = datasheet.watch(plant, policy, seeds[undisturbed:], True, low)
    golden, arrays = _golden(plant, robot, policy, action_map, onnx)
    watch = _watch(calm, task)
    progress("playing with what is seen coming late")
    late = datasheet.borne_delays(calm, lambda delay: datasheet.watch(plant, policy, seeds[:undisturbed], False, low, delay),
                                  int(watch.stale_s * task.control_frequency))
    progress("playing from start postures that are a little off")
    borne = datasheet.borne_start_error(plant, policy, seeds[:undisturbed], START_ERRORS)
    start = replace(start, **_tolerances(kinematics, start, borne or START_ERRORS[0]))
    progress("reading what else closes the loop")
    simulation = read_simulation(robot, task, plant, success)
    manifest = Manifest(
        format=FORMAT, format_version=SINCE["braking"] - 1, robot=card, task=task_card(task), frames=FRAMES,
        policy_hz=task.control_frequency, controller_hz=float(round(1.0 / plant.model.opt.timestep)),
        controller=_controller(plant, base, response), observation=_observation(calm, noisy),
        action=_action(calm, action_map), fingers=fingers, gripper=gripper, start=start,
        joints=_joints(robot, plant, calm), cartesian=_cartesian(calm, start, task.control_frequency), watch=watch,
        lineage=lineage, success=success,
        golden=golden, graph=Graph(OPSET, IR_VERSION, "float32", "action"), versions=_versions(), run=config,
        sha256={}, simulation=simulation, licence=licence(), holds=holds,
    )
    progress("braking in every form of command")
    braking = Braking(measure_braking(robot, task, manifest, mjcf, arrays["episode_joints"]), table_clearance_m=0.0)  # not known yet
    lowest = min(lowest_rest(played, delay, braking, manifest, action_map) for delay, played in enumerate(late))
    manifest = replace(manifest, format_version=FORMAT_VERSION, braking=replace(braking, table_clearance_m=lowest - CLEARANCE_MARGIN),
                       borne_delay_steps=len(late) - 1)
    urdf = robot_urdf(mjcf, manifest, coupled).encode()
    return manifest, {MJCF: mjcf.encode(), URDF: urdf, SCENE: scene.encode(), GOLDEN: _npz(arrays), README: _readme(manifest).encode()}


def _scene(robot: Robot, plant: Plant) -> tuple[str, dict[str, tuple[str, float, float]]]:
    """scene.xml, and which finger joints the scene couples to which; the plant stands at the recorded episode's start."""
    model, item = plant.model, plant.model.body(plant.object_body).name
    inside = lambda name: OBJECT if name == item else name.removeprefix(ARM_PREFIX).removeprefix(GRIPPER_PREFIX)  # noqa: E731
    driven = {robot.gripper.joints[role] for role in robot.gripper.targets}
    joints = {model.joint(j).name: plain_name(model.joint(j).name) for j in range(model.njnt)}
    scene = scene_mjcf(model, plant.data, robot.name, inside, {GRIP_SITE: GRASP, BASE_SITE: "base"})
    return scene, couplings(model, driven, joints)


def _lowest(plant: Plant, kinematics: Kinematics) -> Callable[[np.ndarray], float]:
    """qpos (nq,) of the scene -> height [m] of the gripper's lowest enclosing shape above the table."""
    scene = NativeScene(plant.model)

    def height(qpos: np.ndarray) -> float:
        kinematics.place(qpos[scene.arm_qpos], qpos[scene.finger_qpos])
        return kinematics.lowest() - TABLE_TOP

    return height


def _robot_card(robot: Robot, plant: Plant, flange: str) -> RobotCard:
    model, data = plant.model, plant.data
    scene = NativeScene(model)
    base, hand, site = scene.base, scene.flange, scene.grip_site
    rotation = data.xmat[hand].reshape(3, 3).T
    tool = np.empty(4)
    mujoco.mju_mat2Quat(tool, np.ascontiguousarray(rotation @ data.site_xmat[site].reshape(3, 3)).ravel())
    return RobotCard(
        name=robot.name, arm=robot.arm, gripper=robot.gripper.robosuite_type, model_sha256=model_sha256(model),
        base_body=plain_name(model.body(base).name), base_position_m=vector(data.xpos[base]),
        base_quaternion=vector(data.xquat[base]), flange_body=flange,
        tool_position_m=vector(rotation @ (data.site_xpos[site] - data.xpos[hand])), tool_quaternion=vector(tool),
    )


def _controller(plant: Plant, base: tuple[bool, np.ndarray, np.ndarray], response: Any) -> Controller:
    """robosuite's own controller, read from the environment."""
    osc = plant.env.robots[0].composite_controller.part_controllers["right"]
    return Controller(
        type=osc.name, input="delta", goal=GOAL, kp=float(osc.kp[0]),
        damping_ratio=float(osc.kd[0] / (2.0 * np.sqrt(osc.kp[0]))), translation_m=float(osc.output_max[0]),
        rotation_rad=float(osc.output_max[3]), base_site=BASE_SITE, base_axis=vector(base[1]), base_anchor_m=vector(base[2]),
        turns_with_first_joint=base[0], response=response,
    )


def _observation(calm: Played, noisy: Played) -> tuple[Observed, ...]:
    rows = np.concatenate(calm.observations + noisy.observations)
    step, any_step = datasheet.largest_step(calm.observations), datasheet.largest_step(calm.observations + noisy.observations)
    out = []
    for name, entry in OBSERVATION.entries.items():
        part = OBSERVATION.slice(name)
        jump = np.maximum(JUMP_MARGIN * any_step[part], entry.jump)
        out.append(Observed(name, entry.size, entry.unit, entry.frame, entry.meaning, vector(rows[:, part].min(axis=0)),
                            vector(rows[:, part].max(axis=0)), vector(step[part]), vector(jump)))
    return tuple(out)


def _action(calm: Played, action_map: ActionMap) -> tuple[Acted, ...]:
    """Six deltas and the gripper's entry, whose sign alone counts."""
    from_rest = [np.vstack([np.zeros(7), action_map(actions)]) for actions in calm.actions]
    rows, step = np.concatenate(from_rest), datasheet.largest_step(from_rest)
    meaning = [f"delta of the controller's goal {word} {axis}" for word in ("along", "about") for axis in "xyz"]
    meaning.append("its sign is integrated, see gripper.law; negative opens, positive closes")
    allowed = np.append(np.clip(np.maximum(STEP_MARGIN * step[:6], STEP_FLOOR), None, 2.0), 2.0)
    return tuple(
        Acted(ACTION_NAMES[i], ACTION_UNITS[i], "controller" if i < 6 else "gripper", meaning[i], -1.0, 1.0, float(allowed[i]),
              float(rows[:, i].min()), float(rows[:, i].max()), float(step[i]))
        for i in range(7)
    )


def _fingers(robot: Robot, plant: Plant) -> dict[str, Finger]:
    """Observation entry -> how to compute it."""
    rows = zip(COMMANDED_ROLES, finger_map(robot, plant.model, plant.data), strict=True)
    return {
        f"finger/{role}": Finger(robot.gripper.joints[role], float(sign), float(start)) for role, (address, sign, start) in rows
        if address >= 0
    }


def _start(plant: Plant) -> Start:
    scene, qpos = NativeScene(plant.model), plant.data.qpos
    quaternion = np.empty(4)
    mujoco.mju_mat2Quat(quaternion, np.ascontiguousarray(START_ROTATION).ravel())
    return Start(
        arm_rad=vector(qpos[scene.arm_qpos]),
        fingers=dict(zip(scene.finger_names, vector(qpos[scene.finger_qpos]), strict=True)),
        grasp_position_m=vector(START_POSITION), grasp_quaternion=vector(quaternion), tolerance_rad=START_ERRORS[0],
        tolerance_m=1.0, tolerance_rotation_rad=1.0,  # until they are measured
    )


def _tolerances(kinematics: Kinematics, start: Start, width: float) -> dict[str, Any]:
    """Start's tolerances where every arm joint may be off by ``width`` [rad]: the grasp frame goes farthest where each is off by all."""
    arm, fingers = np.array(start.arm_rad), np.array(list(start.fingers.values()))
    kinematics.place(arm, fingers)
    here, moved = kinematics.coordinates(), []
    for corner in itertools.product((-width, width), repeat=len(arm)):
        kinematics.place(arm + corner, fingers)
        moved.append(kinematics.coordinates() - here)
    shift, turn = (float(np.linalg.norm(part, axis=1).max()) for part in np.split(np.array(moved), 2, axis=1))
    return {"tolerance_rad": width, "tolerance_m": shift, "tolerance_rotation_rad": turn}


def _joints(robot: Robot, plant: Plant, calm: Played) -> tuple[Joint, ...]:
    """Limits of the arm, from base to flange."""
    model, scene, period = plant.model, NativeScene(plant.model), 1.0 / plant.task.control_frequency
    speed = np.max([np.abs(rows).max(axis=0) for rows in calm.speeds], axis=0)
    push = datasheet.largest_step([np.vstack([np.zeros(rows.shape[1]), rows]) for rows in calm.speeds]) / period
    effort = np.max([np.abs(rows).max(axis=0) for rows in calm.efforts], axis=0)
    fastest = np.full(len(speed), np.inf) if robot.joint_speeds is None else np.array(robot.joint_speeds)
    limit = np.minimum(np.maximum(SPEED_MARGIN * speed, SPEED_FLOOR), fastest)
    out = []
    for i, (joint, motor) in enumerate(zip(scene.arm, scene.arm_actuators, strict=True)):
        low, high = model.jnt_range[joint] if model.jnt_limited[joint] else (None, None)
        out.append(
            Joint(
                name=scene.arm_names[i], low=None if low is None else float(low),
                high=None if high is None else float(high), speed=float(limit[i]),
                acceleration=float(max(ACCELERATION_MARGIN * push[i], ACCELERATION_FLOOR)),
                effort=float(np.abs(model.actuator_ctrlrange[motor]).max()), seen_speed=float(speed[i]),
                seen_acceleration=float(push[i]), seen_effort=float(effort[i]),
            )
        )
    return tuple(out)


def _cartesian(calm: Played, start: Start, rate: float) -> Cartesian:
    """What undisturbed episodes needed, with a margin, and a start within its tolerance."""
    rows = np.concatenate(calm.grasp)
    speed = datasheet.largest_step(calm.grasp) * rate
    push = datasheet.largest_step([np.vstack([np.zeros(6), np.diff(visited, axis=0) * rate]) for visited in calm.grasp]) * rate
    clearance = min(float(heights.min()) for heights in calm.heights)
    margin, begins = np.array(BOX_MARGIN), np.append(start.grasp_position_m, [0.0, 0.0, 0.0])
    about = np.repeat([start.tolerance_m, start.tolerance_rotation_rad], 3)
    low, high = rows.min(axis=0) - margin, rows.max(axis=0) + margin
    low[2] = rows[:, 2].min() - LOW_MARGIN
    low, high = np.minimum(low, begins - about), np.maximum(high, begins + about)
    room = min(CLEARANCE_MARGIN, 0.5 * clearance) if clearance > datasheet.BRUSHING else CLEARANCE_MARGIN
    return Cartesian(
        low=vector(low), high=vector(high),
        speed=vector(np.maximum(SPEED_MARGIN * speed, np.repeat(CARTESIAN_SPEED_FLOOR, 3))),
        acceleration=vector(np.maximum(ACCELERATION_MARGIN * push, np.repeat(CARTESIAN_ACCELERATION_FLOOR, 3))),
        lead=LEAD, table_top_m=TABLE_TOP, table_clearance_m=float(clearance - room),
    )


def _watch(calm: Played, task: PickTask) -> Watch:
    item, height = OBSERVATION.slice("object_from_grasp"), OBSERVATION.slice("goal_from_object").stop - 1
    held = [np.linalg.norm(rows[rows[0, height] - rows[:, height] > 0.02][:, item], axis=1) for rows in calm.observations]
    apart = max((float(distances.max()) for distances in held if len(distances)), default=0.1)
    return Watch(stale_s=2.0 / task.control_frequency, late_ticks=3, hold_ticks=10, held_m=apart + 0.03, tracking_rad=0.2)


def _golden(
    plant: Plant, robot: Robot, policy: GaussianPolicy, action_map: ActionMap, onnx: Path
) -> tuple[Golden, dict[str, np.ndarray]]:
    arrays, success = datasheet.record_episode(plant, robot, policy, RECORDED_SEED)
    seen = arrays["episode_observations"]
    chosen = seen[np.linspace(0, len(seen) - 1, GOLDEN_VECTORS).round().astype(int)].astype(np.float32).astype(float)
    arrays |= {"observations": chosen, "actions": action_map(policy.mean(chosen)), "episode_actions": action_map(policy.mean(seen))}
    error = onnx_max_abs_error(policy, onnx, seen, action_map)
    return Golden(GOLDEN_TOLERANCE, GOLDEN_VECTORS, RECORDED_SEED, len(seen), bool(success), error), arrays


def task_card(task: PickTask) -> TaskCard:
    """A task as a manifest has it."""
    item = task.object
    shape = {"name": item.name, "shape": item.shape, "half_size_m": list(item.half_size), "mass_kg": item.mass}
    return TaskCard(
        name=task.name, object=shape, object_xy_m=vector(OBJECT_XY), noise_xy_m=task.noise_xy, noise_yaw_rad=float(task.noise_yaw),
        table_top_m=TABLE_TOP, table_size_m=TABLE_FULL_SIZE, goal_offset_m=vector(task.goal_offset), goal_tolerance_m=task.goal_tolerance,
        hold_steps=task.hold_steps, horizon_steps=task.horizon, lost_below_m=LOST_BELOW,
    )


def _versions() -> dict[str, str]:
    """What exported it; a checkout adds its commit to this package's version, as PEP 440's local versions do."""
    found = {name: version or "absent" for name, version in recorded_versions().items()}
    state = git_state()
    if state:
        found["meta-evolve"] += f"+{state['commit'][:12]}" + (".dirty" if state["dirty"] else "")
    return found


def _npz(arrays: Mapping[str, np.ndarray]) -> bytes:
    buffer = io.BytesIO()
    np.savez(buffer, allow_pickle=False, **{name: np.asarray(arrays[name], np.float64) for name in sorted(arrays)})
    return buffer.getvalue()


def _held(holds: tuple[Held, ...]) -> list[str]:
    """A table of the conditions that the policy bears; nothing where none was measured."""
    if not holds:
        return []
    units = ["" if h.unit == "1" else f" [{h.unit}]" for h in holds]
    rows = [f"| {h.meaning}{unit} | {h.nominal:g} | {h.low:g} to {h.high:g} | {h.lowest:g} to {h.highest:g} |"
            for h, unit in zip(holds, units, strict=True)]
    return ["## Where it holds", "",
            f"In simulation, each condition alone, {holds[0].episodes} episodes of each value: at least 0.9 of them succeeded there.", "",
            "| condition | in training | holds from, to | tried from, to |", "|---|---|---|---|", *rows, ""]


def _readme(manifest: Manifest) -> str:
    """The bundle for people."""
    m, s = manifest, manifest.success
    steady = ", ".join(f"{v:.2f}" for v in m.controller.response.steady)
    lines = [
        f"# {m.robot.name}: {m.task.name}", "",
        f"A policy that picks the object and carries it to the goal, for {m.robot.arm} with {m.robot.gripper}, "
        f"{m.policy_hz:g} actions a second.", "",
        f"- Success on the unmodified robosuite robot: {s.successes} of {s.episodes} (95 %: {s.ci95[0]:.2f} to {s.ci95[1]:.2f}), "
        f"seeds from {s.seed} on; {s.measured}.",
        f"- It came from {' to '.join(m.lineage.route)} with {m.lineage.sim_epochs} training episodes.",
        "- Never run on hardware. Read docs/deploy.md of meta-evolve before you do.", "",
        "| file | what it is |", "|---|---|",
        "| policy.onnx | named observations in, robosuite's action out; normaliser inside; the manifest in its metadata |",
        "| policy_flat.onnx | the same with one batched input `obs` and the output `actions`; metadata keys of Isaac Lab and mjlab |",
        "| policy.safetensors | the same policy, to be trained on |",
        "| actor.safetensors | the same policy as plain layers; robosuite's action comes out |",
        "| config.json | inputs and outputs in the form of a LeRobot policy's |",
        "| manifest.json | units, frames, order, ranges, limits, controller, gripper, start, simulation, hashes |",
        "| manifest.schema.json | its JSON schema, with the meaning of every entry |",
        "| golden.npz | observations with their actions, and one whole episode, to test a copy with |",
        "| robot.xml | the robot for MuJoCo: frames, joints, limits; boxes and capsules that enclose its meshes |",
        "| robot.urdf | the same as URDF, for ROS, Pinocchio and others |",
        "| scene.xml | robot, motors, couplings, table and object for MuJoCo, to be driven; at the recorded episode's start |", "",
        *_held(m.holds or ()),
        "## What the seven actions mean", "",
        f"1 to 6: deltas of the controller's goal, 1 = {m.controller.translation_m} m or {m.controller.rotation_rad} rad. "
        "The arm does *not* move that far: the goal is set anew from the achieved pose at every step, and the arm "
        f"covers {steady} of it (x y z rx ry rz). "
        "Who sends the deltas to an arm as displacements moves it four to six times too far.",
        f"7: the gripper; its sign counts: -1 opens, +1 closes, {m.gripper.rate:g} of the way from -1 to +1 per step. "
        f"Fully open is {1e3 * m.gripper.opening_m[0]:.0f} mm.", "",
        "## Prove this copy", "", "    meta-evolve verify .", "    meta-evolve deploy . --driver sim --episodes 10", "",
    ]
    return "\n".join(lines)

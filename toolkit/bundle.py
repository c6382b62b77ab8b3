"""A bundle: one trained policy with everything that a robot needs to play it, in a folder of three files.

    policy.onnx          named observations in, robosuite's own action out; needs onnxruntime alone
    policy.safetensors   the same policy, to be trained on
    manifest.json        units, frames, limits, controller, start, hashes, and golden vectors that prove the copy good

Loading runs no code from the files, and imports neither torch nor robosuite.
"""

import hashlib
import json
import tempfile
import zipfile
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from toolkit.errors import ToolkitError
from toolkit.export import ActionMap, OnnxPolicy, export_onnx, load_onnx, onnx_max_abs_error

if TYPE_CHECKING:  # a machine that only loads needs none of these
    from robots.robot import Robot
    from tasks.pick import PickTask
    from toolkit.learning.policy import GaussianPolicy
    from toolkit.simulation.plant import Plant

FORMAT, FORMAT_VERSION = "meta-evolve bundle", 1
ONNX, SAFETENSORS, MANIFEST = "policy.onnx", "policy.safetensors", "manifest.json"
HASHED = (ONNX, SAFETENSORS)
LARGEST_FILE = 64 * 2**20
"""Bytes; a file of a bundle that is larger is none."""
GOLDEN_VECTORS, GOLDEN_TOLERANCE = 8, 1e-5
RECORDED_SEED = 2 * 10**9
"""Of the episode on which the exported policy is compared; training and evaluation stay below."""
REQUIRED = ("robot", "task", "rate_hz", "observation", "action", "golden", "sha256", "onnx_max_abs_error")
TASK_FRAME = "task: origin on the floor under the table's centre, z up; the grasp frame starts over the object"

OBSERVATION_MEANING = {
    "finger": ("rad", "joint", "this joint's displacement from its start angle, see finger_map; 0 if absent there"),
    "closing_progress": ("1", "gripper", "of the integrated closing command since the start: -1 at the preshape, +1 fully closed"),
    "grasp_position": ("m", "task", "grasp frame origin from its start position"),
    "grasp_rotation": ("1", "task", "grasp frame's rotation from its start: axis times sine of the angle"),
    "object_from_grasp": ("m", "task", "object centre from the grasp frame origin"),
    "object_rotation": ("1", "task", "object's rotation from upright at zero yaw: axis times sine of the angle"),
    "goal_from_object": ("m", "task", "goal from the object centre"),
}
"""Observation entry (or its part before the slash) -> unit, frame, meaning."""


# ---- reading ---------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Bundle:
    """A bundle that has been read and checked.

    Attributes:
        path: where it was read from.
        manifest: as written by ``write_bundle``.
        policy: named record of float32 vectors -> robosuite's action (n_act,) in [-1, 1].
    """

    path: Path
    manifest: dict[str, Any]
    policy: OnnxPolicy

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        """robosuite's action (n_act,) for an observation vector (n_obs,), entries in the manifest's order."""
        sizes = list(self.policy.record.values())
        observation = np.asarray(observation)
        if observation.shape != (sum(sizes),):
            raise ToolkitError(f"the observation has shape {observation.shape}; this bundle takes ({sum(sizes)},)")
        return self.policy(dict(zip(self.policy.record, np.split(observation, np.cumsum(sizes)[:-1]), strict=True)))


def load_bundle(path: str | Path) -> Bundle:
    """Read a bundle's folder, or a .zip of it, and check that its files are whole.

    Raises:
        ToolkitError: nothing there, a file missing, truncated, changed or foreign, or of another format version.
    """
    path = Path(path)
    if path.is_dir():
        return _load_folder(path, path)
    if not path.exists():
        raise ToolkitError(f"bundle {path} does not exist; write it: meta-evolve export RUN --target T --out {path}")
    with tempfile.TemporaryDirectory() as folder:
        _unpack(path, Path(folder))
        return _load_folder(Path(folder), path)


def _unpack(path: Path, folder: Path) -> None:
    """The three files of a bundle from a zip, wherever in it they lie; nothing else is written."""
    try:
        with zipfile.ZipFile(path) as archive:
            for entry in archive.infolist():
                name = Path(entry.filename).name
                if name in (*HASHED, MANIFEST) and entry.file_size <= LARGEST_FILE:
                    (folder / name).write_bytes(archive.read(entry))
    except (zipfile.BadZipFile, zlib.error, NotImplementedError, RuntimeError, EOFError, OSError) as error:
        raise ToolkitError(f"{path} is no bundle ({error}); give the folder of an export, or its .zip") from error


def _load_folder(folder: Path, shown: Path) -> Bundle:
    manifest = _manifest(folder, shown)
    for name in HASHED:
        found, wanted = hashlib.sha256(_bytes(folder, name, shown)).hexdigest(), manifest["sha256"].get(name)
        if found != wanted:
            raise ToolkitError(
                f"{shown}/{name} is not the file that the manifest names: its sha256 is {found[:12]}..., "
                f"not {str(wanted)[:12]}...; copy or export the bundle again"
            )
    policy = load_onnx(folder / ONNX)
    record = [(entry.get("name"), entry.get("size")) for entry in manifest["observation"]]
    if record != list(policy.record.items()) or len(manifest["action"]) != policy.n_out:
        raise ToolkitError(f"{shown}/{MANIFEST} describes another policy than {ONNX} holds; export the bundle again")
    return Bundle(shown, manifest, policy)


def _bytes(folder: Path, name: str, shown: Path) -> bytes:
    file = folder / name
    if not file.is_file():
        raise ToolkitError(f"bundle {shown} has no {name}; copy or export it again, whole")
    if file.stat().st_size > LARGEST_FILE:
        raise ToolkitError(f"{shown}/{name} has {file.stat().st_size} bytes, too many for a bundle; export it again")
    return file.read_bytes()


def _manifest(folder: Path, shown: Path) -> dict[str, Any]:
    where = f"{shown}/{MANIFEST}"
    try:
        manifest = json.loads(_bytes(folder, MANIFEST, shown))
    except (ValueError, RecursionError) as error:
        raise ToolkitError(f"{where} is truncated or no JSON ({error}); copy or export the bundle again") from error
    if not isinstance(manifest, dict) or manifest.get("format") != FORMAT:
        raise ToolkitError(f"{where} is no manifest of a {FORMAT}; give a folder that an export wrote")
    if manifest.get("format_version") != FORMAT_VERSION:
        raise ToolkitError(
            f"{where} has format version {manifest.get('format_version')!r}; this release reads {FORMAT_VERSION}; "
            "export the bundle again"
        )
    missing = [key for key in REQUIRED if key not in manifest]
    kinds = {"observation": list, "action": list, "golden": dict, "sha256": dict}
    wrong = [key for key, kind in kinds.items() if not isinstance(manifest.get(key), kind)]
    records = [key for key in ("observation", "action") if key not in wrong]
    wrong += [key for key in records if not all(isinstance(entry, dict) for entry in manifest[key])]
    if missing or wrong:
        raise ToolkitError(f"{where} lacks or garbles {(missing or wrong)[0]!r}; export the bundle again")
    return manifest


def check_bundle(bundle: Bundle) -> dict[str, Any]:
    """Compare a bundle with its golden vectors, and probe its limits.

    Returns:
        onnx_max_abs_error: largest difference from the golden actions; tolerance: what the manifest allows;
        golden_ok: whether it is within; limits_ok: whether no observation of a thousand, however wild, made a finite
        action leave the manifest's limits, and none that holds NaN became a command.

    Raises:
        ToolkitError: golden vectors that do not fit the policy.
    """
    golden = bundle.manifest["golden"]
    try:
        observations, wanted = (np.array(golden[key], float) for key in ("observations", "actions"))
        tolerance = float(golden["tolerance"])
        low, high = (np.array([float(entry[key]) for entry in bundle.manifest["action"]]) for key in ("low", "high"))
    except (KeyError, TypeError, ValueError) as error:
        where = f"{bundle.path}/{MANIFEST}"
        raise ToolkitError(f"{where} has broken golden vectors or limits ({error!r}); export it again") from error
    if wanted.shape != (len(observations), bundle.policy.n_out) or not len(observations):
        raise ToolkitError(
            f"{bundle.path}/{MANIFEST} has golden actions of shape {wanted.shape} for {len(observations)} "
            "observations; export the bundle again"
        )
    found = np.array([bundle(observation) for observation in observations], float)
    error = float(np.abs(found - wanted).max()) if np.isfinite(found).all() else float("inf")
    rng = np.random.default_rng(0)
    size = sum(bundle.policy.record.values())
    wild = 10.0 ** rng.uniform(-3, 30, (1000, 1)) * rng.uniform(-1, 1, (1000, size))
    actions = np.array([bundle(observation) for observation in wild])
    broken = observations[0].copy()
    broken[rng.integers(size)] = np.nan
    inside = bool(((actions >= low) & (actions <= high)).all())
    return {
        "onnx_max_abs_error": error, "tolerance": tolerance, "golden_ok": error <= tolerance,
        "limits_ok": inside and bool(np.isnan(bundle(broken)).all()),
    }  # fmt: skip


# ---- writing ---------------------------------------------------------------------------------------------------------


def gripper_action_map() -> ActionMap:
    """From the policy's action record to robosuite's action for an arm with a gripper: 6 deltas, 1 closing entry."""
    from tasks.pick import ACTION_SIZE
    from toolkit.simulation.plant import CLOSING

    matrix = np.zeros((7, ACTION_SIZE))
    matrix[:6, :6] = np.eye(6)
    matrix[6, 6 + CLOSING] = 1.0 / len(CLOSING)
    return ActionMap(matrix, np.zeros(7))


def write_bundle(
    policy: "GaussianPolicy", robot: "Robot", task: "PickTask", config: Mapping[str, Any], out: Path
) -> dict[str, Any]:
    """Export a policy for a robot with a gripper; the manifest is written last, so that a torn export never loads.

    Args:
        policy: what is exported; its mean action is what plays.
        robot: a target.
        task: what it was trained on.
        config: of the run, copied into the manifest.
        out: folder; made if needed, files of an earlier bundle are replaced.

    Returns:
        the manifest.

    Raises:
        ToolkitError: the robot has a hand, the policy has other records, or ``out`` cannot be written.
    """
    from tasks.pick import OBSERVATION
    from toolkit.runs import write_atomically

    if robot.gripper.rate is None:
        raise ToolkitError(
            f"robot {robot.name!r} has a hand ({robot.gripper.name}), but a bundle drives a gripper by one entry; "
            "export a target with a gripper"
        )
    out = Path(out)
    try:
        out.mkdir(parents=True, exist_ok=True)
        (out / MANIFEST).unlink(missing_ok=True)
    except OSError as error:
        raise ToolkitError(f"{out} cannot be a bundle's folder ({error.strerror}); choose another --out") from error
    action_map = gripper_action_map()
    labels = {"robot": robot.name, "task": task.name, "rate_hz": task.control_frequency, "manifest": MANIFEST}
    export_onnx(policy, out / ONNX, action_map, OBSERVATION, labels)
    policy.save(out / SAFETENSORS)
    manifest = _describe(policy, robot, task, action_map, out) | {"run": dict(config)}
    manifest["sha256"] = {name: hashlib.sha256((out / name).read_bytes()).hexdigest() for name in HASHED}
    try:
        text = json.dumps(manifest, indent=1, allow_nan=False)
    except (TypeError, ValueError) as error:
        raise ToolkitError(f"the run's config is not JSON ({error}); give strings, numbers and lists") from error
    try:
        write_atomically(out / MANIFEST, (text + "\n").encode())
    except OSError as error:
        raise ToolkitError(f"{out / MANIFEST} cannot be written ({error.strerror}); choose another --out") from error
    return json.loads(text)


def _describe(
    policy: "GaussianPolicy", robot: "Robot", task: "PickTask", action_map: ActionMap, out: Path
) -> dict[str, Any]:
    """The manifest, but for what the run and the files say."""
    from toolkit.simulation.plant import native_plant
    from toolkit.simulation.rollout import play

    plant = native_plant(robot, task)
    episode = play(plant, lambda observation, rng: policy.mean(observation), RECORDED_SEED, np.zeros(0))
    chosen = np.linspace(0, len(episode.observations) - 1, GOLDEN_VECTORS).round().astype(int)
    plant.begin(RECORDED_SEED)  # what follows is read at the start posture
    golden = episode.observations[chosen].astype(np.float32).astype(float)
    return {
        "format": FORMAT,
        "format_version": FORMAT_VERSION,
        "robot": {"name": robot.name, "arm": robot.arm, "gripper": robot.gripper.robosuite_type,
                  "mount_position_m": list(robot.base_position)},
        "versions": _versions(),
        "frames": {"task": TASK_FRAME, "grasp": "robosuite's grip site: x closing axis, thumb side, z approach",
                   "quaternions": "w first"},
        "task": _task(task),
        "rate_hz": task.control_frequency,
        "controller": _controller(plant),
        "observation": _observation(),
        "action": _action(),
        "gripper": _gripper(robot),
        "start": _start(robot),
        "arm": _arm(plant),
        "finger_map": _fingers(robot, plant),
        "recorded_episode": {"seed": RECORDED_SEED, "steps": len(episode.observations),
                             "success": bool(episode.success)},
        "onnx_max_abs_error": onnx_max_abs_error(policy, out / ONNX, episode.observations, action_map),
        "golden": {"tolerance": GOLDEN_TOLERANCE, "observations": golden.tolist(),
                   "actions": action_map(policy.mean(golden)).tolist()},
    }  # fmt: skip


def _versions() -> dict[str, str]:
    from importlib import metadata

    return {name: metadata.version(name) for name in ("robosuite", "mujoco")}


def _task(task: "PickTask") -> dict[str, Any]:
    from tasks.pick import GOAL_OFFSET, OBJECT_XY, TABLE_FULL_SIZE, TABLE_TOP

    item = task.object
    return {
        "name": task.name,
        "object": {"name": item.name, "shape": item.shape, "half_size_m": list(item.half_size), "mass_kg": item.mass},
        "object_start": {"xy_m": OBJECT_XY.tolist(), "noise_xy_m": task.noise_xy, "noise_yaw_rad": task.noise_yaw},
        "table": {"top_m": TABLE_TOP, "full_size_m": list(TABLE_FULL_SIZE)},
        "goal_offset_m": GOAL_OFFSET.tolist(),
        "goal_tolerance_m": task.goal_tolerance,
        "hold_steps": task.hold_steps,
        "horizon_steps": task.horizon,
    }


def _controller(plant: "Plant") -> dict[str, Any]:
    """robosuite's own controller, read from the environment that played the recorded episode."""
    from toolkit.morphology.matching import BASE_SITE
    from toolkit.morphology.posture import arm_joints

    osc = plant.env.robots[0].composite_controller.part_controllers["right"]
    site = plant.model.site(BASE_SITE)
    follows = bool(plant.model.body_jntadr[plant.model.site_bodyid[site.id]] == arm_joints(plant.model)[0])
    return {
        "type": osc.name,
        "input": "delta",
        "goal": "set once per policy step from the achieved pose",
        "kp": float(osc.kp[0]),
        "damping_ratio": float(osc.kd[0] / (2.0 * np.sqrt(osc.kp[0]))),
        "output_scale": {"translation_m": float(osc.output_max[0]), "rotation_rad": float(osc.output_max[3])},
        "base_frame": {"site": BASE_SITE, "position_m": plant.data.site_xpos[site.id].tolist(),
                       "axes": "the task's at the start", "turns_with_first_joint": follows},
    }  # fmt: skip


def _observation() -> list[dict[str, Any]]:
    from tasks.pick import OBSERVATION

    out = []
    for name, size in OBSERVATION.items():
        unit, frame, meaning = OBSERVATION_MEANING[name.split("/")[0]]
        out.append({"name": name, "size": size, "unit": unit, "frame": frame, "meaning": meaning})
    return out


def _action() -> list[dict[str, Any]]:
    rows = [
        {"name": f"grasp_{kind}_{axis}", "unit": f"controller.output_scale.{scale}", "frame": "base",
         "meaning": f"OSC delta of the grasp frame: {kind} {'about' if kind == 'rotation' else 'along'} {axis}"}
        for kind, scale in (("translation", "translation_m"), ("rotation", "rotation_rad")) for axis in "xyz"
    ]  # fmt: skip
    rows.append({"name": "gripper", "unit": "1", "frame": "gripper",
                 "meaning": "its sign is integrated, see gripper; negative opens, positive closes"})  # fmt: skip
    return [row | {"size": 1, "low": -1.0, "high": 1.0} for row in rows]


def _gripper(robot: "Robot") -> dict[str, Any]:
    gripper = robot.gripper
    return {
        "law": "command = clip(command + rate_per_step * sign(action), -1, 1)",
        "rate_per_step": gripper.rate,
        "sign": {"open": -1, "closed": 1},
        "preshape_command": gripper.preshape,
        "targets_rad": {gripper.joints[role]: {"open": o, "closed": c} for role, (o, c) in gripper.targets.items()},
    }


def _start(robot: "Robot") -> dict[str, Any]:
    from scipy.spatial.transform import Rotation

    from tasks.pick import START_POSITION, START_ROTATION
    from toolkit.morphology.posture import start_of

    return {
        "arm_rad": start_of(robot).arm.tolist(),
        "grasp_position_m": START_POSITION.tolist(),
        "grasp_quaternion": Rotation.from_matrix(START_ROTATION).as_quat(scalar_first=True).tolist(),
    }


def _arm(plant: "Plant") -> list[dict[str, Any]]:
    """Joint and torque limits of the native model, from base to flange; no limits: null."""
    from toolkit.morphology.posture import arm_joints

    model = plant.model
    by_joint = {int(model.actuator_trnid[a, 0]): a for a in range(model.nu)}
    return [
        {"joint": model.joint(joint).name.removeprefix("robot0_"),
         "limits_rad": model.jnt_range[joint].tolist() if model.jnt_limited[joint] else None,
         "torque_limits_n_m": model.actuator_ctrlrange[by_joint[joint]].tolist()}
        for joint in arm_joints(model)
    ]  # fmt: skip


def _fingers(robot: "Robot", plant: "Plant") -> dict[str, dict[str, Any]]:
    """Observation entry -> how to compute it: sign * (joint angle - start angle)."""
    from grippers.gripper import COMMANDED_ROLES
    from toolkit.simulation.plant import finger_map

    rows = zip(COMMANDED_ROLES, finger_map(robot, plant.model, plant.data), strict=True)
    return {
        f"finger/{role}": {"joint": robot.gripper.joints[role], "sign": sign, "start_rad": start}
        for role, (address, sign, start) in rows if address >= 0
    }  # fmt: skip

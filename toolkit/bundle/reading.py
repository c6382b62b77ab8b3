"""A bundle: one trained policy with everything that a robot needs to play it, as a folder or a .zip of the same files.

    policy.onnx          named observations in, robosuite's own action out; needs onnxruntime alone
    policy_flat.onnx     the same with one input, (batch, numbers of the observation), as Isaac Lab's and mjlab's exporters write it
    policy.safetensors   the same policy, to be trained on
    actor.safetensors    the same policy as plain layers that give robosuite's own action
    config.json          inputs and outputs in the form of a LeRobot policy's
    manifest.json        units, frames, limits, controller, response, gripper, start, lineage, label, simulation, hashes
    manifest.schema.json its JSON schema, with the meaning of every entry
    golden.npz           recorded observations with their actions, and one closed-loop episode
    robot.xml            the robot as MJCF: frames, joints, limits, enclosing boxes and capsules
    robot.urdf           the same as URDF
    scene.xml            robot, motors, couplings, table and object as MJCF, to be driven
    README.md            for people
    manifest.json.sig    signature of the manifest, and with its hashes of all the rest; optional, see toolkit/bundle/signing.py

This file reads and proves; toolkit/export/packing.py writes. Loading runs no code from the files, unpacks nothing to disk, and
imports neither torch nor robosuite.
"""

import hashlib
import zipfile
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from tasks.npz import BROKEN, ArrayError, Arrays
from toolkit.bundle.makers import check_makers_limits
from toolkit.bundle.manifest import Manifest, read_manifest
from toolkit.bundle.onnx_graph import OnnxPolicy, actor_actions, flat_actions, onnx_from_bytes
from toolkit.errors import ToolkitError
from toolkit.io.jsonfiles import parsed
from toolkit.io.quoting import told

ONNX, SAFETENSORS, MANIFEST = "policy.onnx", "policy.safetensors", "manifest.json"
GOLDEN, MJCF, README = "golden.npz", "robot.xml", "README.md"
FLAT_ONNX, ACTOR, SCHEMA, CONFIG = "policy_flat.onnx", "actor.safetensors", "manifest.schema.json", "config.json"
SCENE, URDF = "scene.xml", "robot.urdf"
HASHED_2 = (ONNX, SAFETENSORS, GOLDEN, MJCF, README)
"""Files beside the manifest in format version 2."""
HASHED_3 = (*HASHED_2, FLAT_ONNX, ACTOR, SCHEMA, CONFIG)
"""The same in version 3."""
HASHED = (*HASHED_3, SCENE, URDF)
"""The same since version 4."""
FILES = (*HASHED, MANIFEST)
SIGNATURE = MANIFEST + ".sig"
"""Of the manifest's bytes, named as OpenSSH names it; optional."""
LARGEST_FILE = 64 * 2**20
"""Bytes; a file of a bundle that is larger is none."""
SHIPPED = Path(__file__).parent / "shipped"
"""Bundles that come with the package, each under its name."""
WILD_OBSERVATIONS = 1000


@dataclass(frozen=True, eq=False)
class Bundle:
    """A bundle that has been read and checked.

    Attributes:
        path: where it was read from.
        manifest: what it says.
        policy: named record of float32 vectors -> robosuite's action (n_act,) in [-1, 1].
        golden: arrays of golden.npz; see ``golden_shapes``.
        mjcf: robot.xml.
        files: name -> content of all of its files, as read.
    """

    path: Path
    manifest: Manifest
    policy: OnnxPolicy
    golden: dict[str, np.ndarray]
    mjcf: str
    files: dict[str, bytes]

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        """robosuite's action (n_act,) for an observation vector (n_obs,), entries in the manifest's order."""
        observation = np.asarray(observation)
        if observation.shape != (self.policy.n_in,):
            raise ToolkitError(f"the observation has shape {observation.shape}; this bundle takes ({self.policy.n_in},)")
        return self.policy.act(observation)


def find_bundle(name: str | Path) -> Path:
    """A bundle's path: what lies there, or the bundle of that name that comes with the package.

    Raises:
        ToolkitError: neither; the message lists what is shipped.
    """
    path = Path(name)
    if path.exists():
        return path
    shipped = shipped_bundles()
    if str(name) in shipped:
        return shipped[str(name)]
    listed = f"shipped are: {', '.join(shipped)}" if shipped else "none is shipped with this installation"
    raise ToolkitError(f"bundle {name} does not exist; {listed}; or write one: {told('export', 'RUN', '--target', 'T', '--out', name)}")


def shipped_bundles() -> dict[str, Path]:
    """Name -> path of the bundles that come with the package."""
    found = sorted(SHIPPED.iterdir()) if SHIPPED.is_dir() else []
    return {path.stem: path for path in found if path.suffix == ".zip" or (path / MANIFEST).is_file()}


def load_bundle(path: str | Path) -> Bundle:
    """Read a bundle (a folder, a .zip, or the name of a shipped one) and check that its files are whole and fit together.

    Raises:
        ToolkitError: nothing there, a file missing, truncated, changed or foreign, an entry of the manifest that is missing
            or makes no sense, or another format version.
    """
    path = find_bundle(path)
    files = _read_folder(path) if path.is_dir() else _read_zip(path)
    _there(files, (MANIFEST,), path)
    content = parsed(files[MANIFEST], f"{path}/{MANIFEST}", "copy or export the bundle again")
    manifest = read_manifest(content, f"{path}/{MANIFEST}")
    hashed = {2: HASHED_2, 3: HASHED_3}.get(manifest.format_version, HASHED)
    _there(files, hashed, path)
    check_makers_limits(manifest, f"{path}/{MANIFEST}")
    for name in hashed:
        found, wanted = hashlib.sha256(files[name]).hexdigest(), manifest.sha256.get(name)
        if found != wanted:
            raise ToolkitError(
                f"{path}/{name} is not the file that the manifest names: its sha256 is {found[:12]}..., not {str(wanted)[:12]}...; "
                "copy or export the bundle again"
            )
    policy = onnx_from_bytes(files[ONNX], f"{path}/{ONNX}")
    _same_policy(manifest, policy, path)
    golden = read_golden(files[GOLDEN], manifest, f"{path}/{GOLDEN}")
    try:
        mjcf = files[MJCF].decode("utf-8")
    except UnicodeDecodeError as error:
        raise ToolkitError(f"{path}/{MJCF} is no text ({error}); copy or export the bundle again") from error
    return Bundle(path, manifest, policy, golden, mjcf, files)


def _there(files: dict[str, bytes], names: tuple[str, ...], path: Path) -> None:
    missing = [name for name in names if name not in files]
    if missing:
        raise ToolkitError(f"bundle {path} has no {missing[0]}; copy or export it again, whole")


def _read_folder(path: Path) -> dict[str, bytes]:
    out = {}
    for name in (*FILES, SIGNATURE):
        file = path / name
        if not file.is_file():
            continue
        try:
            size = file.stat().st_size
            if size > LARGEST_FILE:
                raise ToolkitError(f"{file} has {size} bytes, too many for a bundle; export it again")
            out[name] = file.read_bytes()
        except OSError as error:
            raise ToolkitError(f"{file} cannot be read ({error.strerror}); copy or export the bundle again") from None
    return out


def _read_zip(path: Path) -> dict[str, bytes]:
    """The files of a bundle from a zip, at its top or in its only folder, into memory; whatever else it holds is ignored."""
    out: dict[str, bytes] = {}
    try:
        with zipfile.ZipFile(path) as archive:
            for entry in archive.infolist():
                where = PurePosixPath(entry.filename)
                if where.name not in (*FILES, SIGNATURE) or len(where.parts) > 2 or ".." in where.parts or entry.is_dir():
                    continue
                if where.name in out:
                    raise ToolkitError(f"{path} holds {where.name} twice; export the bundle again")
                with archive.open(entry) as file:  # the size in the directory may lie: never read more than allowed
                    content = file.read(LARGEST_FILE + 1)
                if len(content) > LARGEST_FILE:
                    raise ToolkitError(f"{path}/{where.name} has more than {LARGEST_FILE} bytes, too many for a bundle; export it again")
                out[where.name] = content
    except BROKEN as error:
        raise ToolkitError(f"{path} is no bundle ({str(error)[:120]}); give the folder of an export, or its .zip") from error
    return out


def _same_policy(manifest: Manifest, policy: OnnxPolicy, path: Path) -> None:
    """Refuse a manifest that describes another policy than the ONNX file, by the first entry that differs."""
    named = [(entry.name, entry.size) for entry in manifest.observation]
    held = list(policy.record.items())
    for i in range(max(len(named), len(held))):
        said, has = named[i] if i < len(named) else None, held[i] if i < len(held) else None
        if said != has:
            raise ToolkitError(
                f"{path}/{MANIFEST} describes another policy than {ONNX} holds: observation {i} is {_entry(said)} in the manifest, "
                f"{_entry(has)} in the graph; export the bundle again"
            )
    if len(manifest.action) != policy.n_out:
        raise ToolkitError(
            f"{path}/{MANIFEST} describes another policy than {ONNX} holds: {len(manifest.action)} action entries, not {policy.n_out}; "
            "export the bundle again"
        )
    label = manifest.label()
    if policy.metadata != label:
        odd = next((key for key in label if policy.metadata.get(key) != label[key]), "an unknown entry")
        raise ToolkitError(f"{path}/{MANIFEST} and the metadata in {ONNX} differ in {odd!r}; export the bundle again")


def _entry(entry: tuple[str, int] | None) -> str:
    return "absent" if entry is None else f"{entry[0]!r} of size {entry[1]}"


def golden_shapes(manifest: Manifest) -> dict[str, tuple[int, ...]]:
    """Array -> shape in golden.npz: vectors, and one episode's raw readings with what became of them, one row per tick."""
    n, steps = sum(entry.size for entry in manifest.observation), manifest.golden.steps
    act, arm = len(manifest.action), len(manifest.joints)
    return {
        "observations": (manifest.golden.vectors, n), "actions": (manifest.golden.vectors, act),
        "episode_joints": (steps, arm), "episode_fingers": (steps, len(manifest.gripper.joints)),
        "episode_object_position": (steps, 3), "episode_object_quaternion": (steps, 4), "episode_goal": (3,),
        "episode_command": (steps,), "episode_observations": (steps, n), "episode_actions": (steps, act),
    }


def read_golden(content: bytes, manifest: Manifest, where: str) -> dict[str, np.ndarray]:
    """The arrays of golden.npz, every one of the shape that the manifest implies, none with anything but finite float64.

    Raises:
        ToolkitError: one is not; ``where`` names the file.
    """
    try:
        with Arrays(content) as file:
            return {name: file.read(name, shape, ("float64",), LARGEST_FILE) for name, shape in golden_shapes(manifest).items()}
    except ArrayError as error:
        named = f"golden array {error.key!r}" if error.key else "the file"
        raise ToolkitError(f"{where} is damaged: {named} is not as the manifest says (expected {error.expected}, found {error.found}); "
                           "export the bundle again") from None


def _error(found: np.ndarray, wanted: np.ndarray) -> float:
    """Largest difference; infinite where a number is missing or is none."""
    fits = found.shape == wanted.shape and np.isfinite(found).all()
    return float(np.abs(found - wanted).max()) if fits else float("inf")


def check_bundle(bundle: Bundle) -> dict[str, Any]:
    """Compare a bundle with its golden vectors and its recorded episode, and probe its limits.

    Returns:
        onnx_max_abs_error: largest difference from the golden actions, the recorded episode's included; flat_max_abs_error and
        actor_max_abs_error: the same of the graph with one batched input, and of the plain layers, None in format version 2, which has
        neither; tolerance: what the manifest allows; golden_ok: whether all are within; limits_ok: whether no observation of a
        thousand, however wild, made a finite action leave the manifest's limits, and none that holds NaN became a command.

    Raises:
        ToolkitError: one of the files that hold the policy is no such file.
    """
    manifest, golden = bundle.manifest, bundle.golden
    seen = np.concatenate([golden["observations"], golden["episode_observations"]])
    wanted = np.concatenate([golden["actions"], golden["episode_actions"]])
    found = np.array([bundle(observation) for observation in seen], float)
    errors = {"onnx": _error(found, wanted), "flat": None, "actor": None}
    if manifest.format_version >= 3:
        errors["flat"] = _error(flat_actions(bundle.files[FLAT_ONNX], seen, f"{bundle.path}/{FLAT_ONNX}"), wanted)
        errors["actor"] = _error(actor_actions(bundle.files[ACTOR], seen, f"{bundle.path}/{ACTOR}"), wanted)
    worst = max(error for error in errors.values() if error is not None)
    low, high = (np.array([getattr(entry, key) for entry in manifest.action]) for key in ("low", "high"))
    rng = np.random.default_rng(0)
    wild = 10.0 ** rng.uniform(-3, 30, (WILD_OBSERVATIONS, 1)) * rng.uniform(-1, 1, (WILD_OBSERVATIONS, seen.shape[1]))
    actions = np.array([bundle(observation) for observation in wild])
    inside = bool(((actions >= low) & (actions <= high)).all())
    broken = np.repeat(seen[:1], seen.shape[1], axis=0)
    np.fill_diagonal(broken, np.nan)
    return {
        **{f"{name}_max_abs_error": error for name, error in errors.items()}, "tolerance": manifest.golden.tolerance,
        "golden_ok": worst <= manifest.golden.tolerance,
        "limits_ok": inside and bool(np.isnan([bundle(row) for row in broken]).all()),
    }

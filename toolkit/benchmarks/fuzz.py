"""Broken files: every format that the toolkit reads, damaged in thousands of ways, must be refused by a sentence or read.

A sound file of each format is made, damaged as a disk, a transfer or a hand would, and given to the toolkit's one reader of that
format, in a process of its own: a reader that raises anything but its own error, ends its process, takes the memory or does not
come back is found out, and by which file.
"""

import hashlib
import io
import json
import os
import re
import resource
import shutil
import struct
import tempfile
import time
import zipfile
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np

from tasks.dexycb.recording import RecordingError, read_recording, read_vertices, sequences
from tasks.dexycb.standin import write_standin
from toolkit.bundle.onnx_graph import onnx_from_bytes
from toolkit.bundle.reading import GOLDEN, MANIFEST, MJCF, ONNX, SAFETENSORS, load_bundle, read_golden
from toolkit.deploy.arm import State
from toolkit.deploy.kinematics import Kinematics
from toolkit.deploy.runtime import TickLog, rehearse
from toolkit.errors import ToolkitError
from toolkit.evolution import load_points
from toolkit.inspection.drawn_tree import Plan
from toolkit.inspection.recording.deployment import read_log, record_deployment
from toolkit.inspection.recording.viewer import chunks_of
from toolkit.learning.policy import GaussianPolicy
from toolkit.quiet import work_quietly
from toolkit.runs.generators import generator_from_state, generator_state
from toolkit.runs.phases import FOLDER, KeptEpisode, Phase, load_phase
from toolkit.runs.run import Run, read_report, read_tree, transfer_records
from toolkit.simulation.divergence import Divergence

PATIENCE = 30.0
"""[s] that a reader may take for one file."""
MEMORY = 1 << 31
"""[bytes] that a reader may take beyond what the toolkit takes itself."""
EXTREMES = (0, 1, 2, 0x7F, 0x80, 0xFF, 0x7FFF, 0xFFFF, 0x7FFFFFFF, 0xFFFFFFFF, 2**63 - 1, 2**64 - 1)
WORDS = (b"0", b"-1", b"1e400", b"-1e308", b"NaN", b"Infinity", b"9" * 400, b"9" * 5000, b'"x"', b"null", b"true", b"[]", b"{}", b"[[[]]]",
         b'"../../x"', b'""', b"'", b"\\", b"&", b"<", b"[" * 3000, b"\xff\xfe", b"\x00", b"1.5", b"10000000000000", b"'<f8'", b"'|O'",
         b"'<U9999999'", b"(((((")
"""In place of numbers and words of a text."""
_TOKEN = re.compile(rb'-?\d+(?:\.\d+)?(?:[eE][+-]?\d+)?|"[^"\\]{0,60}"|\w+|[{}\[\](),:=<>]')

Reader = Callable[[Path], Any]
Damage = Callable[[bytes, np.random.Generator], bytes]


@dataclass
class Tally:
    """What became of a format's files.

    Attributes:
        format: its name.
        files: how many were tried.
        refused: with the reader's own sentence.  read: as if nothing were wrong, as where no number that matters was hit.
        broken: another error -> how often; "died" and "hung" are the process's.
        first: number of the first broken file and what was raised; empty if none was.
        slowest: [s] that one file took.
    """

    format: str
    files: int = 0
    refused: int = 0
    read: int = 0
    broken: Counter = field(default_factory=Counter)
    first: str = ""
    slowest: float = 0.0

    def to_json(self) -> dict[str, Any]:
        """The contract of ``meta-evolve bench fuzz --json``."""
        return self.__dict__ | {"broken": dict(self.broken)}


def fuzz(
    formats: Sequence[str], files: int, seed: int, bundle: Path, progress: Callable[[str, int], None] = lambda name, done: None
) -> Iterator[Tally]:
    """Damage files of some formats and read them.

    Args:
        formats: of ``FORMATS``.
        files: of each.
        seed: of the damage; the same seed damages alike.
        bundle: that is damaged.
        progress: called with a format and how many of its files are done.

    Yields:
        a tally per format.
    """
    for name in formats:
        tally = Tally(name)
        while tally.files < files:
            _read_in_a_process(tally, files, seed, bundle, progress)
        yield tally


def _read_in_a_process(tally: Tally, files: int, seed: int, bundle: Path, progress: Callable[[str, int], None]) -> None:
    """Go on with a format's files until all are read or the process ends, which is the fault of the file that it was reading."""
    context = get_context("spawn")
    here, there = context.Pipe(duplex=False)
    arguments = (__name__, work.__name__, there, tally.format, range(tally.files, files), seed, bundle)
    process = context.Process(target=work_quietly, args=arguments, daemon=True)
    process.start()
    there.close()
    patience = 10 * PATIENCE  # the first file waits for imports and for its own making
    try:
        while tally.files < files:
            if not here.poll(patience):
                _note(tally, "hung", "", patience)
                return
            try:
                outcome, detail, seconds = here.recv()
            except EOFError:
                process.join(PATIENCE)
                _note(tally, "died", f"exit status {process.exitcode}", 0.0)
                return
            patience = PATIENCE
            if outcome == "begun":
                continue
            _note(tally, outcome, detail, seconds)
            progress(tally.format, tally.files)
    finally:
        process.kill()
        process.join()
        here.close()


def _note(tally: Tally, outcome: str, detail: str, seconds: float) -> None:
    tally.slowest = max(tally.slowest, seconds)
    if outcome in ("refused", "read"):
        setattr(tally, outcome, getattr(tally, outcome) + 1)
    else:
        tally.broken[outcome] += 1
        tally.first = tally.first or f"file {tally.files}: {outcome} {detail}"[:200]
    tally.files += 1


def work(pipe: Any, name: str, numbers: range, seed: int, bundle: Path) -> None:
    """In the child: make the sound file of a format, then damage and read one after the other, and send what came of each."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)  # what libraries print of a broken file is no figure
    with tempfile.TemporaryDirectory() as folder:
        sample = FORMATS[name](Path(folder), bundle)
        sample.read(sample.file)  # what is sound is read, and everything is imported and compiled
        sound = sample.file.read_bytes()
        used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (used + MEMORY, resource.RLIM_INFINITY))
        pipe.send(("begun", "", 0.0))
        for number in numbers:
            pipe.send(outcome_of(sample, sound, np.random.default_rng((seed, number))))


def outcome_of(sample: "Sample", sound: bytes, rng: np.random.Generator) -> tuple[str, str, float]:
    """Damage a sample's sound content and let it be read: "refused", "read" or the error's name; what it said; how long it took [s]."""
    sample.file.write_bytes(sample.damages[int(rng.integers(len(sample.damages)))](sound, rng))
    began = time.perf_counter()
    try:
        sample.read(sample.file)
        outcome, detail = "read", ""
    except (ToolkitError, RecordingError) as error:
        outcome, detail = "refused", str(error)
    except Exception as error:  # noqa: BLE001  whatever it is, it is what is looked for
        outcome, detail = type(error).__name__, " ".join(str(error).split())[:150]
    return outcome, detail, time.perf_counter() - began


# ---- damage ----------------------------------------------------------------------------------------------------------


def rot(content: bytes, rng: np.random.Generator) -> bytes:
    """As a disk or a transfer does: bits flipped, parts lost, repeated, zeroed, or numbers set to an extreme."""
    data = bytearray(content)
    for _ in range(int(rng.integers(1, 4))):
        if not data:
            return bytes(data)
        at, size, kind = int(rng.integers(len(data))), int(rng.integers(1, 64)), int(rng.integers(7))
        if kind == 0:
            data[at] ^= 1 << int(rng.integers(8))
        elif kind == 1:
            del data[at:]
        elif kind == 2:
            del data[at : at + size]
        elif kind == 3:
            data[at:at] = rng.bytes(size)
        elif kind == 4:
            data[at : at + size] = bytes(len(data[at : at + size]))
        elif kind == 5:
            other = int(rng.integers(len(data)))
            data[at : at + size] = data[other : other + size]
        else:
            width = int(rng.choice([1, 2, 4, 8]))
            data[at : at + width] = (int(EXTREMES[rng.integers(len(EXTREMES))]) % 256**width).to_bytes(width, "little")
    return bytes(data)


def reword(content: bytes, rng: np.random.Generator) -> bytes:
    """As a hand does: numbers, words and brackets of a text exchanged for others, or left out."""
    places = list(_TOKEN.finditer(content))
    out = bytearray(content)
    for index in sorted((int(i) for i in rng.integers(len(places), size=int(rng.integers(1, 4)))), reverse=True):
        word = WORDS[int(rng.integers(len(WORDS)))] if rng.random() < 0.85 else b""
        out[places[index].start() : places[index].end()] = word
    return bytes(out)


def retype(content: bytes, rng: np.random.Generator) -> bytes:
    """A JSON value, somewhere in it, of another kind; the text stays JSON."""
    tree = json.loads(content)
    odd: list[Any] = [None, True, -1, 0, 2**70, 10**400, 1e308, float("nan"), "", "x", "../x", [], {}, [[]], [None], {"x": 1}, "a\n\x1b[2J"]
    value = odd[int(rng.integers(len(odd)))]
    holder: Any = None
    key: Any = None
    node = tree
    while isinstance(node, dict | list) and node and (holder is None or rng.random() < 0.85):
        holder = node
        key = list(node)[int(rng.integers(len(node)))] if isinstance(node, dict) else int(rng.integers(len(node)))
        node = node[key]
    if holder is None or rng.random() < 0.03:
        return json.dumps(value).encode()
    if rng.random() < 0.2:
        del holder[key]
    else:
        holder[key] = value
    return json.dumps(tree).encode()


def lines(damage: Damage) -> Damage:
    """Damage to one line of a text."""

    def damaged(content: bytes, rng: np.random.Generator) -> bytes:
        rows = content.split(b"\n")
        index = int(rng.integers(max(1, len(rows) - 1)))
        rows[index] = damage(rows[index], rng) if rows[index] else b"x"
        return b"\n".join(rows)

    return damaged


def member(damage: Damage) -> Damage:
    """Damage to one file of a zip, which stays a sound zip, or to what the zip says of that file."""

    def damaged(content: bytes, rng: np.random.Generator) -> bytes:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            files = {name: archive.read(name) for name in archive.namelist()}
        name = list(files)[int(rng.integers(len(files)))]
        files[name] = damage(files[name], rng)
        packed = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA)[int(rng.integers(4))]
        buffer = io.BytesIO()
        with zipfile.ZipFile(buffer, "w", packed) as archive:
            for entry, data in files.items():
                archive.writestr(entry, data)
        out = bytearray(buffer.getvalue())
        if rng.random() < 0.3:  # a flag (encrypted, ...), a method or a size in a header
            mark, offsets = ((b"PK\x01\x02", (8, 10, 20, 24)), (b"PK\x03\x04", (6, 8, 18, 22)))[int(rng.integers(2))]
            starts = [match.start() for match in re.finditer(re.escape(mark), bytes(out))]
            at = starts[int(rng.integers(len(starts)))] + offsets[int(rng.integers(4))]
            out[at] = int(rng.integers(256))
        return bytes(out)

    return damaged


def npy_header(content: bytes, rng: np.random.Generator) -> bytes:
    """Another shape, type or text in an array's header, whose length fits."""
    size = struct.unpack("<H", content[8:10])[0]
    header, data = content[10 : 10 + size], content[10 + size :]
    shapes = ("0", "1", "3,4", "-1", str(10**13), str(10**30), "2," * 40, "1.5", "'x'", "")
    if rng.random() < 0.5:
        shape = shapes[int(rng.integers(len(shapes)))].encode()
        header = re.sub(rb"\([^)]*\)", b"(" + shape + b",)", header)
    else:
        header = reword(header, rng)
    header = header[:60_000]
    return content[:8] + struct.pack("<H", len(header)) + header + data


def tensor_header(content: bytes, rng: np.random.Generator) -> bytes:
    """The JSON header of safetensors with something else in it, its length fitting."""
    size = struct.unpack("<Q", content[:8])[0]
    damage = (retype, reword)[int(rng.integers(2))]
    header = damage(content[8 : 8 + size], rng)
    return struct.pack("<Q", len(header)) + header + content[8 + size :]


def tensor_state(key: str) -> Damage:
    """The JSON that travels as a text in the header of safetensors, of other kinds somewhere."""

    def damaged(content: bytes, rng: np.random.Generator) -> bytes:
        size = struct.unpack("<Q", content[:8])[0]
        header = json.loads(content[8 : 8 + size])
        header["__metadata__"][key] = retype(header["__metadata__"][key].encode(), rng).decode()
        text = json.dumps(header).encode()
        return struct.pack("<Q", len(text)) + text + content[8 + size :]

    return damaged


def rehashed(damage: Damage) -> Damage:
    """Damage to one file of a bundle's .zip, and the manifest's hashes made to fit: what a forger does."""

    def damaged(content: bytes, rng: np.random.Generator) -> bytes:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            files = {Path(name).name: archive.read(name) for name in archive.namelist()}
        name = [key for key in files if key != MANIFEST][int(rng.integers(len(files) - 1))]
        files[name] = damage(files[name], rng)
        manifest = json.loads(files[MANIFEST])
        manifest["sha256"] = {key: hashlib.sha256(files[key]).hexdigest() for key in manifest["sha256"]}
        files[MANIFEST] = json.dumps(manifest).encode()
        buffer = io.BytesIO()
        with zipfile.ZipFile(buffer, "w") as archive:
            for entry, data in files.items():
                archive.writestr(entry, data)
        return buffer.getvalue()

    return damaged


NPZ: tuple[Damage, ...] = (rot, member(rot), member(npy_header), member(npy_header))
JSON: tuple[Damage, ...] = (rot, reword, retype, retype)
TEXT: tuple[Damage, ...] = (rot, reword)


# ---- sound files, and their readers ----------------------------------------------------------------------------------


@dataclass(frozen=True)
class Sample:
    """A sound file, how it is damaged, and who reads it."""

    file: Path
    damages: tuple[Damage, ...]
    read: Reader


def _unpacked(folder: Path, bundle: Path) -> Path:
    out = folder / "bundle"
    if bundle.is_dir():
        shutil.copytree(bundle, out)
        return out
    out.mkdir()
    with zipfile.ZipFile(bundle) as archive:
        for name in archive.namelist():
            (out / Path(name).name).write_bytes(archive.read(name))
    return out


def _zip(folder: Path, bundle: Path) -> Sample:
    path = folder / "bundle.zip"
    with zipfile.ZipFile(path, "w") as archive:  # stored: damage hits what is in it, not how it is packed
        for file in sorted(_unpacked(folder, bundle).iterdir()):
            archive.write(file, file.name)
    return Sample(path, (rot, member(rot), rehashed(rot), rehashed(reword)), load_bundle)


def _manifest(folder: Path, bundle: Path) -> Sample:
    out = _unpacked(folder, bundle)
    return Sample(out / MANIFEST, JSON, lambda file: load_bundle(file.parent))


def _golden(folder: Path, bundle: Path) -> Sample:
    file, manifest = _unpacked(folder, bundle) / GOLDEN, load_bundle(bundle).manifest
    return Sample(file, NPZ, lambda file: read_golden(file.read_bytes(), manifest, str(file)))


def _onnx(folder: Path, bundle: Path) -> Sample:
    return Sample(_unpacked(folder, bundle) / ONNX, (rot, rot, reword), lambda file: onnx_from_bytes(file.read_bytes(), str(file)))


def _policy(folder: Path, bundle: Path) -> Sample:
    damages = (rot, tensor_header, tensor_state("meta_evolve"))
    return Sample(_unpacked(folder, bundle) / SAFETENSORS, damages, GaussianPolicy.load)


def _mjcf(folder: Path, bundle: Path) -> Sample:
    manifest = load_bundle(bundle).manifest
    return Sample(_unpacked(folder, bundle) / MJCF, TEXT, lambda file: Kinematics.of(manifest, file.read_text(errors="replace")))


def _checkpoint(folder: Path, bundle: Path) -> Sample:
    run = Run.create(folder / "run", {})
    state = {"rng": generator_state(np.random.default_rng(0)), "updates": 3}
    file = run.save_checkpoint("last", {"a": np.arange(6.0), "b": np.zeros((2, 3), np.float32)}, state)

    def read(file: Path) -> None:
        _, state = run.load_checkpoint(file.stem)
        generator_from_state(state.get("rng", {}))

    return Sample(file, (rot, tensor_header, tensor_state("state")), read)


def _phase(folder: Path, bundle: Path) -> Sample:
    network = {"parameters": np.zeros(4), "shift": np.zeros(2), "scale": np.ones(2)}
    episodes = [KeptEpisode(seed, False, True, False, 9, 1.1, 0, 0, np.full(3, 0.5), [role]) for seed, role in enumerate(("first", "last"))]
    phase = Phase("path 1", 0, "evolve", ["a"], np.zeros(3), np.ones(3), [network], episodes)
    phase.save(folder)
    return Sample(folder / FOLDER / f"{phase.name}.safetensors", (rot, tensor_header, tensor_state("state")), load_phase)


def _divergence(folder: Path, bundle: Path) -> Sample:
    dump = Divergence(("a", "b"), False, "t", 1, np.zeros(3), np.zeros(9), np.zeros(4), np.zeros(3), np.ones((2, 5)))
    dump.save(folder / "divergence.npz")
    return Sample(folder / "divergence.npz", NPZ, Divergence.load)


def _report_of() -> dict[str, Any]:
    one = {"episodes": 4, "successes": 3, "success_rate": 0.75, "ci95": [0.3, 0.95], "seed": 10**9}
    counts = {"path 1": 3}
    return {
        "targets": {"a": {"native": one, "merged": one}}, "train_iterations": counts, "sim_epochs": counts, "check_episodes": counts,
        "routes": {"path 1": ["s", "a"]}, "totals": dict.fromkeys(("train_iterations", "sim_epochs", "check_episodes", "diverged"), 3),
        "wall_s": 3.0, "time": {"wall_s": 2.0, "learn_s": 1.0, "outside_playing": 0.1}, "kind": "steiner", "metric": "l1",
        "step": "adaptive", "path": "straight", "source": "s", "task": "t", "seed": 0,
    }


def _run_of(folder: Path) -> Run:
    run = Run.create(folder / "run", {"source": "s", "targets": ["a"], "task": "t", "transfer": {"xi": 0.03, "threshold": 0.66, "seed": 1}})
    counts = dict.fromkeys(("train_iterations", "sim_epochs", "check_episodes", "diverged"), 2)
    for event in ({"event": "check", "success": 0.5}, {"event": "moved"}, {"event": "arrived", "target": "a"}):
        run.append_metrics(event | {"path": "path 1", "stage": "evolve"} | counts)
    run.write_json("report", _report_of())
    nodes = [{"name": "s", "kind": "source", "alpha": [0.0, 0.0]}, {"name": "a", "kind": "target", "alpha": [1.0, 0.5]}]
    run.write_json("tree", {"metric": "l1", "kind": "steiner", "nodes": nodes, "edges": [{"from": "s", "to": "a", "length": 1.5}]})
    return run


def _config(folder: Path, bundle: Path) -> Sample:
    return Sample(_run_of(folder).path / "config.json", JSON, lambda file: Run.open(file.parent))


def _metrics(folder: Path, bundle: Path) -> Sample:
    run = _run_of(folder)
    return Sample(run.path / "metrics.jsonl", (rot, reword, lines(retype), lines(retype)), lambda file: transfer_records(run))


def _report(folder: Path, bundle: Path) -> Sample:
    return Sample(_run_of(folder).path / "report.json", JSON, lambda file: read_report(file.parent))


def _tree(folder: Path, bundle: Path) -> Sample:
    return Sample(_run_of(folder).path / "tree.json", JSON, lambda file: Plan(read_tree(file.parent)))


def _points(folder: Path, bundle: Path) -> Sample:
    file = folder / "points.json"
    robots = [{"name": name, "alpha": [0.1 * k, 0.5]} for k, name in enumerate("sab")]
    file.write_text(json.dumps({"source": robots[0], "targets": robots[1:]}))
    return Sample(file, JSON, load_points)


def _log(folder: Path, bundle: Path) -> Sample:
    file, whole = folder / "log.jsonl", load_bundle(bundle)
    log = TickLog(file, {"robot": "r", "task": "t", "form": "osc", "pace": "real"})
    g = whole.golden
    for number, turn in zip(range(6), rehearse(whole, "osc"), strict=False):
        state = State(0.0, g["episode_joints"][number], g["episode_object_position"][number], g["episode_object_quaternion"][number],
                      g["episode_goal"])
        tick = turn()
        tick.times |= {"read": 0.0, "send": 0.0}
        log.tick(0, number, state, tick, tick.command, False, number / whole.manifest.policy_hz)
    log.note(0, "stop", "the end")
    log.close()
    return Sample(file, (rot, reword, lines(retype), lines(retype)), read_log)


def _recording(glob: str, damages: tuple[Damage, ...]) -> Callable[[Path, Path], Sample]:
    def make(folder: Path, bundle: Path) -> Sample:
        root = folder / "hands"
        (name,) = write_standin(root, ("061_foam_brick",), 1, 0, 10)
        return Sample(sorted(root.glob(glob))[0], damages, lambda file: read_recording(root, sequences(root)[0]) and name)

    return make


def _mesh(folder: Path, bundle: Path) -> Sample:
    file = folder / "models" / "box" / "textured_simple.obj"
    file.parent.mkdir(parents=True)
    corners = [f"v {x} {y} {z}" for x in (0.0, 0.1) for y in (0.0, 0.05) for z in (0.0, 0.07)]
    file.write_text("\n".join(["# a box", *corners, "f 1 2 3", ""]))
    return Sample(file, TEXT, lambda file: read_vertices(folder, "box"))


def _rrd(folder: Path, bundle: Path) -> Sample:
    file = record_deployment(_log(folder, bundle).file)
    return Sample(file, (rot,), lambda file: sum(chunk.to_record_batch().num_rows for chunk in chunks_of(file)))


FORMATS: dict[str, Callable[[Path, Path], Sample]] = {
    "bundle.zip": _zip, "manifest.json": _manifest, "golden.npz": _golden, "policy.onnx": _onnx, "policy.safetensors": _policy,
    "robot.xml": _mjcf, "checkpoint.safetensors": _checkpoint, "phase.safetensors": _phase, "divergence.npz": _divergence,
    "config.json": _config, "metrics.jsonl": _metrics, "report.json": _report, "tree.json": _tree, "points.json": _points,
    "deployment.jsonl": _log, "meta.yml": _recording("*/*/meta.yml", TEXT),
    "extrinsics.yml": _recording("calibration/extrinsics_*/extrinsics.yml", TEXT), "pose.npz": _recording("*/*/pose.npz", NPZ),
    "labels.npz": _recording("*/*/*/labels_000005.npz", NPZ), "mesh.obj": _mesh, "recording.rrd": _rrd,
}
"""Format -> its sound file, made in a folder with the help of a bundle."""

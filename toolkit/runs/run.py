"""A run folder `logs/<run>/`: everything needed to explain a run and to continue it.

    config.json                what was asked for; --resume refuses any other
    versions.json, git.json    what it ran on
    metrics.jsonl              one JSON record per iteration
    checkpoints/*.safetensors  tensors, and in the same file's header the rest of the state
    command.json               the words of the command that started it, but for its folder
    report.json, summary.md    what came out

Every file but metrics.jsonl appears whole or not at all; a torn last line of metrics.jsonl is dropped on resume.
"""

import json
import math
import os
import re
import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from safetensors.numpy import save as safetensors_bytes

from toolkit.errors import ToolkitError
from toolkit.io.atomic import write_atomically
from toolkit.io.claims import LOCK, claim, give_up
from toolkit.io.jsonfiles import content_of, json_value, parsed, parsed_object, read_object, require
from toolkit.io.quoting import told
from toolkit.io.tensors import read_tensors
from toolkit.runs.provenance import git_state, recorded_versions

ABSENT = "(absent)"
CLAIMED = "wait until it has ended, or end it"
"""The mend where another process works on a run."""


def continuing(folder: Path) -> str:
    """The command that continues a transfer's run, to be pasted: the one that started it, where that is known."""
    try:
        words = require(read_object(folder / "command.json", ""), {"words": [str]}, "", "")["words"]
    except ToolkitError:
        words = ["transfer"]  # a run of an older version
    return told(*words, "--run", folder, "--resume")


class Run:
    """One run folder. Make it with `Run.create` or `Run.open`.

    Attributes:
        path: the folder.
        config: what the run was started with, as it reads back from JSON.
    """

    def __init__(self, path: Path, config: dict[str, Any]) -> None:
        self.path = path
        self.config = config
        self._made: Path | None = None  # the first folder that did not exist before, of a run that was started here

    @classmethod
    def create(cls, path: Path | str, config: dict[str, Any]) -> "Run":
        """Start a run in a new or empty folder.

        Args:
            path: the folder; parents are made.
            config: all that determines the run; JSON values, NumPy scalars and arrays, paths.

        Raises:
            ToolkitError: the folder holds files already, another process works there, it cannot be written, or config is not JSON.
        """
        path = Path(path)
        made = next((parent for parent in [*reversed(path.parents), path] if not parent.exists()), None)
        run = cls(path, json_value(config))
        try:
            path.mkdir(parents=True, exist_ok=True)
            claim(path, CLAIMED)
            if any(file.name != LOCK for file in path.iterdir()):
                give_up(path)
                raise ToolkitError(f"run folder {path} exists; add --resume to continue it, or choose another --run")
            run._made = made or path
            (path / "checkpoints").mkdir()
            write_atomically(path / "config.json", _json_bytes(config, "config"))
            write_atomically(path / "versions.json", _json_bytes(recorded_versions(), "versions"))
            write_atomically(path / "git.json", _json_bytes(git_state(), "git"))
        except (FileExistsError, NotADirectoryError):
            raise ToolkitError(f"run folder {path} is a file or lies below one; choose another --run") from None
        except OSError as error:
            run.end(failed=True)
            raise _unwritable(path, error) from None
        except ToolkitError:
            run.end(failed=True)
            raise
        return run

    @classmethod
    def open(cls, path: Path | str, config: dict[str, Any] | None = None) -> "Run":
        """Look at a run, which may be going on: nothing is written. Or, with its config, continue it.

        Args:
            path: the folder of an earlier run.
            config: of the job that continues it; it must equal the stored one. A torn last line of the metrics is then dropped
                from the file.

        Raises:
            ToolkitError: no such run, a broken config.json or metrics.jsonl, another config, not writable, or another process works on it.
        """
        path = Path(path)
        if not path.is_dir():
            raise ToolkitError(f"run folder {path} does not exist; check the path")
        stored = _read_json_object(path / "config.json", "start the run again under another --run")
        if config is not None:
            for key, old, new in _differences(stored, json_value(config)):
                raise ToolkitError(
                    f"run {path} was started with {key} = {old}, not {new}; give the same {key}, or choose another --run"
                )
        run = cls(path, stored)
        if config is not None:
            try:
                claim(path, CLAIMED)
            except OSError as error:
                raise _unwritable(path, error) from None
            run._write_metrics(run.read_metrics())
        return run

    def end(self, failed: bool = False) -> None:
        """Let others write into the run. A start that failed before its first checkpoint leaves no folder that is then in the way."""
        if failed and self._made is not None and not self.checkpoints():
            give_up(self.path)
            shutil.rmtree(self.path, ignore_errors=True)
            for parent in self.path.parents:
                if not parent.is_relative_to(self._made) or any(parent.iterdir()):
                    break
                parent.rmdir()
        give_up(self.path)

    @contextmanager
    def at_work(self) -> "Iterator[Run]":
        """While this process works on the run, which then ends; with an error, as one that failed. Ctrl-C leaves it to --resume."""
        try:
            yield self
        except Exception:
            self.end(failed=True)
            raise
        finally:
            self.end()

    def commit(self) -> str:
        """Commit of the toolkit that started it; "unknown" where that was no checkout."""
        file, mend = self.path / "git.json", "delete it"
        found = parsed(content_of(file, mend), str(file), mend) if file.is_file() else None
        return "unknown" if found is None else require(found, {"commit": str}, str(file), mend)["commit"]

    def append_metrics(self, record: dict[str, Any]) -> None:
        """Add one line to metrics.jsonl, on disk when this returns. NaN and infinities are written as null."""
        line = json.dumps(_finite(json_value(record)), allow_nan=False) + "\n"
        try:
            with open(self.path / "metrics.jsonl", "ab") as file:
                file.write(line.encode())
                file.flush()
                os.fsync(file.fileno())
        except OSError as error:
            raise _unwritable(self.path, error) from None

    def read_metrics(self) -> list[dict[str, Any]]:
        """All whole records of metrics.jsonl, oldest first.

        Raises:
            ToolkitError: a line other than a torn last one is not a JSON object.
        """
        file = self.path / "metrics.jsonl"
        if not file.exists():
            return []
        *whole, _torn = content_of(file, "check the path").split(b"\n")
        records = []
        for number, line in enumerate(whole, start=1):
            records.append(parsed_object(line, f"{file} line {number}", "delete that line"))
        return records

    def truncate_metrics(self, count: int) -> None:
        """Keep the first `count` records, so that a resumed run writes the same file as an unbroken one.

        Args:
            count: how many records had been written when the checkpoint was saved.

        Raises:
            ToolkitError: the file holds fewer records than that.
        """
        records = self.read_metrics()
        if len(records) < count:
            raise ToolkitError(
                f"{self.path / 'metrics.jsonl'} holds {len(records)} records but the checkpoint was saved after {count}; "
                "resume from an earlier checkpoint, or start again under another --run"
            )
        self._write_metrics(records[:count])

    def truncate_metrics_by(self, key: str, counts: Mapping[str, int]) -> None:
        """Keep of the records with each value of ``key`` the first `counts` of that value, and none of others.

        Raises:
            ToolkitError: the file holds fewer records of one than that.
        """
        left, kept = dict(counts), []
        for record in self.read_metrics():
            value = str(record.get(key))
            if left.get(value, 0) > 0:
                left[value] -= 1
                kept.append(record)
        missing = [value for value, count in left.items() if count > 0]
        if missing:
            raise ToolkitError(
                f"{self.path / 'metrics.jsonl'} holds {counts[missing[0]] - left[missing[0]]} records of {missing[0]!r} but the checkpoint "
                f"was saved after {counts[missing[0]]}; resume from an earlier checkpoint, or start again under another --run"
            )
        self._write_metrics(kept)

    def save_checkpoint(self, name: str, tensors: dict[str, np.ndarray], state: dict[str, Any]) -> Path:
        """Save tensors and state as one file, whole or not at all, whenever the process is killed.

        Args:
            name: letters, digits, ".", "_" and "-"; an existing checkpoint of this name is replaced.
            tensors: numeric arrays of any shape.
            state: JSON values; NaN survives. See `generator_state` for random generators.

        Returns:
            checkpoints/<name>.safetensors

        Raises:
            ToolkitError: a bad name, state that is not JSON, or the folder cannot be written.
        """
        file = self._checkpoint_file(name)
        arrays = {key: np.asarray(tensor, order="C") for key, tensor in tensors.items()}
        header = {"state": _json_bytes(state, "checkpoint state").decode()}
        try:
            file.parent.mkdir(exist_ok=True)
            write_atomically(file, safetensors_bytes(arrays, metadata=header))
        except OSError as error:
            raise _unwritable(file, error) from None
        return file

    def load_checkpoint(self, name: str) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """The tensors and the state that `save_checkpoint` was given.

        Raises:
            ToolkitError: no such checkpoint, a truncated file, or one that this toolkit did not write.
        """
        file = self._checkpoint_file(name)
        if not file.is_file():
            known = ", ".join(self.checkpoints()) or "none"
            raise ToolkitError(f"checkpoint {file} does not exist; this run has: {known}")
        mend = "delete it and resume from another checkpoint"
        state, tensors = read_tensors(file, "checkpoint", "state", mend)
        return tensors, state

    def checkpoints(self) -> list[str]:
        """Names of the checkpoints, sorted."""
        return sorted(file.name.removesuffix(".safetensors") for file in self.path.glob("checkpoints/[!.]*.safetensors"))

    def write_json(self, name: str, content: dict[str, Any]) -> None:
        """Write <name>.json. NaN and infinities are written as null."""
        self._write(f"{name}.json", _json_bytes(_finite(json_value(content)), name))

    def write_summary(self, text: str) -> None:
        """Write summary.md [Markdown]."""
        self._write("summary.md", text.encode())

    def _write(self, name: str, data: bytes) -> None:
        try:
            write_atomically(self.path / name, data)
        except OSError as error:
            raise _unwritable(self.path, error) from None

    def _write_metrics(self, records: list[dict[str, Any]]) -> None:
        data = "".join(json.dumps(record) + "\n" for record in records).encode()
        file = self.path / "metrics.jsonl"
        if (file.read_bytes() if file.exists() else b"") != data:
            self._write(file.name, data)

    def _checkpoint_file(self, name: str) -> Path:
        if not re.fullmatch(r"\w[\w.-]*", name):
            raise ToolkitError(f"checkpoint name {name!r} is not a plain file name; use letters, digits, '.', '_' and '-'")
        return self.path / "checkpoints" / f"{name}.safetensors"


_COUNTS = {...: int}
_EVALUATION = {"episodes": int, "successes": int, "success_rate": float, "ci95": [float]}
_REPORT = {
    "targets": {...: {"native": _EVALUATION, "merged": _EVALUATION}}, "train_iterations": _COUNTS, "sim_epochs": _COUNTS,
    "check_episodes": _COUNTS, "routes": {...: [str]}, "totals": {"train_iterations": int, "sim_epochs": int, "check_episodes": int,
    "diverged": int}, "wall_s": float, "time": {"wall_s": float}, "kind": str, "metric": str, "step": str, "path": str, "task": str,
}
_TREE = {"metric": str, "kind": str, "nodes": [{"name": str, "kind": str, "alpha": [float]}],
         "edges": [{"from": str, "to": str, "length": float}]}
_EVENT = {"event": str, "path": str, "stage": str, "train_iterations": int, "sim_epochs": int, "check_episodes": int, "diverged": int}
_EVENTS = {"check": {"success": float}, "arrived": {"target": str}, "split": {"targets": str}}


def read_success(folder: Path) -> dict[str, Any]:
    """What a run's report says of success, routes and the cost of their paths, and perhaps no more; empty while there is none.

    Raises:
        ToolkitError: it is damaged.
    """
    file, mend = folder / "report.json", "finish the run again with --resume"
    if not file.is_file():
        return {}
    report = read_object(file, mend)
    shape = {"targets": {...: {"native": _EVALUATION | {"seed": int}}}, "routes": {...: [str]}, "train_iterations": _COUNTS,
             "sim_epochs": _COUNTS}
    return require(report, {key: one for key, one in shape.items() if key in report}, str(file), mend)


def read_report(folder: Path, needs: Sequence[str] = tuple(_REPORT)) -> dict[str, Any] | None:
    """The report of a transfer's run folder; None while it has none.

    Args:
        folder: of the run.
        needs: what the caller looks at.

    Raises:
        ToolkitError: it is damaged, or lacks what those who read it need.
    """
    file, mend = folder / "report.json", "finish the run again with --resume"
    if not file.is_file():
        return None
    report = require(read_object(file, mend), {key: _REPORT[key] for key in needs}, str(file), mend)
    both = [evaluation for pair in report["targets"].values() for evaluation in (pair["native"], pair["merged"])]
    if not all(len(e["ci95"]) == 2 and 0 <= e["successes"] <= e["episodes"] > 0 for e in both):
        raise ToolkitError(f"{file} is damaged: an evaluation in it has no counts or no interval; {mend}")
    counts = [report[key] for key in ("train_iterations", "sim_epochs", "check_episodes") if key in needs]
    routes = report["routes"] if "routes" in needs else {}
    lost = [path for count in counts for path in routes if path not in count]
    if lost or not all(routes.values()):
        raise ToolkitError(f"{file} is damaged: path {(lost or ['without robots'])[0]!r} has no counts; {mend}")
    return report


def paths_to(routes: Mapping[str, Sequence[str]], target: str) -> list[str]:
    """The paths of a run that together lead from the source to a target, the last first; none: the run does not go there.

    Args:
        routes: path -> names of the robots at which it and those before it begin, and of the target if it has arrived there; see Ledger.
        target: its name.
    """
    path = next((path for path, names in routes.items() if names[-1] == target), None)
    if path is None:
        return []
    found, left = [path], list(routes[path][:-1])
    while len(left) > 1:
        arrived = left[-1] != "meta"  # a tree that asks has left from a target
        if not arrived:
            left.pop()
        before = [other for other, names in routes.items() if list(names) == left]
        before = [other for other in before if path.startswith(f"{other}.")] or before
        found += before
        path = before[0] if before else path
        if arrived:
            left.pop()
    return found


def read_audit(folder: Path) -> dict[str, Any] | None:
    """What the robots along a run's tree can do, as it was measured before the transfer; None: it was not.

    Raises:
        ToolkitError: it is damaged.
    """
    file, mend = folder / "audit.json", "remove the file, and finish the run again with --resume"
    if not file.is_file():
        return None
    edge = {"from": str, "to": str, "robots": [{"share": float, "grip_n": float}],
            "violations": [{"share": float, "quantity": str, "allowed": list}]}
    return require(read_object(file, mend), {"verdict": str, "edges": [edge]}, str(file), mend)


def read_untrained(folder: Path) -> dict[str, dict[str, Any]]:
    """Target -> ``successes`` of ``episodes`` of the source's expert there as it is; empty where that was not measured.

    Raises:
        ToolkitError: the file is damaged.
    """
    file, mend = folder / "untrained.json", "remove the file, and finish the run again with --resume"
    return require(read_object(file, mend) if file.is_file() else {}, {...: {"successes": int, "episodes": int}}, str(file), mend)


def read_tree(folder: Path) -> dict[str, Any]:
    """The evolution tree of a run folder.

    Raises:
        ToolkitError: it is missing or damaged.
    """
    file, mend = folder / "tree.json", "start the transfer again under another --run"
    if not file.exists():
        raise ToolkitError(f"{folder} has no tree.json yet; wait until its transfer has begun")
    try:
        tree = require(read_object(file, mend), _TREE, str(file), mend)
    except ToolkitError as error:
        raise ToolkitError(f"{file} is damaged ({error})") from None
    names = [node["name"] for node in tree["nodes"]]
    kinds = {node["kind"] for node in tree["nodes"]}
    sound = (
        len(set(names)) == len(names) and kinds <= {"source", "meta", "target"} and {"source", "target"} <= kinds
        and len({len(node["alpha"]) for node in tree["nodes"]}) == 1
        and all(-1e-6 <= value <= 1.0 + 1e-6 for node in tree["nodes"] for value in node["alpha"])
        and all(0.0 <= edge["length"] < 1e6 for edge in tree["edges"])
        and len({edge["to"] for edge in tree["edges"]}) == len(tree["edges"]) == len(names) - 1  # one way into each but the source
        and all(end in names for edge in tree["edges"] for end in (edge["from"], edge["to"]))
    )
    if not sound:
        raise ToolkitError(f"{file} is damaged: its nodes and edges make no tree; {mend}")
    return tree


def read_nodes(folder: Path) -> dict[str, Any]:
    """What tree.json says of its nodes, metric and kind, and perhaps no more; errors as of ``read_tree``."""
    file, mend = folder / "tree.json", "it is written when a transfer begins"
    return require(read_object(file, mend), {key: _TREE[key] for key in ("metric", "kind", "nodes")}, str(file), mend)


def transfer_records(run: Run) -> list[dict[str, Any]]:
    """The records of a transfer, each with what those who draw it need.

    Raises:
        ToolkitError: as of ``Run.read_metrics``, or a record lacks something.
    """
    records = run.read_metrics()
    for number, record in enumerate(records, start=1):
        where = f"{run.path / 'metrics.jsonl'} line {number}"
        require(record, _EVENT, where, "delete that line")
        require(record, _EVENTS.get(record["event"], {}), where, "delete that line")
    return records


def _finite(value: Any) -> Any:
    """The plain value with NaN and infinities as None, which strict JSON readers need."""
    if isinstance(value, dict):
        return {key: _finite(entry) for key, entry in value.items()}
    if isinstance(value, list):
        return [_finite(entry) for entry in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _json_bytes(value: Any, what: str) -> bytes:
    try:
        return (json.dumps(json_value(value), indent=2) + "\n").encode()
    except (TypeError, ValueError) as error:
        raise ToolkitError(f"{what} cannot be stored as JSON ({error}); use numbers, text, lists and dictionaries") from None


def _read_json_object(file: Path, mend: str) -> dict[str, Any]:
    if not file.exists():
        raise ToolkitError(f"{file.parent} holds no {file.name}, so it is not a run folder; {mend}")
    return read_object(file, mend)


def _differences(old: Any, new: Any, key: str = "") -> Iterator[tuple[str, Any, Any]]:
    """(dotted key, old value, new value) wherever two JSON values differ."""
    if isinstance(old, dict) and isinstance(new, dict):
        for name in [*old, *(name for name in new if name not in old)]:
            yield from _differences(old.get(name, ABSENT), new.get(name, ABSENT), f"{key}.{name}" if key else name)
    elif old != new and json.dumps(old) != json.dumps(new):  # the second holds for NaN, which differs from itself
        yield key, old, new


def _unwritable(path: Path, error: OSError) -> ToolkitError:
    return ToolkitError(f"{path} cannot be written ({error.strerror}); free space or permissions there, or choose another --run")

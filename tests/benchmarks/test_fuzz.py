"""Readers: whatever a file holds, the one reader of its format reads it or refuses it by one sentence.

`meta-evolve bench fuzz` damages two thousand files of each format in processes of their own; here a few dozen, and those that
once ended in something else.
"""

import hashlib
import io
import json
import struct
import subprocess
import sys
import zipfile
from collections import Counter
from pathlib import Path

import numpy as np
import pytest

from tasks.npz import ArrayError, Arrays
from toolkit import cli
from toolkit.benchmarks.fuzz import FORMATS, fuzz, outcome_of
from toolkit.bundle.onnx_graph import METADATA_KEY, onnx_from_bytes
from toolkit.bundle.reading import SHIPPED, load_bundle
from toolkit.cli import main
from toolkit.errors import ToolkitError

BUNDLE = SHIPPED / "kinova3.zip"
FILES = 40


@pytest.mark.parametrize("name", FORMATS)
def test_damaged_files_are_read_or_refused(name, tmp_path):
    sample = FORMATS[name](tmp_path, BUNDLE)
    sample.read(sample.file)
    sound, found = sample.file.read_bytes(), Counter()
    for number in range(FILES):
        outcome, said, seconds = outcome_of(sample, sound, np.random.default_rng((7, number)))
        if seconds > 10.0:  # what hangs hangs again; what waited for the disk does not, as rerun's 290 MB of names for its first back trace
            outcome, said, seconds = outcome_of(sample, sound, np.random.default_rng((7, number)))
        assert outcome in ("refused", "read"), f"file {number} of seed 7: {outcome}: {said}"
        assert seconds < 10.0 and (outcome == "read" or 20 < len(said) < 1000), f"file {number} of seed 7: {said}"
        found[outcome] += 1
    assert found["refused"] > FILES / 4, f"{name}: the damage harms nothing: {found}"


@pytest.mark.slow
def test_the_fuzzer_finds_readers_that_break(tmp_path, monkeypatch):
    """One that raises something else, and one that ends its process, are told from each other and from the next file."""
    from toolkit.benchmarks import fuzz as module

    code = (
        "import os\nfrom toolkit.benchmarks import fuzz\nfrom toolkit.errors import ToolkitError\n"
        "def read(file):\n"
        "    data = file.read_bytes()\n"
        "    if data == b'sound': return\n"
        "    if len(data) % 3 == 0: os._exit(7)\n"
        "    if len(data) % 3 == 1: raise KeyError('x')\n"
        "    raise ToolkitError('no')\n"
        "def make(folder, bundle):\n"
        "    (folder / 'f').write_bytes(b'sound')\n"
        "    return fuzz.Sample(folder / 'f', (fuzz.rot,), read)\n"
        "fuzz.FORMATS['odd'] = make\n"
        "def work(*arguments): fuzz.work(*arguments)\n"
    )
    (tmp_path / "oddfuzz.py").write_text(code)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(module, "__name__", "oddfuzz")
    (tally,) = fuzz(("odd",), 12, 0, BUNDLE)
    assert tally.files == 12 == tally.refused + tally.read + tally.broken.total()
    assert tally.broken["died"] and tally.broken["KeyError"] and tally.refused, tally
    assert tally.first.startswith("file ")


@pytest.mark.slow
def test_the_figures_are_printed_by_a_command(capsys):
    main(["bench", "fuzz", "--formats", "report.json", "golden.npz", "--files", "15", "--json"])
    found = json.loads(capsys.readouterr().out)["formats"]
    assert [(row["format"], row["files"], row["broken"]) for row in found] == [("report.json", 15, {}), ("golden.npz", 15, {})]


# -- bundles that once ended in a traceback ------------------------------------------------------------------


def bundle_files():
    with zipfile.ZipFile(BUNDLE) as archive:
        return {Path(name).name: archive.read(name) for name in archive.namelist()}


def packed(path, files, rehash=True):
    if rehash:
        manifest = json.loads(files["manifest.json"])
        manifest["sha256"] = {key: hashlib.sha256(files[key]).hexdigest() for key in manifest["sha256"]}
        files = files | {"manifest.json": json.dumps(manifest).encode()}
    with zipfile.ZipFile(path, "w") as archive:
        for name, content in files.items():
            archive.writestr(name, content)
    return path


def golden_with(header, version=1):
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        for name in np.load(io.BytesIO(bundle_files()["golden.npz"])).files:
            length = struct.pack("<H" if version == 1 else "<I", len(header))
            archive.writestr(f"{name}.npy", b"\x93NUMPY" + bytes([version, 0]) + length + header.encode() + bytes(64))
    return buffer.getvalue()


def shaped(shape):
    return f"{{'descr': '<f8', 'fortran_order': False, 'shape': ({shape},)}}\n"


HEADERS = {
    "1e13": shaped(10**13), "1e30": shaped(10**30), "negative": shaped(-1), "unclosed": "{'descr': (((((\n", "empty": "", "text": "x" * 500,
    "objects": "{'descr': '|O', 'fortran_order': False, 'shape': (1,)}", "code": "__import__('os').system('true')",
    "a list": "[1, 2]", "deep": "(" * 5000, "long": " " * 60_000, "many axes": shaped("1," * 100),
    "records": "{'descr': [('a', '<f8'), ('b', '|O')], 'fortran_order': False, 'shape': (1,)}", "half": shaped("1.5"),
    "no comma": "{'descr': '<f8' 'fortran_order': False}", "null": "\0" * 30, "a key twice": shaped(1).replace("}", ", 'shape': (2,)}"),
}


@pytest.mark.parametrize("name", HEADERS)
def test_arrays_with_odd_headers(tmp_path, name):
    path = packed(tmp_path / "b.zip", bundle_files() | {"golden.npz": golden_with(HEADERS[name])})
    with pytest.raises(ToolkitError, match="golden.npz is damaged"):
        load_bundle(path)


@pytest.mark.parametrize("version", [2, 3, 9])
def test_arrays_of_other_versions(version):
    with Arrays(golden_with(shaped(3), version)) as arrays, pytest.raises(ArrayError):
        arrays.read("actions", (4,), ("float64",))


@pytest.mark.parametrize("method", [zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA, zipfile.ZIP_DEFLATED])
@pytest.mark.parametrize("harm", ["content", "flag", "method", "size"])
def test_archives_that_are_packed_otherwise_encrypted_or_lie(tmp_path, method, harm):
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", method) as archive:
        for name, content in bundle_files().items():
            archive.writestr(name, content)
    data = bytearray(buffer.getvalue())
    central, local = data.find(b"PK\x01\x02"), data.find(b"PK\x03\x04")
    if harm == "content":
        data[local + 200 : local + 400] = b"\xa5" * 200
    else:
        offset, value = {"flag": (0, 1), "method": (2, 99), "size": (10, 255)}[harm]
        data[central + 8 + offset] = data[local + 6 + offset] = value
    path = tmp_path / "b.zip"
    path.write_bytes(bytes(data))
    with pytest.raises(ToolkitError):
        load_bundle(path)


@pytest.mark.parametrize("number", ["1" + "0" * 400, "9" * 5000, "1e999", "NaN", "-Infinity", "true", '"20"', "[]", "{}"])
def test_a_rate_that_is_no_finite_number(tmp_path, number):
    files = bundle_files()
    text = files["manifest.json"].decode()
    start = text.index('"policy_hz": ') + len('"policy_hz": ')
    files["manifest.json"] = (text[:start] + number + text[text.index(",", start) :]).encode()
    with pytest.raises(ToolkitError, match="policy_hz|not JSON"):
        load_bundle(packed(tmp_path / "b.zip", files, rehash=False))


@pytest.mark.parametrize("label", ["[1, 2]", "3", "null", '"x"', "{", "[" * 100_000, "\udcff"])
def test_a_graph_whose_metadata_is_no_object(label):
    import onnx

    graph = onnx.load_from_string(bundle_files()["policy.onnx"])
    for entry in graph.metadata_props:
        if entry.key == METADATA_KEY:
            entry.value = label if label != "\udcff" else "MARK"
    content = graph.SerializeToString().replace(b"MARK", b"\xff\xfe\xff\xfe")
    with pytest.raises(ToolkitError, match="metadata|damaged"):
        onnx_from_bytes(content, "policy.onnx")


def test_a_graph_that_asks_for_more_memory_than_there_is():
    import onnx

    graph = onnx.load_from_string(bundle_files()["policy.onnx"])
    graph.graph.input[0].type.tensor_type.shape.dim[0].dim_value = 2**40
    with pytest.raises(ToolkitError):
        onnx_from_bytes(graph.SerializeToString(), "policy.onnx")


@pytest.mark.parametrize("entry", ["run", "object"])
def test_a_number_without_end_deep_in_the_manifest(tmp_path, entry):
    files = bundle_files()
    manifest = json.loads(files["manifest.json"])
    holder = manifest["run"] if entry == "run" else manifest["task"]["object"]
    holder["deep"] = [{"x": float("inf")}]
    files["manifest.json"] = json.dumps(manifest).encode()
    with pytest.raises(ToolkitError, match="not finite"):
        load_bundle(packed(tmp_path / "b.zip", files, rehash=False))


@pytest.mark.slow
def test_bundles_that_ended_verify_in_a_traceback(tmp_path):
    """Made anew as they were; the whole command, status and sentence included."""
    files = bundle_files()
    raw = bytearray(files["golden.npz"])
    raw[raw.find(b"PK\x01\x02") + 8] |= 1
    raw[raw.find(b"PK\x03\x04") + 6] |= 1
    cases = {name: {"golden.npz": golden_with(HEADERS[name])} for name in ("1e13", "1e30", "unclosed")}
    cases["encrypted"] = {"golden.npz": bytes(raw)}
    for name, change in cases.items():
        path = packed(tmp_path / f"{name}.zip", files | change)
        done = subprocess.run([sys.executable, "-m", "toolkit.cli", "verify", str(path)], capture_output=True, text=True,
                              cwd=Path(cli.__file__).parents[2])
        assert done.returncode == 2 and "Traceback" not in done.stderr and len(done.stderr.splitlines()) == 1, (name, done.stderr)

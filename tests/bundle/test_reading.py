"""What is read as a bundle: shipped ones, and those of earlier releases; whatever else, one sentence says what is wrong with it."""

import hashlib
import json
import subprocess
import sys
import zipfile
from dataclasses import replace

import numpy as np
import onnx
import pytest

from tasks.pick import OBSERVATION_SIZE
from toolkit.bundle.manifest import FORMAT_VERSION
from toolkit.bundle.reading import FILES, HASHED, MANIFEST, check_bundle, find_bundle, load_bundle
from toolkit.errors import ToolkitError


@pytest.fixture
def copy(unpacked):
    """A bundle of one's own, to break."""
    return unpacked("kinova3")


@pytest.fixture(scope="module")
def shipped():
    """File -> content of a shipped bundle."""
    with zipfile.ZipFile(find_bundle("kinova3")) as archive:
        return {name: archive.read(f"kinova3/{name}") for name in FILES}


def edit(folder, change):
    manifest = json.loads((folder / MANIFEST).read_text())
    change(manifest)
    (folder / MANIFEST).write_text(json.dumps(manifest))


def test_nothing_there(tmp_path):
    with pytest.raises(ToolkitError, match="nowhere does not exist; .*shipped.*; or write one: meta-evolve export"):
        load_bundle(tmp_path / "nowhere")


@pytest.mark.parametrize("data", [b"", b"PK\x03\x04 rest", b"hello"])
def test_a_file_that_is_no_zip(tmp_path, data):
    (tmp_path / "b.zip").write_bytes(data)
    with pytest.raises(ToolkitError, match="is no bundle"):
        load_bundle(tmp_path / "b.zip")


EARLIER = ("policy.onnx", "policy.safetensors", "golden.npz", "robot.xml", "README.md")


@pytest.mark.parametrize("version, lacks, kept", [
    (2, ("simulation", "licence", "holds", "braking", "borne_delay_steps"), EARLIER),
    (5, ("borne_delay_steps",), HASHED),
    (4, ("braking", "borne_delay_steps"), HASHED),
    (3, ("holds", "braking", "borne_delay_steps"),
     (*EARLIER, "policy_flat.onnx", "actor.safetensors", "manifest.schema.json", "config.json")),
])
def test_a_bundle_of_an_earlier_format_version_still_loads(unpacked, version, lacks, kept):
    """As earlier releases wrote it: fewer entries, and fewer files beside the manifest."""
    folder = unpacked("kinova3")
    manifest = json.loads((folder / "manifest.json").read_text())
    label = {key: value for key, value in manifest.items() if key not in ("sha256", *lacks)} | {"format_version": version}
    model = onnx.load(folder / "policy.onnx")
    onnx.helper.set_model_props(model, {"meta_evolve": json.dumps(label)})
    (folder / "policy.onnx").write_bytes(model.SerializeToString())
    for file in set(FILES) - {*kept, "manifest.json"}:
        (folder / file).unlink(missing_ok=True)
    old = label | {"sha256": {file: hashlib.sha256((folder / file).read_bytes()).hexdigest() for file in kept}}
    (folder / "manifest.json").write_text(json.dumps(old))
    bundle = load_bundle(folder)
    assert all(getattr(bundle.manifest, key) is None for key in lacks)
    assert bundle.manifest.to_json() == old and check_bundle(bundle)["golden_ok"]
    (folder / "manifest.json").write_text(json.dumps(old | {"borne_delay_steps": 1}))
    with pytest.raises(ToolkitError, match=f"borne_delay_steps does not fit format version {version}.*export the bundle again"):
        load_bundle(folder)


def test_loading_needs_neither_torch_nor_robosuite():
    code = (
        "import sys; from toolkit.bundle.reading import load_bundle, check_bundle\n"
        "assert check_bundle(load_bundle(sys.argv[1]))['golden_ok']\n"
        "heavy = {'torch', 'robosuite', 'onnx', 'rerun', 'pinocchio', 'scipy', 'numba'} & set(sys.modules)\n"
        "assert not heavy, heavy"
    )
    done = subprocess.run([sys.executable, "-c", code, "kinova3"], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


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


def test_a_manifest_of_another_policy_is_refused_by_the_entry_that_differs(copy):
    edit(copy, lambda m: m["observation"].reverse())
    with pytest.raises(ToolkitError, match="observation 0 is 'goal_from_object' of size 3 in the manifest, 'finger/FFJ3' of size 1"):
        load_bundle(copy)


def test_a_manifest_that_was_edited_by_hand_is_refused(copy):
    edit(copy, lambda m: m["joints"][2].update(speed=0.5))
    with pytest.raises(ToolkitError, match="differ in 'joints'"):
        load_bundle(copy)


def zipped(path, entries):
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in entries:
            archive.writestr(name, content)
    return path


def test_a_zip_writes_nothing_and_takes_nothing_from_outside(shipped, tmp_path):
    files = list(shipped.items())
    inside = tmp_path / "a" / "b"
    inside.mkdir(parents=True)
    traversal = zipped(inside / "b.zip", [(f"../../{name}", content) for name, content in files] + [("/tmp/evil", b"no")])
    with pytest.raises(ToolkitError, match="has no manifest.json"):
        load_bundle(traversal)
    assert [p.name for p in tmp_path.rglob("*") if p.is_file()] == ["b.zip"]
    assert load_bundle(zipped(inside / "top.zip", files)).manifest == load_bundle("kinova3").manifest, "files may also lie at the top"


def test_a_zip_with_a_file_twice_is_refused(shipped, tmp_path):
    with pytest.raises(ToolkitError, match="holds manifest.json twice"):
        load_bundle(zipped(tmp_path / "b.zip", [*shipped.items(), ("x/manifest.json", b"{}")]))


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


def test_the_check_notices_narrower_limits():
    bundle = load_bundle("kinova3")
    first = replace(bundle.manifest.action[0], high=0.5)
    narrow = replace(bundle.manifest, action=(first, *bundle.manifest.action[1:]))
    assert not check_bundle(replace(bundle, manifest=narrow))["limits_ok"]


def test_an_observation_of_the_wrong_size():
    with pytest.raises(ToolkitError, match=rf"has shape \(3,\); this bundle takes \({OBSERVATION_SIZE},\)"):
        load_bundle("kinova3")(np.zeros(3))

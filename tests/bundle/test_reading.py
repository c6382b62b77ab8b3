"""Bundles that come from elsewhere: none at all, no zip, and those of earlier releases."""

import hashlib
import json

import onnx
import pytest

from toolkit.bundle.reading import FILES, HASHED, check_bundle, load_bundle
from toolkit.errors import ToolkitError


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

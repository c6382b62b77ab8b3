"""A signed bundle: what its key signed passes, and nothing else does."""

import hashlib
import json
import shutil
import subprocess

import onnx
import pytest
from onnx import numpy_helper
from safetensors.numpy import load_file, save_file

from toolkit.bundle import signing
from toolkit.bundle.reading import MANIFEST, SIGNATURE, check_bundle, find_bundle, load_bundle
from toolkit.bundle.signing import NAMESPACE, check_signature, sign
from toolkit.cli import main
from toolkit.cli.judging import check_signer
from toolkit.errors import ToolkitError

pytestmark = pytest.mark.skipif(shutil.which(signing.TOOL) is None, reason="OpenSSH is not installed")


@pytest.fixture(scope="module")
def keys(tmp_path_factory):
    folder = tmp_path_factory.mktemp("keys")
    for name in ("mine", "other"):
        subprocess.run(["ssh-keygen", "-q", "-t", "ed25519", "-N", "", "-C", name, "-f", str(folder / name)], check=True)
    return folder


@pytest.fixture
def folder(tmp_path):
    """A shipped bundle as a folder of one's own."""
    shutil.unpack_archive(find_bundle("kinova3"), tmp_path)
    return tmp_path / "kinova3"


def test_what_was_signed_passes_and_nothing_else(keys):
    signature = sign(b"manifest", keys / "mine")
    check_signature(b"manifest", signature, keys / "mine.pub", "it")
    for content, found, key, sentence in (
        (b"manifesT", signature, "mine.pub", "it is not as the holder of .*mine.pub signed it .Could not verify signature"),
        (b"manifest", signature, "other.pub", "is not as the holder of .*other.pub signed it"),
        (b"manifest", None, "mine.pub", "it is not signed"),
        (b"manifest", b"nonsense", "mine.pub", "is not as the holder"),
        (b"manifest", signature, "mine", "is no public key"),
        (b"manifest", signature, "nobody.pub", "is no public key"),
    ):
        with pytest.raises(ToolkitError, match=sentence):
            check_signature(content, found, keys / key, "it")


def test_a_signature_for_something_else_is_none(keys, tmp_path):
    (tmp_path / "m").write_bytes(b"manifest")
    subprocess.run(["ssh-keygen", "-q", "-Y", "sign", "-f", str(keys / "mine"), "-n", "git", str(tmp_path / "m")], check=True)
    with pytest.raises(ToolkitError, match="is not as the holder"):
        check_signature(b"manifest", (tmp_path / "m.sig").read_bytes(), keys / "mine.pub", "it")


def test_keys_that_cannot_sign_are_named(keys, tmp_path, monkeypatch):
    with pytest.raises(ToolkitError, match="absent is no key; give an OpenSSH private key"):
        sign(b"", tmp_path / "absent")
    (tmp_path / "text").write_text("no key")
    with pytest.raises(ToolkitError, match="text does not sign"):
        sign(b"", tmp_path / "text")
    monkeypatch.setattr(signing, "TOOL", "no-such-tool-of-openssh")
    with pytest.raises(ToolkitError, match="which is not installed"):
        sign(b"", keys / "mine")


def test_anyone_can_sign_a_folder_with_openssh_alone(keys, folder, capsys):
    """As docs/deploy.md says; the command then tells whose it is, and a changed manifest is refused."""
    subprocess.run(["ssh-keygen", "-q", "-Y", "sign", "-f", str(keys / "mine"), "-n", NAMESPACE, str(folder / MANIFEST)], check=True)
    assert (folder / SIGNATURE).is_file()
    check_signer(load_bundle(folder), keys / "mine.pub")
    with pytest.raises(SystemExit) as stop:
        main(["deploy", str(folder), "--signed-by", str(keys / "other.pub"), "--episodes", "1"])
    assert stop.value.code == 2 and "is not as the holder of" in capsys.readouterr().err
    (folder / MANIFEST).write_bytes((folder / MANIFEST).read_bytes() + b"\n")
    with pytest.raises(ToolkitError, match="is not as the holder of"):
        check_signer(load_bundle(folder), keys / "mine.pub")


# -- the numbers of every file that holds the policy -------------------------------------------------------------------


def rehash(folder, name):
    """Forge the manifest's hash of a file, as who puts another policy in its place would."""
    manifest = json.loads((folder / MANIFEST).read_text())
    manifest["sha256"][name] = hashlib.sha256((folder / name).read_bytes()).hexdigest()
    (folder / MANIFEST).write_text(json.dumps(manifest))


def test_all_three_files_hold_one_policy(folder):
    found = check_bundle(load_bundle(folder))
    assert found["golden_ok"] and max(found[f"{name}_max_abs_error"] for name in ("onnx", "flat", "actor")) < 1e-5


def test_another_policy_in_actor_safetensors_is_seen_though_its_hash_is_right(folder):
    tensors = load_file(folder / "actor.safetensors")
    tensors["layer_0.bias"] = tensors["layer_0.bias"] + 1e-3
    save_file(tensors, folder / "actor.safetensors")
    rehash(folder, "actor.safetensors")
    found = check_bundle(load_bundle(folder))
    assert not found["golden_ok"] and found["actor_max_abs_error"] > found["tolerance"] > found["flat_max_abs_error"]
    del tensors["layer_1.bias"]
    save_file(tensors, folder / "actor.safetensors")
    rehash(folder, "actor.safetensors")
    with pytest.raises(ToolkitError, match="actor.safetensors holds no policy .*layer_1.bias"):
        check_bundle(load_bundle(folder))


def test_another_policy_in_the_flat_graph_is_seen_though_its_hash_is_right(folder):
    model = onnx.load(folder / "policy_flat.onnx")
    bias = next(one for one in model.graph.initializer if one.name == "layer_0.bias")
    bias.CopyFrom(numpy_helper.from_array(numpy_helper.to_array(bias) + 1e-3, bias.name))
    onnx.save(model, folder / "policy_flat.onnx")
    rehash(folder, "policy_flat.onnx")
    found = check_bundle(load_bundle(folder))
    assert not found["golden_ok"] and found["flat_max_abs_error"] > found["tolerance"] > found["actor_max_abs_error"]
    shutil.copy(folder / "policy.onnx", folder / "policy_flat.onnx")
    rehash(folder, "policy_flat.onnx")
    with pytest.raises(ToolkitError, match="policy_flat.onnx does not play"):
        check_bundle(load_bundle(folder))

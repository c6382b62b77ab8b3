"""What is exported is what was trained: ONNX against numpy, and one clear sentence for every bad file."""

import json
import subprocess
import sys

import numpy as np
import onnx
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from toolkit.bundle.onnx_graph import ActionMap, export_onnx, load_onnx, onnx_max_abs_error
from toolkit.errors import ToolkitError
from toolkit.learning.exploration import Directions, Explored, leading_features
from toolkit.learning.policy import GaussianPolicy

RECORD = {"finger_angles": 24, "grasp_position": 3, "grasp_rotation": 6, "object_position": 3, "opening": 2}
METADATA = {"rate_hz": 20, "units": {"finger_angles": "rad"}, "robot": "näme"}


def make_policy(seed=0):
    """38 observations of about 1, each resolved to 0.05 to 1 of its unit, and 28 actions that reach the clip."""
    rng = np.random.default_rng(seed)
    policy = GaussianPolicy([f"obs {i}" for i in range(38)], [f"act {i}" for i in range(28)], rng)
    policy.set_parameters(0.3 * rng.standard_normal(len(policy.parameters)))
    policy.set_normalisation(rng.standard_normal(38), rng.uniform(0.05, 1.0, 38))
    return policy


def make_map(seed=0):
    rng = np.random.default_rng(seed)
    return ActionMap(0.4 * rng.standard_normal((7, 28)), 0.1 * rng.standard_normal(7))


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    path = tmp_path_factory.mktemp("export") / "policy.onnx"
    export_onnx(make_policy(), path, make_map(), RECORD, METADATA)
    return path


def split(observation):
    return dict(zip(RECORD, np.split(observation, np.cumsum(list(RECORD.values()))[:-1]), strict=True))


def test_onnx_agrees_with_numpy(exported):
    observations = np.random.default_rng(1).standard_normal((500, 38))
    error = onnx_max_abs_error(make_policy(), exported, observations, make_map())
    assert error <= 1e-5, f"ONNX and numpy differ by {error:.1e}"
    actions = np.array([load_onnx(exported)(split(observation)) for observation in observations[:50]])
    assert 0.05 < (np.abs(actions) == 1.0).mean() < 0.95, "the test should see both sides of the clip"


def test_what_was_searched_is_part_of_the_graph(tmp_path):
    """Nothing besides the graph knows of it: the exported policy acts as the unmoved one does on what lies by the offset nearer, and
    responds by so much more."""
    rng, policy = np.random.default_rng(3), make_policy()
    observations = rng.standard_normal((50, 38))
    explored = Explored(np.ones(38), np.ones(len(policy.action_names)))
    directions = Directions(explored, leading_features(policy, observations, 3))
    step = rng.normal(0.0, 0.02, len(directions.deviation))
    moved = directions.moved(policy, step)
    export_onnx(moved, tmp_path / "policy.onnx", make_map(), RECORD, METADATA)
    assert onnx_max_abs_error(moved, tmp_path / "policy.onnx", observations, make_map()) <= 1e-5
    graph, unmoved = load_onnx(tmp_path / "policy.onnx"), make_map()
    responses = step[38:].reshape(-1, 3) @ directions.features
    for observation in observations:
        seen = observation - step[:38]
        units = np.append(policy.hidden_layer(seen[None])[0], 1.0)
        np.testing.assert_allclose(graph.act(observation), unmoved(policy.mean(seen) + responses @ units), atol=1e-4)


def test_a_vector_acts_as_its_record_does(exported):
    """The vector's memory is bound to the session: neither later calls nor another session may change what came out."""
    one, other = load_onnx(exported), load_onnx(exported)
    observations = np.random.default_rng(2).standard_normal((50, 38))
    found = [(one.act(row), other.act(-row)) for row in observations]
    for row, (action, mirrored) in zip(observations, found, strict=True):
        assert action.tolist() == one(split(row)).tolist() and mirrored.tolist() == one(split(-row)).tolist()
    assert np.isnan(one.act(np.full(38, np.nan))).all() and one.act(observations[0]).tolist() == found[0][0].tolist()


def test_the_comparison_would_notice_another_policy(exported):
    observations = np.random.default_rng(1).standard_normal((20, 38))
    assert onnx_max_abs_error(make_policy(seed=1), exported, observations, make_map()) > 0.1


@settings(max_examples=100, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), magnitude=st.sampled_from([0.0, 1e-6, 1.0, 1e6, 1e38]))
def test_the_action_stays_within_bounds(exported, seed, magnitude):
    loaded = load_onnx(exported)
    action = loaded(split(magnitude * np.random.default_rng(seed).uniform(-1, 1, 38)))
    assert action.shape == (7,) and action.dtype == np.float32 and np.abs(action).max() <= 1.0


@pytest.mark.parametrize("entry", list(RECORD))
def test_nan_is_never_turned_into_a_command(exported, entry):
    record = split(np.zeros(38))
    record[entry][-1] = np.nan
    assert np.isnan(load_onnx(exported)(record)).all()


def test_names_sizes_and_metadata_travel_along(exported):
    loaded = load_onnx(exported)
    assert loaded.record == RECORD and list(loaded.record) == list(RECORD) and loaded.n_out == 7
    assert loaded.metadata == METADATA


def test_same_policy_same_bytes(exported, tmp_path):
    export_onnx(make_policy(), tmp_path / "again.onnx", make_map(), RECORD, METADATA)
    assert (tmp_path / "again.onnx").read_bytes() == exported.read_bytes()
    assert [file.name for file in tmp_path.iterdir()] == ["again.onnx"], "no temporary file is left"


def test_the_graph_is_plain_onnx(exported):
    model = onnx.load(exported)
    onnx.checker.check_model(model, full_check=True)
    assert {opset.domain for opset in model.opset_import} == {""}
    assert [entry.name for entry in model.graph.input] == list(RECORD)


def test_loading_needs_neither_torch_nor_onnx(exported):
    program = (
        "import sys; sys.modules.update(torch=None, onnx=None, robosuite=None);"
        "from toolkit.bundle.onnx_graph import load_onnx; print(load_onnx(sys.argv[1]).n_out)"
    )
    done = subprocess.run([sys.executable, "-c", program, str(exported)], capture_output=True, text=True)
    assert done.stdout == "7\n", done.stderr


def test_a_record_that_does_not_fit_is_refused(exported):
    loaded, record = load_onnx(exported), split(np.zeros(38))
    for bad, sentence in (
        ({name: record[name] for name in list(RECORD)[1:]}, "lacks or adds \\['finger_angles'\\]"),
        (record | {"ghost": np.zeros(1)}, "ghost"),
        (record | {"opening": np.zeros(3)}, "'opening' has shape \\(3,\\)"),
        (record | {"opening": np.zeros((1, 2))}, "'opening' has shape"),
    ):
        with pytest.raises(ToolkitError, match=sentence):
            loaded(bad)


def test_an_export_that_does_not_fit_is_refused(tmp_path, exported):
    policy, action_map = make_policy(), make_map()
    narrow = ActionMap(np.zeros((7, 3)), np.zeros(7))
    for call, sentence in (
        (lambda: export_onnx(policy, tmp_path / "x", action_map, {"a": 37}), "this policy sees 38"),
        (lambda: export_onnx(policy, tmp_path / "x", action_map, {"action": 38}), "cannot name an input"),
        (lambda: export_onnx(policy, tmp_path / "x", narrow, RECORD), "takes 3 action entries"),
        (lambda: export_onnx(policy, tmp_path / "x", action_map, RECORD, {"a": np.zeros(1)}), "not JSON"),
        (lambda: export_onnx(policy, tmp_path / "no" / "x", action_map, RECORD), "cannot be written"),
        (lambda: ActionMap(np.zeros((7, 3)), np.zeros(3)), "matrix \\(7, 3\\) and offset \\(3,\\)"),
        (lambda: ActionMap(np.full((1, 1), np.nan), np.zeros(1)), "not finite"),
        (lambda: onnx_max_abs_error(policy, exported, np.zeros((0, 38)), action_map), "at least one row"),
    ):
        with pytest.raises(ToolkitError, match=sentence):
            call()
    assert not (tmp_path / "x").exists()


def without_metadata(path):
    model = onnx.load(path)
    del model.metadata_props[:]
    onnx.save(model, path)


def with_other_metadata(path):
    model = onnx.load(path)
    model.metadata_props[0].value = json.dumps(METADATA)[:-1]
    onnx.save(model, path)


@pytest.mark.parametrize(
    ("spoil", "sentence"),
    [
        (lambda path: path.unlink(), "does not exist"),
        (lambda path: path.write_bytes(b""), "damaged"),
        (lambda path: path.write_bytes(b"PK\x03\x04 something else" * 20), "damaged"),
        (lambda path: path.write_bytes(path.read_bytes()[:2000]), "damaged"),
        (without_metadata, "not an exported policy"),
        (with_other_metadata, "metadata of .* is not JSON"),
    ],
)
def test_a_broken_file_gets_one_clear_sentence(tmp_path, exported, spoil, sentence):
    path = tmp_path / "policy.onnx"
    path.write_bytes(exported.read_bytes())
    spoil(path)
    with pytest.raises(ToolkitError, match=sentence) as caught:
        load_onnx(path)
    assert str(path) in str(caught.value)

"""A trained policy as one ONNX graph: named observations in, the target robot's own action out.

The normalisation, the network and the map to robosuite's action are all inside the graph, so whoever runs it needs
onnxruntime, a dictionary of numbers and nothing else. `load_onnx` imports neither torch nor onnx.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import onnxruntime
from onnxruntime.capi import onnxruntime_pybind11_state as onnxruntime_errors

from toolkit.errors import ToolkitError
from toolkit.io.atomic import write_atomically
from toolkit.io.jsonfiles import parsed_object

if TYPE_CHECKING:  # these two pull in torch and onnx, which a machine that only loads does not have
    import onnx

    from toolkit.learning.policy import GaussianPolicy

OPSET, IR_VERSION = 17, 8
"""ONNX of mid-2022: old enough for every runtime still in use; nothing newer is needed."""

LARGEST_VECTOR = 10_000
"""Numbers of an input or of the action; a graph that asks for more is none of ours."""

METADATA_KEY = "meta_evolve"
"""Key of the model's metadata_props under which the caller's JSON travels."""
FLAT_INPUT, FLAT_OUTPUT = "obs", "actions"
"""Names in the graph with one batched input: those that rsl_rl's exporter gives, and with it Isaac Lab and mjlab."""


@dataclass(frozen=True, eq=False)
class ActionMap:
    """From the policy's action to robosuite's: `clip(matrix @ mean + offset, -1, 1)`.

    Raises:
        ToolkitError: shapes that do not fit together, or numbers that are not finite.
    """

    matrix: np.ndarray
    """(n_out, n_act) share of each policy entry in each robosuite entry."""
    offset: np.ndarray
    """(n_out,) robosuite's action at a policy mean of 0."""

    def __post_init__(self) -> None:
        for name in ("matrix", "offset"):
            array = np.array(getattr(self, name), dtype=np.float64)
            array.flags.writeable = False
            object.__setattr__(self, name, array)
        if self.matrix.ndim != 2 or self.offset.shape != self.matrix.shape[:1]:
            raise ToolkitError(
                f"ActionMap has matrix {self.matrix.shape} and offset {self.offset.shape}; "
                "give (n_out, n_act) and (n_out,)."
            )
        if not (np.isfinite(self.matrix).all() and np.isfinite(self.offset).all()):
            raise ToolkitError("ActionMap holds numbers that are not finite; give finite ones.")

    def __call__(self, mean: np.ndarray) -> np.ndarray:
        """(..., n_act) policy mean -> (..., n_out) robosuite action in [-1, 1]."""
        return np.clip(mean @ self.matrix.T + self.offset, -1.0, 1.0)


def export_onnx(
    policy: "GaussianPolicy",
    path: str | Path,
    action_map: ActionMap,
    record: Mapping[str, int],
    metadata: Mapping[str, Any] | None = None,
    words: Mapping[str, str] | None = None,
    flat: bool = False,
) -> None:
    """Write the policy's mean action as one ONNX file, whole or not at all. Same policy, same bytes.

    Inputs are one float32 vector per entry of the record, named as there; the output is `action`, float32 (n_out,),
    in robosuite's units. In between the graph computes in float64, as the policy was trained: only the rounding of
    input and output sets it apart. NaN in the record gives NaN in the action; it is never turned into a command.

    Args:
        policy: what to export.
        path: file to write.
        action_map: to the robot's own action.
        record: name -> size of each observation entry, in the order in which the policy sees them.
        metadata: anything JSON can hold (names, sizes, units, rate [Hz], run), stored in metadata_props.
        words: further metadata_props, as they are; see ``peer_words``.
        flat: one float32 input `obs` (batch, n_obs), the record's entries one after another, and the output `actions` (batch, n_out).
            Such a file is for other people's runtimes; ``load_onnx`` takes the one with names.

    Raises:
        ToolkitError: sizes that do not fit the policy, metadata that is not JSON, or a path that cannot be written.
    """
    import onnx

    _check_sizes(policy, action_map, record)
    try:
        text = json.dumps(dict(metadata or {}), sort_keys=True, allow_nan=False)
    except (TypeError, ValueError) as error:
        raise ToolkitError(f"metadata for {path} is not JSON ({error}); give strings, numbers and lists.") from error
    model = onnx.helper.make_model(
        _graph(policy, action_map, record, flat),
        producer_name="meta-evolve",
        opset_imports=[onnx.helper.make_opsetid("", OPSET)],
        ir_version=IR_VERSION,
    )
    onnx.helper.set_model_props(model, {METADATA_KEY: text, **(words or {})})
    onnx.checker.check_model(model, full_check=True)
    _write(Path(path), model.SerializeToString(deterministic=True))


def _graph(policy: "GaussianPolicy", action_map: ActionMap, record: Mapping[str, int], flat: bool) -> "onnx.GraphProto":
    """The same few lines as `GaussianPolicy.mean` and `ActionMap.__call__`, as nodes."""
    from onnx import TensorProto, helper, numpy_helper

    from toolkit.learning.policy import OBSERVATION_CLIP

    nodes, constants = [], []

    def constant(name: str, value: np.ndarray | float) -> str:
        constants.append(numpy_helper.from_array(np.asarray(value, dtype=np.float64), name))
        return name

    def node(operation: str, inputs: Sequence[str], output: str, **attributes: Any) -> str:
        nodes.append(helper.make_node(operation, inputs, [output], name=f"make.{output}", **attributes))
        return output

    def affine(x: str, name: str, W: np.ndarray, b: np.ndarray) -> str:
        # Transposed, so that a batch's rows pass through as one vector does.
        product = node("MatMul", [x, constant(f"{name}.weight", W.T)], f"{name}.product")
        return node("Add", [product, constant(f"{name}.bias", b)], f"{name}.sum")

    layers = policy.layers()
    clip = [constant("observation.low", -OBSERVATION_CLIP), constant("observation.high", OBSERVATION_CLIP)]
    x = FLAT_INPUT if flat else node("Concat", list(record), "observation", axis=0)
    x = node("Cast", [x], "observation.float64", to=TensorProto.DOUBLE)
    x = node("Sub", [x, constant("observation.shift", layers.shift)], "observation.centred")
    x = node("Div", [x, constant("observation.scale", layers.scale)], "observation.scaled")
    x = node("Clip", [x, *clip], "observation.clipped")
    for i, (W, b) in enumerate(layers.weights):
        x = affine(x, f"layer_{i}", W, b)
        if i < len(layers.weights) - 1:
            x = node("Tanh", [x], f"layer_{i}.tanh")
    x = affine(x, "action_map", action_map.matrix, action_map.offset)
    x = node("Clip", [x, constant("action.low", -1.0), constant("action.high", 1.0)], "action.clipped")
    out, batch = (FLAT_OUTPUT, ["batch"]) if flat else ("action", [])
    node("Cast", [x], out, to=TensorProto.FLOAT)
    vectors = {FLAT_INPUT: sum(record.values())} if flat else record
    inputs = [helper.make_tensor_value_info(name, TensorProto.FLOAT, [*batch, size]) for name, size in vectors.items()]
    output = helper.make_tensor_value_info(out, TensorProto.FLOAT, [*batch, len(action_map.offset)])
    return helper.make_graph(nodes, "meta_evolve_policy", inputs, [output], constants)


def peer_words(
    joints: Sequence[str], stiffness: Sequence[float], damping: Sequence[float], positions: Sequence[float], observations: Sequence[str],
    scale: Sequence[float], path: str,
) -> dict[str, str]:
    """metadata_props by the keys that Isaac Lab's and mjlab's exporters of policies use, lists separated by commas as there.

    Numbers are written so that they read back to the bit; the peers round them to three digits.

    Args:
        joints: names (n,).  stiffness, damping: of each one's motor [N m/rad, N m s/rad, or per metre]; 0 for a torque motor.
        positions: (n,) at the start [rad, m].
        observations: names of the entries, in order.
        scale: of each number of the action, in its unit.
        path: where the policy comes from.
    """
    rows: dict[str, Sequence[str] | Sequence[float]] = {
        "joint_names": joints, "joint_stiffness": stiffness, "joint_damping": damping, "default_joint_pos": positions,
        "command_names": (), "observation_names": observations, "action_scale": scale,
    }
    told = {key: ",".join(one if isinstance(one, str) else repr(float(one)) for one in row) for key, row in rows.items()}
    return {"run_path": path, **told}


def export_actor(policy: "GaussianPolicy", path: str | Path, action_map: ActionMap, metadata: Mapping[str, str]) -> None:
    """Write the policy's mean action as plain layers, safetensors, whole or not at all: robosuite's own action comes out.

    With x (n_obs,): ``x = clip((x - observation.shift) / observation.scale, -observation.clip, observation.clip)``, then per layer i
    ``x = layer_i.weight @ x + layer_i.bias``, tanh after each but the last, then ``clip(x, -1, 1)``. The map from the policy's record to
    robosuite's action is folded into the last layer. All float64.

    Args:
        policy: what to export.
        path: file to write.
        action_map: to the robot's own action.
        metadata: for the file's header.

    Raises:
        ToolkitError: the path cannot be written.
    """
    from safetensors.numpy import save

    from toolkit.learning.policy import OBSERVATION_CLIP

    layers = policy.layers()
    *inner, (W, b) = layers.weights
    weights = [*inner, (action_map.matrix @ W, action_map.matrix @ b + action_map.offset)]
    tensors = {"observation.shift": layers.shift, "observation.scale": layers.scale, "observation.clip": np.array([OBSERVATION_CLIP])}
    for i, (W, b) in enumerate(weights):
        tensors |= {f"layer_{i}.weight": W, f"layer_{i}.bias": b}
    _write(Path(path), save({name: np.ascontiguousarray(array) for name, array in tensors.items()}, dict(metadata)))


def _check_sizes(policy: "GaussianPolicy", action_map: ActionMap, record: Mapping[str, int]) -> None:
    n_obs, n_act = len(policy.observation_names), len(policy.action_names)
    if sum(record.values()) != n_obs or any(size < 1 for size in record.values()):
        raise ToolkitError(f"record {dict(record)} has {sum(record.values())} numbers; this policy sees {n_obs}.")
    for name in record:
        # The graph's own names hold a dot, or are these two; an input must not be mistaken for one of them.
        if not name or "." in name or name in ("observation", "action"):
            raise ToolkitError(f"record entry {name!r} cannot name an input; use no dot, 'observation' or 'action'.")
    if action_map.matrix.shape[1] != n_act:
        raise ToolkitError(f"ActionMap takes {action_map.matrix.shape[1]} action entries; this policy has {n_act}.")


def _write(path: Path, content: bytes) -> None:
    try:
        write_atomically(path, content)
    except OSError as error:
        raise ToolkitError(f"{path} cannot be written ({error.strerror}); choose a writable place.") from error


class OnnxPolicy:
    """An exported policy, ready to call. Made by `load_onnx`.

    Attributes:
        record: name -> size of each observation entry, in order.
        n_in, n_out: numbers of the observation and of the action.
        metadata: what the exporter stored.
    """

    def __init__(self, session: onnxruntime.InferenceSession, metadata: dict[str, Any]) -> None:
        self._session = session
        self.record = {entry.name: int(entry.shape[0]) for entry in session.get_inputs()}
        self.n_in = sum(self.record.values())
        self.n_out = int(session.get_outputs()[0].shape[0])
        self.metadata = metadata
        self._vector, self._action = np.zeros(self.n_in, np.float32), np.zeros(self.n_out, np.float32)
        self._binding, start = session.io_binding(), 0
        for name, size in self.record.items():  # the session reads its inputs out of the vector, and writes into the action
            self._binding.bind_cpu_input(name, self._vector[start : start + size])
            start += size
        self._binding.bind_output("action", "cpu", 0, np.float32, (self.n_out,), self._action.ctypes.data)

    def __call__(self, record: Mapping[str, np.ndarray]) -> np.ndarray:
        """One named record of (size,) arrays -> (n_out,) float32 action in [-1, 1], or NaN if the record holds any.

        Raises:
            ToolkitError: an entry that is missing, unknown or of the wrong size.
        """
        if record.keys() != self.record.keys():
            odd = sorted(record.keys() ^ self.record.keys())
            raise ToolkitError(f"the record lacks or adds {odd}; this policy takes {list(self.record)}.")
        feed = {name: np.asarray(record[name], dtype=np.float32) for name in self.record}
        for name, size in self.record.items():
            if feed[name].shape != (size,):
                raise ToolkitError(f"record entry {name!r} has shape {feed[name].shape}; give ({size},).")
        return self._session.run(["action"], feed)[0]

    def act(self, observation: np.ndarray) -> np.ndarray:
        """The same for one vector (n_obs,), entries in the record's order: a third of the time, as nothing is taken apart.

        Not for two threads at once: they would share the vector.
        """
        self._vector[:] = observation
        self._session.run_with_iobinding(self._binding)
        return self._action.copy()


def load_onnx(path: str | Path) -> OnnxPolicy:
    """Read a file that `export_onnx` wrote, to run on one CPU thread.

    Raises:
        ToolkitError: a file that is missing, damaged, or not an exported policy.
    """
    path = Path(path)
    if not path.is_file():
        raise ToolkitError(f"{path} does not exist; give the path of an exported policy.")
    return onnx_from_bytes(path.read_bytes(), str(path))


def flat_actions(content: bytes, observations: np.ndarray, where: str) -> np.ndarray:
    """(N, n_out) actions of a graph with one batched input for (N, n_obs) observations; ``where`` names the file in messages.

    Raises:
        ToolkitError: no such graph.
    """
    session = _session(content, where)
    try:
        return np.asarray(session.run([FLAT_OUTPUT], {FLAT_INPUT: np.asarray(observations, np.float32)})[0], float)
    except (*_LOAD_ERRORS, TypeError) as error:
        raise ToolkitError(f"{where} does not play ({str(error)[:120]}); export the policy again.") from None


def actor_actions(content: bytes, observations: np.ndarray, where: str) -> np.ndarray:
    """(N, n_out) actions of the plain layers that `export_actor` wrote for (N, n_obs) observations, by its formula.

    Raises:
        ToolkitError: no such layers; ``where`` names the file.
    """
    from safetensors import SafetensorError
    from safetensors.numpy import load

    try:
        tensors = load(content)
        x = (np.asarray(observations, float) - tensors["observation.shift"]) / tensors["observation.scale"]
        x = np.clip(x, -tensors["observation.clip"], tensors["observation.clip"])
        last = max(int(name.split("_")[1].split(".")[0]) for name in tensors if name.startswith("layer_"))
        for i in range(last + 1):
            x = x @ tensors[f"layer_{i}.weight"].T + tensors[f"layer_{i}.bias"]
            x = np.tanh(x) if i < last else np.clip(x, -1.0, 1.0)
    except (SafetensorError, KeyError, ValueError, IndexError) as error:
        raise ToolkitError(f"{where} holds no policy ({str(error)[:120]}); export the policy again.") from None
    return x


def onnx_from_bytes(content: bytes, where: str) -> OnnxPolicy:
    """As `load_onnx`, from a file's content; ``where`` names it in messages."""
    session = _session(content, where)
    try:
        text = session.get_modelmeta().custom_metadata_map.get(METADATA_KEY)  # as text: it may be none
    except _LOAD_ERRORS as error:
        raise ToolkitError(f"{where} is damaged or is not ONNX ({error}); export the policy again.") from error
    entries = [*session.get_inputs(), *session.get_outputs()]
    plain = all(entry.type == "tensor(float)" and [type(n) for n in entry.shape] == [int] for entry in entries)
    plain = plain and all(0 < entry.shape[0] <= LARGEST_VECTOR for entry in entries)
    if text is None or not plain or [entry.name for entry in session.get_outputs()] != ["action"]:
        raise ToolkitError(f"{where} is ONNX, but not an exported policy; give a file that export_onnx wrote.")
    return OnnxPolicy(session, parsed_object(text, f"the metadata of {where}", "export the policy again"))


def _session(content: bytes, where: str) -> onnxruntime.InferenceSession:
    options = onnxruntime.SessionOptions()
    # A few thousand products per call: a second thread would cost more than it does, and spin between calls.
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.log_severity_level = 4
    try:
        return onnxruntime.InferenceSession(content, options, providers=["CPUExecutionProvider"], enable_fallback=0)  # it prints
    except _LOAD_ERRORS as error:
        raise ToolkitError(f"{where} is damaged or is not ONNX ({error}); export the policy again.") from error


# onnxruntime's errors share no base but Exception; these are the ones that a bad file raises.
_LOAD_ERRORS = (
    OSError,
    RuntimeError,
    ValueError,
    TypeError,
    MemoryError,
    OverflowError,
    onnxruntime_errors.EPFail,
    onnxruntime_errors.Fail,
    onnxruntime_errors.InvalidArgument,
    onnxruntime_errors.InvalidGraph,
    onnxruntime_errors.InvalidProtobuf,
    onnxruntime_errors.NoModel,
    onnxruntime_errors.NotImplemented,
    onnxruntime_errors.RuntimeException,
)


def onnx_max_abs_error(
    policy: "GaussianPolicy", path: str | Path, observations: np.ndarray, action_map: ActionMap
) -> float:
    """Largest |ONNX - numpy| over the actions for (N, n_obs) observations, in robosuite's action units; NaN if any is.

    The reference sees the float64 observations, so the file's float32 inputs are part of what is measured.

    Raises:
        ToolkitError: a file that does not load, or observations that do not fit it.
    """
    exported = load_onnx(path)
    observations = np.asarray(observations, dtype=np.float64)
    n_obs = sum(exported.record.values())
    if observations.ndim != 2 or observations.shape[1] != n_obs or len(observations) == 0:
        raise ToolkitError(f"observations have shape {observations.shape}; give at least one row of {n_obs}.")
    ends = np.cumsum(list(exported.record.values()))[:-1]
    actions = [exported(dict(zip(exported.record, np.split(row, ends), strict=True))) for row in observations]
    return float(np.abs(np.array(actions, dtype=np.float64) - action_map(policy.mean(observations))).max())

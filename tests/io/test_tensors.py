"""Safetensors that are none, lie about their sizes, or hold what is not ours."""

import pytest
from damaged_files import tensors_with

from toolkit.errors import ToolkitError
from toolkit.io.tensors import read_tensors


@pytest.mark.parametrize("header, data", [
    (b"", b""), (b"{", b""), (b"[]", b""), ({"a": {"dtype": "F64", "shape": [10**15], "data_offsets": [0, 8]}}, bytes(8)),
    ({"a": {"dtype": "BF16", "shape": [4], "data_offsets": [0, 8]}, "__metadata__": {"state": "{}"}}, bytes(8)),
    ({"a": {"dtype": "F8_E4M3", "shape": [8], "data_offsets": [0, 8]}, "__metadata__": {"state": "{}"}}, bytes(8)),
    ({"a": {"dtype": "BOOL", "shape": [8], "data_offsets": [0, 8]}, "__metadata__": {"state": "{}"}}, bytes(8)),
    ({"__metadata__": {"state": "[1]"}}, b""), ({"__metadata__": {"state": "[" * 100_000}}, b""), ({"__metadata__": {"other": "{}"}}, b""),
])
def test_odd_safetensors(tmp_path, header, data):
    with pytest.raises(ToolkitError, match="delete it"):
        read_tensors(tensors_with(tmp_path / "c.safetensors", header, data), "checkpoint", "state", "delete it")

"""What is no JSON, no object or of another shape is said with its place."""

import pytest

from toolkit.errors import ToolkitError
from toolkit.io.jsonfiles import parsed, parsed_object, read_object, require


@pytest.mark.parametrize("content", [b"", b"{", b"\xff", b"[" * 100_000, b"9" * 5000, b'{"a": 1}}', "\udc80"])
def test_what_is_no_json_is_said(content):
    with pytest.raises(ToolkitError, match="f.json is not JSON.*mend it"):
        parsed(content, "f.json", "mend it")


@pytest.mark.parametrize("content", [b"[]", b"3", b"null", b'"x"', b"true"])
def test_what_is_no_object_is_said(content):
    with pytest.raises(ToolkitError, match="f.json holds no JSON object"):
        parsed_object(content, "f.json", "mend it")


def test_a_file_that_is_no_file(tmp_path):
    for path in (tmp_path, tmp_path / "none"):
        with pytest.raises(ToolkitError, match="cannot be read"):
            read_object(path, "mend it")


SHAPE = {"name": str, "count": int, "share": float, "maybe": (float, None), "list": [int], "map": {...: {"x": bool}}}


FIT = {"name": "a", "count": 3, "share": 1, "maybe": None, "list": [], "map": {"k": {"x": True, "more": 1}}, "more": []}


@pytest.mark.parametrize("change, place", [
    ({"name": 3}, "name"), ({"count": True}, "count"), ({"count": 1.0}, "count"), ({"share": float("nan")}, "share"),
    ({"share": float("inf")}, "share"), ({"share": "1"}, "share"), ({"maybe": []}, "maybe"), ({"list": {}}, "list"),
    ({"list": [1, None]}, r"list\[1\]"), ({"map": []}, "map"), ({"map": {"k": {}}}, "map.k.x"), ({"map": {"k": {"x": 1}}}, "map.k.x"),
])
def test_a_shape_is_required_and_the_place_named(change, place):
    assert require(FIT, SHAPE, "f.json", "mend it") is FIT
    with pytest.raises(ToolkitError, match=f"f.json is damaged, or of another version: {place} "):
        require(FIT | change, SHAPE, "f.json", "mend it")
    with pytest.raises(ToolkitError, match="name is missing"):
        require({key: value for key, value in FIT.items() if key != "name"}, SHAPE, "f.json", "mend it")

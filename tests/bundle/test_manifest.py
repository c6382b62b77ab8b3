"""A manifest that lacks an entry, or holds what has no place there, is refused by one sentence that names it."""

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from toolkit.bundle.manifest import read_manifest
from toolkit.bundle.reading import load_bundle
from toolkit.errors import ToolkitError

FREE = ("run", "object", "config")


@pytest.fixture(scope="module")
def manifest():
    return load_bundle("kinova3").manifest


def paths(value, path=()):
    """Every path in nested JSON, but inside the free-form run, object and configuration of the controller."""
    if path and path[-1] in FREE:
        return
    items = value.items() if isinstance(value, dict) else enumerate(value[:1]) if isinstance(value, list) else ()
    for key, item in items:
        yield (*path, key)
        yield from paths(item, (*path, key))


@settings(max_examples=150, deadline=None)
@given(data=st.data())
def test_a_manifest_that_lacks_or_garbles_any_entry_is_refused(manifest, data):
    """Whatever is taken out, or replaced by what has no place there, one sentence names the file and the entry."""
    content = manifest.to_json()
    path = data.draw(st.sampled_from(sorted(paths(content), key=str)))
    where = content
    for key in path[:-1]:
        where = where[key]
    free = path[0] in ("frames", "versions", "sha256", "fingers") or path[-2:-1] in (("targets",), ("fingers",), ("materials",))
    garble = data.draw(st.sampled_from(["drop", {"odd": 1}, float("nan"), True, ["x", {}]]))
    if garble == "drop" and (isinstance(where, list) or (free and len(path) > 1)):
        return  # a shorter list may be a list still, and a mapping may have fewer keys
    if garble == "drop":
        del where[path[-1]]
    elif (isinstance(garble, bool) and isinstance(where[path[-1]], bool)) or (isinstance(garble, dict) and path[-1] in FREE):
        return
    else:
        where[path[-1]] = garble
    with pytest.raises(ToolkitError, match="a/manifest.json (lacks or garbles|is no manifest|has format version)"):
        read_manifest(content, "a/manifest.json")

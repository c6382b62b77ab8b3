"""The manifest's JSON schema (draft 2020-12), made from its records: who reads a bundle elsewhere need not read this package.

Every record's docstring is its description, so that units, frames and meanings travel with the schema. What a schema cannot say (that two
lists are of one length, that limits have an order) only ``read_manifest`` checks. Needs only the standard library.
"""

import inspect
import types
import typing
from dataclasses import fields, is_dataclass
from typing import Any, Literal

from toolkit.bundle.manifest import FORMAT, FORMAT_VERSION, SINCE, Manifest

DRAFT = "https://json-schema.org/draft/2020-12/schema"
PLAIN = {str: "string", int: "integer", float: "number", bool: "boolean"}


def manifest_schema() -> dict[str, Any]:
    """The schema of a manifest of this release's format version."""
    found: dict[str, Any] = {}
    _kind(Manifest, found)
    top = found.pop(Manifest.__name__)
    for name in SINCE:  # optional only for those who still read older versions
        top["properties"][name] = top["properties"][name]["anyOf"][0]
    top["properties"]["format"] = {"const": FORMAT}
    top["properties"]["format_version"] = {"const": FORMAT_VERSION}
    return {"$schema": DRAFT, "title": f"{FORMAT}, version {FORMAT_VERSION}", **top, "$defs": found}


def _kind(kind: Any, found: dict[str, Any]) -> dict[str, Any]:
    """The schema of an annotated type; records go into ``found`` by name, and are referred to."""
    origin, arguments = typing.get_origin(kind), typing.get_args(kind)
    if isinstance(kind, type) and is_dataclass(kind):
        if kind.__name__ not in found:
            found[kind.__name__] = {}  # holds the place, should a record hold itself
            hints = typing.get_type_hints(kind)
            names = [field.name for field in fields(kind)]
            found[kind.__name__] = {
                "description": inspect.getdoc(kind), "type": "object", "required": names, "additionalProperties": False,
                "properties": {name: _kind(hints[name], found) for name in names},
            }
        return {"$ref": f"#/$defs/{kind.__name__}"}
    if origin is tuple:
        return {"type": "array", "items": _kind(arguments[0], found)}
    if origin is dict:
        return {"type": "object", "additionalProperties": _kind(arguments[1], found)}
    if origin in (types.UnionType, typing.Union):
        return {"anyOf": [{"type": "null"} if one is type(None) else _kind(one, found) for one in arguments]}
    if origin is Literal:
        return {"enum": list(arguments)}
    return {} if kind is Any else {"type": PLAIN[kind]}

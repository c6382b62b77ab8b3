"""A reader of JSON schemas that owes nothing to what writes ours."""


def complaints(value, schema, root, path="$"):
    """What is wrong with a JSON value, by the few words of JSON schema that ours uses; written from the specification, not from ours."""
    if "$ref" in schema:
        yield from complaints(value, root["$defs"][schema["$ref"].removeprefix("#/$defs/")], root, path)
    if "const" in schema and value != schema["const"]:
        yield f"{path} is not {schema['const']}"
    if "enum" in schema and value not in schema["enum"]:
        yield f"{path} is none of {schema['enum']}"
    if "anyOf" in schema and all(list(complaints(value, one, root, path)) for one in schema["anyOf"]):
        yield f"{path} fits nothing"
    if "type" in schema:
        number = isinstance(value, int | float) and not isinstance(value, bool)
        fits = {"object": isinstance(value, dict), "array": isinstance(value, list), "string": isinstance(value, str),
                "boolean": isinstance(value, bool), "null": value is None, "number": number,
                "integer": number and float(value).is_integer()}[schema["type"]]
        if not fits:
            yield f"{path} is no {schema['type']}"
            return
    if isinstance(value, dict):
        for name in schema.get("required", ()):
            if name not in value:
                yield f"{path}.{name} is missing"
        for name, item in value.items():
            inner = schema.get("properties", {}).get(name, schema.get("additionalProperties", {}))
            if inner is False:
                yield f"{path}.{name} is unknown"
            else:
                yield from complaints(item, inner, root, f"{path}.{name}")
    if isinstance(value, list):
        for place, item in enumerate(value):
            yield from complaints(item, schema.get("items", {}), root, f"{path}[{place}]")

"""The schema of manifests finds what is wrong with one; that what an export writes fits it, tests/export/test_packing.py shows."""

import pytest
from json_schema import complaints

from toolkit.bundle.reading import load_bundle
from toolkit.bundle.schema import manifest_schema


@pytest.fixture
def manifest():
    return load_bundle("jaco").manifest.to_json()


@pytest.mark.parametrize("name", ["jaco", "kinova3", "iiwa"])
def test_a_shipped_bundles_manifest_is_valid(name):
    schema = manifest_schema()
    assert list(complaints(load_bundle(name).manifest.to_json(), schema, schema)) == []


@pytest.mark.parametrize("harm, where", [
    (lambda m: m["simulation"]["osc"].pop("null_space"), "$.simulation.osc.null_space is missing"),
    (lambda m: m["joints"][2].update(speed="fast"), "$.joints[2].speed is no number"),
    (lambda m: m["controller"].update(input="absolute"), "$.controller.input is none of"),
    (lambda m: m["simulation"]["holding"].update(consecutive=1), "$.simulation.holding.consecutive is no boolean"),
    (lambda m: m.update(simulation=None), "$.simulation is no object"),
    (lambda m: m.update(licence=None), "$.licence is no string"),
    (lambda m: m.update(format_version=2), "$.format_version is not 6"),
    (lambda m: m["watch"].update(patience=3), "$.watch.patience is unknown"),
    (lambda m: m["simulation"]["actuators"][0].update(force=["x"]), "$.simulation.actuators[0].force fits nothing"),
    (lambda m: m["golden"].update(steps=2.5), "$.golden.steps is no integer"),
])
def test_what_is_wrong_is_found_by_the_schema(manifest, harm, where):
    schema = manifest_schema()
    harm(manifest)
    found = list(complaints(manifest, schema, schema))
    assert len(found) == 1 and found[0].startswith(where), found


def test_another_reader_of_schemas_agrees(manifest):
    jsonschema = pytest.importorskip("jsonschema")
    schema = manifest_schema()
    jsonschema.Draft202012Validator.check_schema(schema)
    jsonschema.validate(manifest, schema, jsonschema.Draft202012Validator)
    with pytest.raises(jsonschema.ValidationError):
        jsonschema.validate(manifest | {"simulation": None}, schema, jsonschema.Draft202012Validator)

"""The JSON Schema of summary.json: it describes every key, and results follow it."""

import json
import re

from jsonschema import Draft202012Validator
from summary_schema import schema_faults

from uwsfm.results.schema import SCHEMA_VERSION, summary_schema

UNIT = re.compile(
    r"pixels|metres|degrees|seconds|ratio|share|unit|variances|deviations|steps",
    re.IGNORECASE,
)
NAMED = re.compile(r"_(m|px|deg|s)$")


def properties(schema, path=()):
    """Every key that a schema describes."""
    for name, inner in schema.get("properties", {}).items():
        yield (*path, name), inner
        yield from properties(inner, (*path, name))
    for inner in (schema.get("items"), *schema.get("anyOf", ())):
        if isinstance(inner, dict):
            yield from properties(inner, path)
    for name, inner in schema.get("$defs", {}).items():
        yield from properties(inner, (*path, name))


def test_the_schema_is_one():
    Draft202012Validator.check_schema(summary_schema())
    version = summary_schema()["properties"]["schema_version"]["const"]
    assert version == SCHEMA_VERSION


def test_every_key_is_described_and_every_number_has_its_unit():
    found = dict(properties(summary_schema()))
    assert len(found) > 150
    for path, schema in found.items():
        options = schema.get("anyOf", [schema])
        text = " ".join(one.get("description", "") for one in (schema, *options))
        assert len(text.split()) >= 2, path
        kinds = schema.get("type", [])
        if "number" in ([kinds] if isinstance(kinds, str) else kinds):
            assert NAMED.search(path[-1]) or UNIT.search(text), path


def test_a_result_follows_the_schema(dive_result):
    summary = json.loads((dive_result.out / "summary.json").read_text())
    assert next(iter(summary)) == "schema_version"
    assert schema_faults(summary) == []
    summary["cameras"][0]["distance"] = 1.0
    (fault,) = schema_faults(summary)
    assert "'distance' was unexpected" in fault

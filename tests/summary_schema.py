"""Whether a summary is what the schema of the package says."""

from typing import Any

from jsonschema import Draft202012Validator

from uwsfm.results.schema import summary_schema


def schema_faults(summary: dict[str, Any], part: str | None = None) -> list[str]:
    """Where a summary, or a part of one that is named in $defs, is not."""
    schema = summary_schema()
    if part is not None:
        schema = {"$ref": f"#/$defs/{part}", "$defs": schema["$defs"]}
    found = Draft202012Validator(schema).iter_errors(summary)
    return [f"{list(fault.absolute_path)}: {fault.message}" for fault in found]

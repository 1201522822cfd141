"""Whether a summary is what the schema of the package says."""

from typing import Any

from jsonschema import Draft202012Validator

from uwsfm.export.schema import summary_schema


def schema_faults(summary: dict[str, Any]) -> list[str]:
    """Where it is not, one text each."""
    found = Draft202012Validator(summary_schema()).iter_errors(summary)
    return [f"{list(fault.absolute_path)}: {fault.message}" for fault in found]

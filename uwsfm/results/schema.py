"""The keys of summary.json and calibration.json, as a JSON Schema of the package."""

import json
from importlib.resources import files
from typing import Any

SCHEMA_VERSION = 1
"""It grows when a key changes its meaning or goes; a new key does not change it."""


def summary_schema() -> dict[str, Any]:
    """The schema of summary.json and calibration.json, each key with its unit."""
    text = (files("uwsfm.results") / "summary.schema.json").read_text(encoding="utf-8")
    schema: dict[str, Any] = json.loads(text)
    return schema

"""Scripts of pipelines/ name nothing that the package does not have any more."""

import ast
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path

import pytest

PIPELINES = Path(__file__).parent.parent / "pipelines"


@pytest.mark.parametrize(
    "script",
    sorted(PIPELINES.rglob("*.py")),
    ids=lambda path: str(path.relative_to(PIPELINES)),
)
def test_what_a_script_imports_is_there(script):
    imported = [
        (node.module, alias.name)
        for node in ast.walk(ast.parse(script.read_text(encoding="utf-8")))
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("uwsfm")
        for alias in node.names
    ]
    missing = [
        f"{module}.{name}"
        for module, name in imported
        if not hasattr(import_module(module), name)
        and find_spec(f"{module}.{name}") is None
    ]
    assert not missing

"""What keeps the house easy to live in: short files, few parameters."""

import ast
from pathlib import Path

import uwsfm

PACKAGE = Path(uwsfm.__file__).parent
MAX_LINES, MAX_PARAMETERS = 400, 8
KERNELS = {"inner", "inner_fused", "inner_straight", "kernel", "lane", "straight"}
"""Decorators of compiled functions, whose parameters are arrays and numbers."""
MORE = {
    "scene.py: from_arrays": "the arrays of a scene, by keyword",
    "simulate/commands.py: simulate_observations": "the numbers of a simulated dive",
    "sfm/pinhole/mapping_database.py: write_mapping_database": "rows of a database",
    "cli/simulate.py: simulate_observations": "one for each option of the command",
    "cli/dense.py: dense": "one for each option of the command",
    "cli/surface.py: mesh": "one for each option of the command",
}
"""Functions that take more than eight, and what they take."""


def parsed():
    for path in sorted(PACKAGE.rglob("*.py")):
        text = path.read_text(encoding="utf-8")
        yield str(path.relative_to(PACKAGE)), text, ast.parse(text)


def test_a_file_can_be_read_in_one_sitting():
    assert [n for n, text, _ in parsed() if text.count("\n") > MAX_LINES] == []


def test_a_call_can_be_read_at_a_glance():
    found = set()
    for name, _, tree in parsed():
        for node in ast.walk(tree):
            if not isinstance(node, ast.FunctionDef):
                continue
            given = node.args
            count = len(given.posonlyargs) + len(given.args) + len(given.kwonlyargs)
            words = {ast.unparse(d).split("(")[0] for d in node.decorator_list}
            if count > MAX_PARAMETERS and not words & KERNELS:
                found.add(f"{name}: {node.name}")
    assert found == set(MORE)

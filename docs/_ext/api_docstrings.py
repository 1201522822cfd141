"""Docstrings and signatures as they are written in the source, made readable.

Annotations such as ArrayLike stand as their names, not as what they expand to.
"""

import ast
import inspect
import re
import textwrap
from typing import Any

from sphinx.application import Sphinx

_written: dict[str, list[str]] = {}


def readable(
    app: Sphinx, what: str, name: str, value: Any, options: Any, lines: list[str]
) -> None:
    """Bars and stars are mathematics here, not substitutions or emphasis."""
    for i, line in enumerate(lines):
        parts = re.split(r"(``.*?``|`.*?`)", line)
        parts[::2] = [re.sub(r"(?<!\\)([|*])", r"\\\1", part) for part in parts[::2]]
        lines[i] = "".join(parts)
    _written[name] = list(lines)


def as_written(
    app: Sphinx, what: str, name: str, value: Any, options: Any, lines: list[str]
) -> None:
    """Undo for attributes what napoleon makes of a colon: a type."""
    if what in ("attribute", "property"):
        lines[:] = _written[name]


def written_signature(
    app: Sphinx, what: str, name: str, value: Any, options: Any, *_: Any
) -> tuple[str, str | None] | None:
    """The signature of a function by its source; none for a class, whose attributes
    are listed."""
    if what == "class":
        return "", None
    function = inspect.unwrap(getattr(value, "__func__", value))
    if not inspect.isfunction(function):
        return None
    node = ast.parse(textwrap.dedent(inspect.getsource(function))).body[0]
    assert isinstance(node, ast.FunctionDef)
    if what == "method" and node.args.args[0].arg in ("self", "cls"):
        del node.args.args[0]
    returns = None if node.returns is None else ast.unparse(node.returns).strip("'")
    return f"({ast.unparse(node.args)})", returns


def setup(app: Sphinx) -> dict[str, bool]:
    app.connect("autodoc-process-docstring", readable, priority=100)
    app.connect("autodoc-process-docstring", as_written, priority=900)
    app.connect("autodoc-process-signature", written_signature)
    return {"parallel_read_safe": True, "parallel_write_safe": True}

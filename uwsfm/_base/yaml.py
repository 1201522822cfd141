"""YAML that people write: read fast, without surprises, refused in one sentence."""

from __future__ import annotations

import re
import reprlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import yaml

from uwsfm._base.files import read_text
from uwsfm.errors import InputError

MAX_BYTES = 2_000_000
"""More than ten thousand dives; libyaml reads it in a few seconds."""
MAX_DEPTH = 50
"""Of blocks within blocks; the deepest file of ours has 8."""
MAX_NODES = 500_000
"""Values, those of an alias counted wherever it stands: aliases of aliases grow
exponentially."""

_MISREAD = (
    yaml.YAMLError,
    ValueError,
    OverflowError,
    RecursionError,
    LookupError,  # of PyYAML's constructors, for a value that its tag does not fit
    TypeError,
    AttributeError,
)

# libyaml reads ten times as fast as Python; not every PyYAML was built with it.
_SafeLoader: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)


class _Loader(_SafeLoader):
    """Safe YAML that reads 1e-3 as a number."""


_Loader.add_implicit_resolver(
    "tag:yaml.org,2002:float",
    re.compile(r"[-+]?(\d+\.?\d*|\.\d+)[eE][-+]?\d+$"),
    list("-+.0123456789"),
)


def read_yaml(path: Path, example: str = "version: 1") -> dict:
    """The keys and values of a YAML file.

    Args:
        path: Of the file.
        example: A line that the file may have, for the error.

    Raises:
        InputError: one sentence with the line, without the path: no such file, not
            YAML, a key given twice, a placeholder left in, or no keys at all.
    """
    text = read_text(path, MAX_BYTES)
    loader = None
    try:
        loader = _Loader(text)
        node = loader.get_single_node()
        _check(node)
        data = None if node is None else loader.construct_document(node)
    except yaml.MarkedYAMLError as error:
        raise InputError(_sentence(error, text)) from None
    except _MISREAD as error:
        reason = str(error).partition("\n")[0]
        raise InputError(f"not valid YAML: {reason}") from None
    finally:
        if loader is not None:
            loader.dispose()
    if not isinstance(data, dict):
        what = "is empty" if data is None else f"holds {reprlib.repr(data)}"
        raise InputError(f"{what} instead of keys such as {example!r}")
    return data


def _sentence(error: yaml.MarkedYAMLError, text: str) -> str:
    mark = error.problem_mark or error.context_mark
    if mark is None:
        return f"not valid YAML: {error.problem}"
    lines = text.splitlines()
    line = lines[mark.line] if mark.line < len(lines) else ""
    blank = line[: len(line) - len(line.lstrip())]
    hint = "; indent with spaces, not tabs" if "\t" in blank else ""
    return f"line {mark.line + 1}: not valid YAML: {error.problem}{hint}"


def _check(root: yaml.Node | None) -> None:
    """Refuse keys that are no text or come twice, placeholders, and endless aliases."""
    num_nodes = 0
    stack = [] if root is None else [(root, "", 0)]
    while stack:
        node, key, depth = stack.pop()
        num_nodes += 1
        if depth > MAX_DEPTH or num_nodes > MAX_NODES:
            raise yaml.MarkedYAMLError(
                problem="too many blocks within blocks, or aliases of aliases",
                problem_mark=node.start_mark,
            )
        if isinstance(node, yaml.MappingNode):
            _check_keys(node, key)
        for child, name in _children(node, key):
            if isinstance(child, yaml.ScalarNode):
                num_nodes += 1
            else:
                stack.append((child, name, depth + 1))


def _children(node: yaml.Node, key: str) -> Iterator[tuple[yaml.Node, str]]:
    if isinstance(node, yaml.MappingNode):
        for name, value in node.value:
            yield value, f"{key}.{name.value}" if key else str(name.value)
    elif isinstance(node, yaml.SequenceNode):
        for i, value in enumerate(node.value):
            yield value, f"{key}[{i}]"


def _check_keys(node: yaml.MappingNode, path: str) -> None:
    seen = set()
    for key, _ in node.value:
        if not isinstance(key, yaml.ScalarNode):
            where = f" of {path}" if path else ""
            problem = f"a key{where} is a list or a block instead of a word"
            if isinstance(key, yaml.MappingNode) and key.flow_style:
                problem = (
                    f"the value{where} is a placeholder in double braces that was not "
                    "filled in"
                )
            raise yaml.MarkedYAMLError(problem=problem, problem_mark=key.start_mark)
        if key.value in seen:
            raise yaml.MarkedYAMLError(
                problem=f"the key {key.value!r} is given twice",
                problem_mark=key.start_mark,
            )
        seen.add(key.value)

"""Binary PLY tables: what MeshLab, CloudCompare and Open3D read."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from uwsfm._files import replaced_file
from uwsfm.errors import InputError

_NAMES = {
    "i1": "char",
    "u1": "uchar",
    "<i2": "short",
    "<u2": "ushort",
    "<i4": "int",
    "<u4": "uint",
    "<f4": "float",
    "<f8": "double",
}
_KINDS = {name: kind for kind, name in _NAMES.items()} | {
    "int8": "i1",
    "uint8": "u1",
    "int16": "<i2",
    "uint16": "<u2",
    "int32": "<i4",
    "uint32": "<u4",
    "float32": "<f4",
    "float64": "<f8",
}
_MAX_HEADER = 65_536


def write_ply(
    path: Path, tables: Sequence[tuple[str, np.ndarray]], *, comment: str
) -> None:
    """Write tables, little endian.

    Args:
        path: the file; replaced when all of it is there.
        tables: name and structured array of each element; a column of rows, such as
            a triangle's three vertices, is a list, and the column before it its length.
        comment: one line.
    """
    header = ["ply", "format binary_little_endian 1.0", f"comment {comment}"]
    for element, table in tables:
        header.append(f"element {element} {len(table)}")
        header += _properties(table.dtype)
    with replaced_file(path) as partial, partial.open("wb") as file:
        file.write("\n".join([*header, "end_header\n"]).encode("ascii"))
        for _, table in tables:
            table.tofile(file)


def _properties(kinds: np.dtype) -> list[str]:
    """Lines of a header."""
    lines: list[str] = []
    for name in kinds.names or ():
        base, shape = kinds[name].base, kinds[name].shape
        kind = _NAMES[base.str.lstrip("|")]
        if shape:
            _, length, _ = lines.pop().split()
            lines.append(f"property list {length} {kind} {name}")
        else:
            lines.append(f"property {kind} {name}")
    return lines


def read_vertices(path: Path) -> tuple[np.ndarray, list[str]]:
    """The vertices of a binary little-endian PLY, as a structured array, and the
    file's comments.

    Raises:
        InputError: there is no such file, or it is of another kind or cut short.
    """
    path = Path(path)
    try:
        with path.open("rb") as file:
            lines, size = _header(path, file.read(_MAX_HEADER))
    except OSError as error:
        raise InputError(f"cannot read {path}: {error.strerror}") from None
    if lines[1:2] != ["format binary_little_endian 1.0"]:
        raise InputError(f"{path}: only binary little-endian PLY files are read")
    count, fields = -1, []
    element = ""
    for words in (line.split() for line in lines[2:]):
        if words[:1] == ["element"]:
            if element == "vertex":
                break
            if element:
                raise InputError(f"{path}: element {element} precedes the vertices")
            element, count = words[1], int(words[2])
        elif words[:1] == ["property"]:
            if len(words) != 3 or words[1] not in _KINDS:
                raise InputError(f"{path}: property '{' '.join(words[1:])}' of vertex")
            fields.append((words[2], _KINDS[words[1]]))
    if element != "vertex" and not fields:
        raise InputError(f"{path}: a PLY file without vertices")
    comments = [line[8:] for line in lines if line.startswith("comment ")]
    table = np.fromfile(path, dtype=fields, count=count, offset=size)
    if len(table) != count:
        raise InputError(f"{path}: holds {len(table)} of its {count} vertices")
    return table, comments


def _header(path: Path, start: bytes) -> tuple[list[str], int]:
    """Lines of the header and its size in bytes."""
    mark = b"end_header\n"
    end = start.find(mark)
    if not start.startswith(b"ply\n") or end < 0:
        raise InputError(f"{path}: not a PLY file")
    return start[:end].decode("ascii", "replace").splitlines(), end + len(mark)

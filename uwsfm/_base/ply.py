"""PLY tables: what MeshLab, CloudCompare and Open3D write and read."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from uwsfm._base.files import replaced_file, require_regular
from uwsfm._base.paths import shown
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
_LITTLE = "format binary_little_endian 1.0"
_BIG = "format binary_big_endian 1.0"
_ASCII = "format ascii 1.0"
XYZ = [(axis, "<f4") for axis in "xyz"]
RGB = [(name, "u1") for name in ("red", "green", "blue")]
"""Columns of points and of their colours."""
_MAX_HEADER = 65_536
_MAX_DIGITS = 18
"""Of a count: more vertices than any disk holds."""


def stacked_rows(
    fields: list[tuple[str, str]], *values: Sequence[np.ndarray]
) -> np.ndarray:
    """Columns of numbers, those of each list side by side, as a structured array.

    Args:
        fields: name and kind of each column.
        values: lists of arrays (N_k, K), which are put one below the other.
    """
    columns = [column for part in values for column in np.concatenate(part).T]
    rows = np.zeros(len(columns[0]), dtype=fields)
    for (name, _), column in zip(fields, columns, strict=True):
        rows[name] = column
    return rows


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
    header = ["ply", _LITTLE, f"comment {comment}"]
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
    """The vertices of a PLY, binary of either byte order or in text, as a structured
    array in this machine's byte order, and the file's comments.

    Raises:
        InputError: there is no such file, or it is of another kind or cut short.
    """
    path = Path(path)
    try:
        num_bytes = require_regular(path).st_size
        with path.open("rb") as file:
            lines, size = _header(file.read(_MAX_HEADER))
        count, fields = _vertex_element(lines)
        kind = np.dtype(fields)
        in_text = lines[1] == _ASCII
        smallest = 2 * len(fields) if in_text else kind.itemsize  # a digit and a space
        there = max(num_bytes - size + in_text, 0) // smallest
        if there < count:  # before memory is taken for what is not there
            raise InputError(f"holds {there} of its {count} vertices")
        if in_text:
            table = _text_rows(path, size, count, kind)
        else:
            swapped = kind if lines[1] == _LITTLE else kind.newbyteorder(">")
            stored = np.fromfile(path, dtype=swapped, count=count, offset=size)
            table = stored.astype(kind, copy=False)
    except OSError as error:
        raise InputError(f"cannot read {path}: {error.strerror}") from None
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    comments = [line[8:] for line in lines if line.startswith("comment ")]
    return table, comments


def _text_rows(path: Path, size: int, count: int, kind: np.dtype) -> np.ndarray:
    """Rows of numbers, one vertex a line."""
    names = kind.names or ()
    with path.open("rb") as file:
        file.seek(size)
        try:
            rows = np.loadtxt(
                file,
                comments=None,
                max_rows=count,
                usecols=range(len(names)),
                ndmin=2,
                encoding="ascii",
            )
        except (ValueError, UnicodeDecodeError) as error:
            raise InputError(f"a vertex is no row of numbers: {error}") from None
    if len(rows) < count:
        raise InputError(f"holds {len(rows)} of its {count} vertices")
    table = np.empty(count, dtype=kind)
    for column, name in enumerate(names):
        values, of = rows[:, column], kind[name]
        if of.kind in "iu":
            limits = np.iinfo(of)
            good = (values >= limits.min) & (values <= limits.max)
            if not np.all(good & (values == np.round(values))):
                raise InputError(
                    f"property {shown(name)} of a vertex is no integer from "
                    f"{limits.min} to {limits.max}"
                )
        table[name] = values
    return table


def _header(start: bytes) -> tuple[list[str], int]:
    """Lines of the header and its size in bytes."""
    if not start.startswith((b"ply\n", b"ply\r")):
        raise InputError("not a PLY file")
    mark = re.search(rb"(?:\n|\r)end_header(?:\r\n|\n|\r)", start)
    end = start.find(b"end_header")
    lines = start[: max(end, 0)].decode("utf-8", "replace").splitlines()
    if mark is None:
        raise InputError(
            "not a PLY file: no end_header within its first "
            f"{min(len(start), _MAX_HEADER)} bytes"
        )
    if len(lines) < 2 or lines[1] not in (_ASCII, _LITTLE, _BIG):
        found = shown(lines[1]) if len(lines) > 1 else ""
        raise InputError(
            f"the second line of a PLY file is '{_LITTLE}', '{_BIG}' or '{_ASCII}', "
            f"got {found!r}"
        )
    return lines, mark.end()


def _vertex_element(lines: list[str]) -> tuple[int, list[tuple[str, str]]]:
    """Number of the vertices, and name and kind of each of their properties."""
    count = -1
    fields: list[tuple[str, str]] = []
    for line in lines[2:]:
        words = line.split()
        if words[:1] == ["element"]:
            if count >= 0:
                break
            if len(words) != 3 or not words[2].isascii() or not words[2].isdecimal():
                raise InputError(
                    f"{shown(line)!r} in its header: expected 'element NAME COUNT'"
                )
            if words[1] != "vertex":
                raise InputError(f"element {shown(words[1])} precedes the vertices")
            if len(words[2]) > _MAX_DIGITS:
                raise InputError(f"claims {shown(words[2])} vertices: it is damaged")
            count = int(words[2])
        elif words[:1] == ["property"]:
            if len(words) != 3 or words[1] not in _KINDS:
                raise InputError(f"property '{shown(' '.join(words[1:]))}' of vertex")
            if words[2] in dict(fields):
                raise InputError(f"property {shown(words[2])} of vertex comes twice")
            fields.append((words[2], _KINDS[words[1]]))
    if count < 0 or not fields:
        raise InputError("a PLY file without vertices")
    return count, fields

"""Paths that come from data: the names of images in models, databases and tables.

A file that somebody else wrote may name ``left/../../x.jpg``. Names are checked once
where they are read, and `inside` is the one way to a file that is written under such a
name.
"""

import os
import re
import unicodedata
from collections.abc import Iterable
from pathlib import Path, PurePosixPath, PureWindowsPath

from uwsfm.errors import InputError

LONGEST_NAME = 255
"""Bytes of one part of a path, in the file systems of today."""


def name_fault(name: str) -> str | None:
    """What is wrong with the name of an image below the image folder, or None.

    White space is allowed here: only text formats lose it, see `white_space_fault`.
    """
    if not name:
        return "is empty"
    if "\0" in name:
        return "contains a NUL character: the file that holds it is damaged"
    if any("\udc80" <= letter <= "\udcff" for letter in name):
        return "is not UTF-8: rename the image"
    if any(unicodedata.category(letter) in ("Cc", "Zl", "Zp") for letter in name):
        return "contains a control character: rename the image"
    if "\\" in name:
        return (
            "contains a backslash: COLMAP separates folders by forward slashes; "
            f"rename it, for instance to {name.replace(chr(92), '/')!r}"
        )
    if PurePosixPath(name).is_absolute() or PureWindowsPath(name).drive:
        return "is absolute: names must be relative to the folder of the images"
    parts = name.split("/")
    if ".." in parts:
        return "leads out of the folder of the images: '..' is not allowed"
    if not all(parts) or set(parts) == {"."}:
        return "names a folder, not a file"
    if max(len(os.fsencode(part)) for part in parts) > LONGEST_NAME:
        return f"is longer than the {LONGEST_NAME} bytes of a file name"
    return None


def white_space_fault(name: str) -> str | None:
    """Why a name cannot stand in a text file of COLMAP, or None."""
    if re.search(r"\s", name) is None:
        return None
    return (
        "contains white space, at which COLMAP's text format cuts names: rename the "
        "images, or use the binary format"
    )


def shown(name: str) -> str:
    """A name in a message: one line of printable characters, not too long."""
    text = repr(name)[1:-1] if not name.isprintable() else name
    return text if len(text) <= 100 else f"{text[:60]} ... {text[-30:]}"


def check_image_names(where: object, names: Iterable[str]) -> None:
    """Refuse names that no file below the image folder has, and names given twice.

    Args:
        where: the file or folder that holds the names, for the message.
        names: of all its images.

    Raises:
        InputError: the first of them, and what is wrong.
    """
    seen = set()
    for name in names:
        fault = name_fault(name)
        if fault is not None:
            raise InputError(f"{where}: the image name {shown(name)!r} {fault}")
        if name in seen:
            raise InputError(
                f"{where}: two images have the name {shown(name)}: which observations "
                "belong to it is not known; remove one of them"
            )
        seen.add(name)


def inside(folder: Path, name: str) -> Path:
    """The path of a file to write under a name from data, below a folder.

    Args:
        folder: where the files go; links in the path of the folder itself are allowed.
        name: with forward slashes.

    Raises:
        InputError: the name, or a link in the folder, leads out of it.
    """
    fault = name_fault(name)
    if fault is not None:
        raise InputError(f"cannot write {shown(name)!r} in {folder}: the name {fault}")
    path = folder / PurePosixPath(name)
    root = os.path.realpath(folder)
    if not Path(os.path.realpath(path.parent)).is_relative_to(root):
        raise InputError(
            f"cannot write {path}: a link below {folder} leads out of it; remove it"
        )
    return path

"""Outputs are written beside their place and renamed: never half a file."""

import json
import os
import shutil
import stat
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from uwsfm._base.partial import partial_prefix, scratch_folder
from uwsfm.errors import InputError


def require_regular(path: Path) -> os.stat_result:
    """The status of a file that is to be read.

    A pipe or a device would be waited on for ever, or has no end.

    Raises:
        InputError: there is none, it cannot be looked at, or it is no ordinary file;
            the caller puts the path in front.
    """
    try:
        status = os.stat(path)
    except FileNotFoundError:
        raise InputError("there is no such file") from None
    except (OSError, ValueError) as error:  # ValueError: a NUL in the path
        reason = getattr(error, "strerror", None) or str(error)
        raise InputError(f"cannot be read: {reason}") from None
    if stat.S_ISDIR(status.st_mode):
        raise InputError("cannot be read: Is a directory")
    if not stat.S_ISREG(status.st_mode):
        raise InputError("is a pipe or a device; copy it to a file first")
    return status


def read_text(path: Path, max_bytes: int) -> str:
    """The text of a file in UTF-8.

    Args:
        path: the file.
        max_bytes: a longer one is no such file, and would take long to refuse.

    Raises:
        InputError: as `require_regular`; it is too long, or no text in UTF-8.
    """
    size = require_regular(path).st_size
    if size > max_bytes:
        raise InputError(
            f"has {size / 1e6:.1f} MB, but files of this kind have less than "
            f"{max_bytes / 1e6:.0f} MB; is it the right file?"
        )
    try:
        return Path(path).read_text(encoding="utf-8-sig")
    except OSError as error:
        raise InputError(f"cannot be read: {error.strerror}") from None
    except UnicodeDecodeError:
        raise InputError("is not a text file in UTF-8") from None


def read_json(path: Path, max_bytes: int) -> Any:
    """What a JSON file holds.

    Raises:
        InputError: as `read_text`, or it is no JSON.
    """
    try:
        return json.loads(read_text(path, max_bytes))
    except InputError:
        raise
    except (ValueError, RecursionError):
        raise InputError("is damaged, or no JSON file") from None


@contextmanager
def replaced_file(path: Path) -> Iterator[Path]:
    """Yield a temporary path in the same folder; rename it to ``path`` on success."""
    path = Path(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, name = tempfile.mkstemp(
            dir=path.parent, prefix=partial_prefix(), suffix=path.suffix
        )
    except OSError as error:
        raise InputError(f"cannot write {path}: {error.strerror}") from None
    os.close(handle)
    os.chmod(name, 0o644)
    partial = Path(name)
    try:
        yield partial
        os.replace(partial, path)
    finally:
        partial.unlink(missing_ok=True)


def require_writable(path: Path) -> None:
    """Tell before the work what could not be written after it.

    Args:
        path: a file or folder that will be written; it need not exist.

    Raises:
        InputError: the nearest folder above it that exists is none, or is read-only.
    """
    folder = Path(path).absolute().parent
    while not folder.exists():
        folder = folder.parent
    if not folder.is_dir():
        raise InputError(f"cannot write {path}: {folder} is no folder")
    if not os.access(folder, os.W_OK | os.X_OK):
        raise InputError(f"cannot write {path}: {folder} is read-only")


def checked_target(path: str | Path) -> Path:
    """Where an export may be written: never over anything.

    Raises:
        InputError: there is something already, or nothing can be written there.
    """
    target = Path(path)
    require_writable(target)
    if target.exists() and not (target.is_dir() and not any(target.iterdir())):
        raise InputError(f"{target} exists already: name another place with --out")
    return target


@contextmanager
def replaced_dir(path: Path) -> Iterator[Path]:
    """Yield a temporary folder beside ``path``; it takes its place on success."""
    path = Path(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        partial = Path(tempfile.mkdtemp(dir=path.parent, prefix=partial_prefix()))
    except OSError as error:
        raise InputError(f"cannot write {path}: {error.strerror}") from None
    os.chmod(partial, 0o755)
    try:
        yield partial
        # What it replaces may take long to remove, and is needed until then.
        with scratch_folder(path.parent) as old:
            if path.exists():
                os.replace(path, old / path.name)
            os.replace(partial, path)
    finally:
        if partial.exists():
            shutil.rmtree(partial)

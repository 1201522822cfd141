"""Outputs are written beside their place and renamed: never half a file."""

import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from uwsfm.errors import InputError

PARTIAL = ".uwsfm-partial-"
"""Start of the names of what is being written; a killed process leaves it behind."""


@contextmanager
def replaced_file(path: Path) -> Iterator[Path]:
    """Yield a temporary path in the same folder; rename it to ``path`` on success."""
    path = Path(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, name = tempfile.mkstemp(
            dir=path.parent, prefix=PARTIAL, suffix=path.suffix
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
        partial = Path(tempfile.mkdtemp(dir=path.parent, prefix=PARTIAL))
    except OSError as error:
        raise InputError(f"cannot write {path}: {error.strerror}") from None
    os.chmod(partial, 0o755)
    try:
        yield partial
        # What it replaces may take long to remove, and is needed until then.
        with tempfile.TemporaryDirectory(dir=path.parent, prefix=PARTIAL) as old:
            if path.exists():
                os.replace(path, Path(old) / path.name)
            os.replace(partial, path)
    finally:
        if partial.exists():
            shutil.rmtree(partial)

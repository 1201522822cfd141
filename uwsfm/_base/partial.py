"""What is being written, under names that tell whether it still is.

A killed process leaves its half-written files and its scratch folders. Their names hold
who made them, so that the next run removes what nobody writes to any more.
"""

import hashlib
import os
import platform
import secrets
import shutil
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path

PARTIAL = ".uwsfm-partial-"
"""Start of the names of what is being written."""
ABANDONED_SECONDS = 86_400.0
"""After which what another machine began in a shared folder is taken for left over."""

_HOST = hashlib.sha256(platform.node().encode()).hexdigest()[:8]
_TOKEN = secrets.token_hex(4)
"""Of this process: in containers the next one often has the same number."""


def partial_prefix() -> str:
    """Start of a name that this process writes under."""
    return f"{PARTIAL}{_HOST}-{os.getpid()}-{_TOKEN}-"


def remove_stale(folder: Path, *, deep: bool = False) -> None:
    """Remove what dead processes left in a folder, as far as that is allowed.

    Args:
        folder: need not exist.
        deep: in the folders below it as well.
    """
    pattern = f"{PARTIAL}*"
    for path in list(folder.rglob(pattern) if deep else folder.glob(pattern)):
        if not _is_stale(path):
            continue
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path, ignore_errors=True)
        else:
            with suppress(OSError):
                path.unlink()


def _is_stale(path: Path) -> bool:
    host, _, rest = path.name[len(PARTIAL) :].partition("-")
    pid, _, rest = rest.partition("-")
    if not pid.isdecimal():  # of an earlier version
        return True
    if host != _HOST:
        with suppress(OSError):
            return time.time() - path.lstat().st_mtime > ABANDONED_SECONDS
        return False
    if int(pid) == os.getpid():
        return not rest.startswith(_TOKEN)
    import psutil

    return not psutil.pid_exists(int(pid))


@contextmanager
def scratch_folder(parent: Path | None = None) -> Iterator[Path]:
    """A temporary folder, and an end to those that killed processes left.

    Args:
        parent: where it is; None: the system's folder of temporary files.
    """
    if parent is None:
        _clean_temporary(Path(tempfile.gettempdir()))
    with tempfile.TemporaryDirectory(prefix=partial_prefix(), dir=parent) as name:
        yield Path(name)


@cache
def _clean_temporary(folder: Path) -> None:
    """Once in a process: others may have thousands of files there."""
    remove_stale(folder)

"""Disks that are full, or will be: said before the work, and in one sentence after it.

COLMAP ends the whole process where a thread of its own cannot write a database. So room
is asked for before each such thread begins.
"""

from __future__ import annotations

import errno
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from uwsfm._base.partial import PARTIAL
from uwsfm.errors import UwsfmError

_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
_FULL_WORDS = ("database or disk is full", "no space left on device")
"""Of SQLite within COLMAP, and of C++."""
SPARE_BYTES = 2_000_000
"""For logs, records and the journals of databases."""


class DiskFullError(UwsfmError):
    """There is no room for what has to be written."""


def is_full(error: BaseException) -> bool:
    """Whether an error, or one that it came from, is a lack of room on a disk."""
    seen: set[int] = set()
    current: BaseException | None = error
    while current is not None and id(current) not in seen:
        seen.add(id(current))
        if isinstance(current, OSError) and current.errno in _FULL:
            return True
        if any(words in str(current).lower() for words in _FULL_WORDS):
            return True
        current = current.__cause__ or current.__context__
    return False


def room(folder: Path) -> int:
    """Bytes that a file in a folder may have, by the disk and the process's limit.

    Args:
        folder: it, or the nearest folder above it that exists.
    """
    folder = folder.absolute()
    while not folder.exists():
        folder = folder.parent
    free = shutil.disk_usage(folder).free
    if os.name == "nt":
        return free
    import resource

    limit, _ = resource.getrlimit(resource.RLIMIT_FSIZE)
    return free if limit == resource.RLIM_INFINITY else min(free, limit)


def require_room(folder: Path, num_bytes: float, what: str) -> None:
    """Refuse work whose results would not fit.

    Args:
        folder: where they go.
        num_bytes: that they take, at least.
        what: is done, for the message: "finding features".

    Raises:
        DiskFullError: the folder, and how much is missing.
    """
    there, needed = room(folder), num_bytes + SPARE_BYTES
    if there < needed:
        above = [folder, *folder.parents]
        partial = [path for path in above if path.name.startswith(PARTIAL)]
        where = partial[-1].parent if partial else folder
        raise DiskFullError(
            f"the disk of {where} is full: {what} takes {_megabytes(needed)} more, "
            f"{_megabytes(there)} are free; make room and run the same command again, "
            "which goes on from here"
        )


def _megabytes(num_bytes: float) -> str:
    if num_bytes < 1e9:
        return f"{num_bytes / 1e6:.0f} MB"
    return f"{num_bytes / 1e9:.1f} GB"


@contextmanager
def explained(folder: Path) -> Iterator[None]:
    """Turn what a full disk does to a job into one sentence.

    Args:
        folder: where the results of the job go.

    Raises:
        DiskFullError: the path, and that the same command goes on.
    """
    try:
        yield
    except DiskFullError:
        raise
    except Exception as error:
        if not is_full(error):
            raise
        path = getattr(error, "filename", None) or folder
        raise DiskFullError(
            f"the disk is full: {path} cannot be written; make room and run the same "
            "command again, which goes on from here"
        ) from error

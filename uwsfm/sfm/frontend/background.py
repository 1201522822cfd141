"""Long pycolmap calls: quiet, with progress, and stopped by Ctrl-C."""

from __future__ import annotations

import errno
import os
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from concurrent.futures import TimeoutError as StillRunning
from contextlib import contextmanager
from pathlib import Path
from typing import TypeVar
from zipfile import BadZipFile
from zlib import error as BadCompression

import pycolmap

from uwsfm._base.disk import is_full
from uwsfm.errors import UwsfmError

Result = TypeVar("Result")

POLL_SECONDS = 0.2
FATAL_ONLY = 3
DAMAGE = (OSError, EOFError, ValueError, KeyError, BadZipFile, BadCompression)
"""What numpy raises for a file of arrays that was cut short or overwritten."""


@contextmanager
def quiet_colmap() -> Iterator[None]:
    """Keep COLMAP's log off the terminal; what goes wrong is reported by exceptions."""
    level = pycolmap.logging.minloglevel
    pycolmap.logging.minloglevel = FATAL_ONLY
    try:
        yield
    finally:
        pycolmap.logging.minloglevel = level


@contextmanager
def opened(database_path: Path) -> Iterator[pycolmap.Database]:
    """A database, without COLMAP's messages.

    Never look into a database that COLMAP has open with Python's `sqlite3`: the two
    libraries share a process and with it its file locks, and writes of COLMAP get
    lost, silently (SQLite, "How to corrupt a database file", 2.2.1).
    """
    with quiet_colmap():
        try:
            database = pycolmap.Database.open(database_path)
        except RuntimeError as error:
            if is_full(error):
                raise
            raise damaged(database_path) from None
        with database:
            yield database


def damaged(path: Path, error: BaseException | None = None) -> UwsfmError:
    """A file in the workspace is not what a step wrote, or cannot be looked at.

    Args:
        path: the file.
        error: what came of reading it.
    """
    if isinstance(error, OSError) and not isinstance(error, FileNotFoundError):
        return UwsfmError(f"cannot read {path}: {error.strerror or error}")
    if path.exists() and not os.access(path, os.R_OK):
        return UwsfmError(f"cannot read {path}: {os.strerror(errno.EACCES)}")
    return UwsfmError(f"{path} is damaged: remove the folder {path.parent}, run again")


def remove_database(path: Path) -> None:
    """Remove a database with its journals: a stale one would corrupt the next."""
    for suffix in ("-wal", "-shm", "-journal", ""):
        path.with_name(path.name + suffix).unlink(missing_ok=True)


def run_watched(
    call: Callable[[pycolmap.CancellationToken], Result], watch: Callable[[], None]
) -> Result:
    """Run ``call`` in a thread and ``watch`` in this one, every fifth of a second.

    pycolmap releases the GIL but looks at no signals: an exception here (Ctrl-C, or
    raised by ``watch``) cancels the call, waits for its end, and goes on.
    """
    token = pycolmap.CancellationToken()
    with quiet_colmap(), ThreadPoolExecutor(max_workers=1) as pool:
        future = pool.submit(call, token)
        try:
            while True:
                try:
                    return future.result(timeout=POLL_SECONDS)
                except StillRunning:
                    if future.done():  # the call itself raised a TimeoutError
                        raise
                    watch()
        except BaseException:
            token.cancel()
            raise


def run_with_database(
    database_path: Path,
    call: Callable[[pycolmap.CancellationToken], Result],
    watch: Callable[[pycolmap.Database], None],
) -> Result:
    """`run_watched` for a call that fills a database, which ``watch`` may count.

    The connection is opened before the call begins, because opening one writes.
    """
    with opened(database_path) as database:
        return run_watched(call, lambda: watch(database))

"""What the command line prints of an error that no module foresaw."""

import errno
import platform
import sys
import tempfile
import traceback
from collections.abc import Iterator
from pathlib import Path

_MEMORY_WORDS = (
    "bad_alloc",
    "cannot allocate memory",
    "failed to allocate",
    "failed to map segment",
    "insufficient memory",
    "can't start new thread",
    "out of memory",
    "unable to allocate",
)
"""Of C++, of the loader of libraries, of OpenCV and of threads."""


def is_out_of_memory(error: BaseException) -> bool:
    """Whether an error, or one that it came from, is a lack of memory."""
    return any(_of_memory(one) for one in _chain(error))


def _of_memory(error: BaseException) -> bool:
    if isinstance(error, MemoryError):
        return True
    if isinstance(error, OSError) and error.errno == errno.ENOMEM:
        return True
    text = str(error).lower()
    return any(words in text for words in _MEMORY_WORDS)


def _chain(error: BaseException | None) -> Iterator[BaseException]:
    seen: set[int] = set()
    while error is not None and id(error) not in seen:
        seen.add(id(error))
        yield error
        error = error.__cause__ or error.__context__


def unexpected(error: BaseException, version: str) -> str:
    """One sentence on an error that is a fault of uwsfm, with a log for its report.

    Args:
        error: as caught, with its traceback.
        version: of uwsfm.
    """
    what = f"{type(error).__name__}: {error}".partition("\n")[0].rstrip(": ")[:160]
    log = _log(error, version)
    kept = f", with {log}" if log is not None else ", with the output of uwsfm --debug"
    return f"unexpected fault of uwsfm ({what}); please report it to its authors{kept}"


def _log(error: BaseException, version: str) -> Path | None:
    """The traceback in a file; None if there is no place for it."""
    lines = [
        f"uwsfm {version}, Python {platform.python_version()}, {platform.platform()}\n",
        f"command: {' '.join(sys.argv)}\n",
        *traceback.format_exception(error),
    ]
    try:
        with tempfile.NamedTemporaryFile(
            "w",
            prefix="uwsfm-fault-",
            suffix=".log",
            delete=False,
            encoding="utf-8",
            errors="replace",
        ) as file:
            file.writelines(lines)
    except OSError:
        return None
    return Path(file.name)

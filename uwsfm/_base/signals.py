"""SIGTERM ends a command as Ctrl-C does, but for the exit code: in one sentence.

It may take its time: what runs in threads of pycolmap is left between two images. Then
a sentence says so.
"""

import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

EXIT_CODE = 128 + signal.SIGTERM

RESUMES = "the same command resumes the run"
BEGINS_AGAIN = "the same command begins again"
NOTHING_WRITTEN = "nothing was written"
STOPPING = "stopping; the work under way may take some seconds to end"
PATIENCE_SECONDS = 0.5


class Terminated(KeyboardInterrupt):
    """The process was asked to end."""


received = threading.Event()
"""SIGTERM was."""
_stopping = threading.Event()
_told = threading.Event()


def raise_on_signals() -> None:
    """Turn SIGTERM and Ctrl-C into exceptions of the main thread."""
    import numpy  # noqa: F401  before pycolmap, see uwsfm._base.load_order
    import pycolmap  # noqa: F401  whose handler, glog's, would print the stack

    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGTERM, _terminate)
        if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
            signal.signal(signal.SIGINT, _interrupt)  # else a shell has it ignored
        # Not by a handler, which may come while the locks of `threading` are held.
        if _watch.ident is None:
            _watch.start()


def _interrupt(number: int, frame: FrameType | None) -> None:
    signal.signal(number, signal.default_int_handler)
    _stopping.set()
    raise KeyboardInterrupt


def _terminate(number: int, frame: FrameType | None) -> None:
    # `timeout` sends it twice: the second must not end what the first began.
    signal.signal(number, signal.SIG_IGN)
    received.set()
    _stopping.set()
    raise Terminated


def _tell_if_slow() -> None:
    _stopping.wait()
    if not _told.wait(PATIENCE_SECONDS):
        print(STOPPING, file=sys.stderr, flush=True)


_watch = threading.Thread(target=_tell_if_slow, daemon=True)


def interruption_in(error: BaseException | None) -> KeyboardInterrupt | None:
    """The interruption that an error is or hides.

    A signal that comes in native code is raised there: numba and pybind11 make another
    error of it, with it as the cause.
    """
    while error is not None and not isinstance(error, KeyboardInterrupt):
        error = error.__cause__ or error.__context__
    return error


def tell_interrupted(left: str) -> None:
    """The sentence: what an interrupted command leaves."""
    _told.set()
    print(f"interrupted; {left}", file=sys.stderr)


@contextmanager
def interruptible() -> Iterator[None]:
    """Around a command that writes all at its end or nothing; a decorator as well."""
    raise_on_signals()
    try:
        yield
    except BaseException as error:
        interruption = interruption_in(error)
        if interruption is None:
            raise
        tell_interrupted(NOTHING_WRITTEN)
        raise interruption from None

"""SIGTERM ends a command as Ctrl-C does, but for the exit code: in one sentence."""

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


class Terminated(KeyboardInterrupt):
    """The process was asked to end."""


received = threading.Event()


def raise_on_sigterm() -> None:
    """Turn SIGTERM into an exception of the main thread."""
    import numpy  # noqa: F401  before pycolmap, see uwsfm._load_order
    import pycolmap  # noqa: F401  whose handler, glog's, would print the stack

    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGTERM, _terminate)


def _terminate(number: int, frame: FrameType | None) -> None:
    # `timeout` sends it twice: the second must not end what the first began.
    signal.signal(number, signal.SIG_IGN)
    received.set()
    raise Terminated


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
    print(f"interrupted; {left}", file=sys.stderr)


@contextmanager
def interruptible() -> Iterator[None]:
    """Around a command that writes all at its end or nothing; a decorator as well."""
    raise_on_sigterm()
    try:
        yield
    except BaseException as error:
        interruption = interruption_in(error)
        if interruption is None:
            raise
        tell_interrupted(NOTHING_WRITTEN)
        raise interruption from None

"""SIGTERM ends a run as Ctrl-C does, but for the exit code."""

import signal
import threading
from types import FrameType

EXIT_CODE = 128 + signal.SIGTERM


class Terminated(KeyboardInterrupt):
    """The process was asked to end."""


received = threading.Event()


def raise_on_sigterm() -> None:
    """Turn SIGTERM into an exception of the main thread.

    To be called after pycolmap was imported: that installs a handler of glog's, which
    prints the stack of the process.
    """
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGTERM, _terminate)


def _terminate(number: int, frame: FrameType | None) -> None:
    # `timeout` sends it twice: the second must not end what the first began.
    signal.signal(number, signal.SIG_IGN)
    received.set()
    raise Terminated

"""The log beside a result: what was run, how long each step took, what went wrong.

The lines are those of the logger `uwsfm` from INFO on, whatever the program shows of
them; a later run in the same folder adds its own.
"""

from __future__ import annotations

import logging
import os
import platform
import time
import traceback
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from uwsfm._base.progress import Progress, silent
from uwsfm._base.progress_display import notebook_display
from uwsfm._base.signals import interruption_in
from uwsfm.errors import InputError
from uwsfm.results.summary import versions

LOG = "uwsfm.log"
FORMAT = "%(asctime)s %(levelname)s %(message)s"

logger = logging.getLogger("uwsfm")


class JobLog:
    """A job that is being logged.

    Args:
        progress: called with each long step, too.
    """

    def __init__(self, progress: Progress) -> None:
        self._progress = progress
        self._step: str | None = None
        self._began = 0.0
        self._done = 0
        self._total: int | None = None

    def progress(self, step: str, done: int, total: int | None) -> None:
        """`uwsfm._base.progress.Progress`: the beginning and the end of each step."""
        if step != self._step:
            self.end_step()
            self._step, self._began = step, time.monotonic()
            logger.info("%s", step)
        self._done, self._total = done, total
        self._progress(step, done, total)

    def end_step(self) -> None:
        """The last step is over."""
        if self._step is not None:
            count = "" if self._total is None else f"{self._done} of {self._total}, "
            seconds = time.monotonic() - self._began
            logger.info("%s: %s%.1f s", self._step, count, seconds)
            self._step = None

    def result(self, summary: Mapping[str, Any]) -> None:
        """Verdict, reasons and notes of a summary."""
        self.end_step()
        if "verdict" in summary:
            logger.info("verdict: %s", summary["verdict"])
        for reason in summary.get("reasons", ()):
            logger.info("%s: %s", reason["severity"], reason["text"])
        for one in summary.get("explanations", ()):
            logger.info("cause: %s", one["text"])
        for warning in summary.get("warnings", ()):
            logger.info("note: %s", warning)
        logger.info("done")


@contextmanager
def job_log(
    out: Path, command: str | None, asked: Mapping[str, Any], progress: Progress
) -> Iterator[JobLog]:
    """Log a job to ``out/uwsfm.log``; in a notebook, show its progress as well.

    Args:
        out: folder of the results.
        command: that makes the result again, or what is done; None: no command does.
        asked: the arguments, by name.
        progress: called with each long step; `silent`: the caller shows none.

    Raises:
        InputError: the log cannot be written.
    """
    with log_file(out / LOG), notebook_display() as display:
        shown = progress if progress is not silent or display is None else display
        found = versions()
        logger.info("uwsfm %s: %s", found["uwsfm"], command or "called from Python")
        logger.info("options: %s", ", ".join(_words(asked)))
        logger.info("versions: %s", ", ".join(f"{k} {v}" for k, v in found.items()))
        logger.info(
            "machine: %s, %s cores, working folder %s",
            platform.platform(),
            os.cpu_count(),
            os.getcwd(),
        )
        log = JobLog(shown)
        try:
            yield log
        finally:
            log.end_step()


def _words(asked: Mapping[str, Any]) -> Iterator[str]:
    for name, value in asked.items():
        if isinstance(value, Mapping):
            yield from _words(value)
        elif name != "progress":
            plain = isinstance(value, (str, Path, int, float, tuple, list, type(None)))
            yield f"{name}={value if plain else type(value).__name__}"


@contextmanager
def log_file(path: Path) -> Iterator[None]:
    """Append what uwsfm logs in this process to a file; within itself, do nothing.

    Handlers above get what they would have got. What ends the block by an exception is
    logged to the file alone, for the caller gets the exception.

    Raises:
        InputError: the file cannot be written.
    """
    if any(
        getattr(h, "baseFilename", "") == str(path.absolute()) for h in logger.handlers
    ):
        yield
        return
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        file = _File(path, encoding="utf-8")
    except OSError as error:
        raise InputError(f"cannot write {path}: {error.strerror}") from None
    file.setFormatter(logging.Formatter(FORMAT))
    above = _Above(logger.getEffectiveLevel())
    level, propagate = logger.level, logger.propagate
    logger.addHandler(file)
    if propagate:
        logger.addHandler(above)
    logger.setLevel(min(logging.INFO, logger.getEffectiveLevel()))
    logger.propagate = False
    try:
        yield
    except BaseException as error:
        _log_failure(file, error)
        raise
    finally:
        logger.removeHandler(file)
        logger.removeHandler(above)
        logger.setLevel(level)
        logger.propagate = propagate
        with suppress(OSError):  # of a full disk: what is logged is the lesser loss
            file.close()


class _File(logging.FileHandler):
    """A log on a disk that may be full."""

    def handleError(self, record: logging.LogRecord) -> None:
        """Nothing: a traceback of the logger would hide the error of the job."""


class _Above(logging.Handler):
    """Passes on what the level of the logger let pass before."""

    def emit(self, record: logging.LogRecord) -> None:
        if logger.parent is not None and logger.parent.hasHandlers():
            logger.parent.callHandlers(record)


def _log_failure(file: logging.Handler, error: BaseException) -> None:
    """An interruption, a mistake of the user's in a sentence, or a traceback."""
    interruption = interruption_in(error)
    if interruption is not None:
        lines = ["interrupted"]
    elif isinstance(error, InputError):
        lines = [f"failed: {error}"]
    else:
        trace = "".join(traceback.format_exception(error)).rstrip()
        lines = [trace, f"failed: {str(error) or type(error).__name__}"]
    for line in lines:
        file.handle(
            logger.makeRecord(logger.name, logging.ERROR, "", 0, line, (), None)
        )

"""What the command line writes to: progress bars, and the verdict."""

from __future__ import annotations

import os
import sys
from typing import Any

from rich.console import Console
from rich.padding import Padding
from rich.text import Text

from uwsfm._base.progress import Progress
from uwsfm._base.progress_display import display
from uwsfm._base.signals import (
    RESUMES,
    interruption_in,
    raise_on_signals,
    tell_interrupted,
)

WIDE = 200
"""Columns of a file or a pipe, which nobody has to read in a window: a table loses no
text in it."""


def _width() -> int | None:
    """None: that of the terminal, or of COLUMNS."""
    given = "COLUMNS" in os.environ
    return None if given or sys.stdout.isatty() else WIDE


console = Console(width=_width())
errors = Console(stderr=True)


class ProgressBars:
    """Shows the progress of a command on standard error.

    A signal is an exception from its start on: what takes long to import comes after.

    Args:
        left: the sentence that an interruption ends with.
    """

    def __init__(self, left: str = RESUMES) -> None:
        self._left = left
        self._display = display(errors)

    def __enter__(self) -> Progress:
        raise_on_signals()
        return self._display

    def __exit__(self, _: object, failure: BaseException | None, *__: object) -> None:
        self._display.close(complete=failure is None)
        interruption = interruption_in(failure)
        if interruption is not None:
            tell_interrupted(self._left)
            raise interruption from None


NO_CAUSE = "none of the mistakes that were tried explains the images better"
STYLES = {"fits": "bold green", "doubtful": "bold yellow", "does not fit": "bold red"}


def print_verdict(summary: dict[str, Any]) -> None:
    """The verdict, and a line for each of its reasons."""
    from uwsfm.results.verdict_summary import verdict_line

    style = STYLES.get(summary.get("verdict", ""), "")
    console.print(Text(verdict_line(summary), style=style))
    for reason in summary.get("reasons", ()):
        line = Text(f"{reason['severity']}: {reason['text']}")
        console.print(Padding(line, (0, 0, 0, 2)))
    causes = summary.get("explanations")
    for one in causes or ():
        console.print(Padding(Text(f"cause: {one['text']}"), (0, 0, 0, 2)))
    if causes is not None and not causes and summary["reasons"]:
        console.print(Padding(Text(f"cause: {NO_CAUSE}"), (0, 0, 0, 2)))

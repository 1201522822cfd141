"""What the command line writes to: progress bars, and the verdict."""

from __future__ import annotations

import os
import sys
from typing import Any

from rich.console import Console
from rich.padding import Padding
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    SpinnerColumn,
    TaskID,
    TextColumn,
    TimeElapsedColumn,
)
from rich.text import Text

from uwsfm._signals import (
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
    """Draws `uwsfm._progress.Progress` reports, one bar per step.

    A signal is an exception from its start on: what takes long to import comes after.

    Args:
        left: what is told if the command is interrupted.
    """

    def __init__(self, left: str = RESUMES) -> None:
        self._left = left
        self._progress = Progress(
            SpinnerColumn(finished_text="[green]✓"),
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TimeElapsedColumn(),
            console=errors,
        )
        self._tasks: dict[str, TaskID] = {}

    def __enter__(self) -> ProgressBars:
        raise_on_signals()
        return self

    def __exit__(self, _: object, failure: BaseException | None, *__: object) -> None:
        if failure is None:
            self._finish_others("")
        if self._tasks:  # else a blank line would be drawn
            self._progress.stop()
        interruption = interruption_in(failure)
        if interruption is not None:
            tell_interrupted(self._left)
            raise interruption from None

    def __call__(self, step: str, done: int, total: int | None) -> None:
        if not self._tasks:
            self._progress.start()  # not before: an early error stands alone
        if step not in self._tasks:
            self._finish_others(step)
            self._tasks[step] = self._progress.add_task(step, total=total)
        self._progress.update(self._tasks[step], completed=done, total=total)

    def _finish_others(self, step: str) -> None:
        """Steps run one after the other: a new one means that the last one is done."""
        for name, task in self._tasks.items():
            if name != step:
                done = max(self._progress.tasks[task].completed, 1)
                self._progress.update(task, completed=done, total=done)


STYLES = {"fits": "bold green", "doubtful": "bold yellow", "does not fit": "bold red"}


def print_verdict(summary: dict[str, Any]) -> None:
    """The verdict, and a line for each of its reasons."""
    from uwsfm.export.verdict_summary import verdict_line

    style = STYLES.get(summary.get("verdict", ""), "")
    console.print(Text(verdict_line(summary), style=style))
    for reason in summary.get("reasons", ()):
        line = Text(f"{reason['severity']}: {reason['text']}")
        console.print(Padding(line, (0, 0, 0, 2)))
    for one in summary.get("explanations", ()):
        console.print(Padding(Text(f"cause: {one['text']}"), (0, 0, 0, 2)))

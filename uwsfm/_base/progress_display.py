"""How progress is drawn: bars on a terminal and in notebooks, plain lines elsewhere."""

from __future__ import annotations

import importlib.util
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TextIO

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    SpinnerColumn,
    TaskID,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.progress import (
    Progress as RichProgress,
)

LINE_SECONDS = 3.0
"""Between two plain lines, at least: a log file of an hour stays readable."""
HEARTBEAT_SECONDS = 60.0
"""After which a step that reports nothing shows that it still runs."""
_MIN_ELAPSED_SECONDS = 1.0
"""Before which nothing is predicted."""


class Bars:
    """One bar per step, by rich.

    Args:
        console: where they are drawn.
    """

    def __init__(self, console: Console) -> None:
        self._progress = RichProgress(
            SpinnerColumn(finished_text="[green]✓"),
            TextColumn("{task.description}"),
            BarColumn(bar_width=24),
            MofNCompleteColumn(),
            TimeElapsedColumn(),
            TimeRemainingColumn(),
            console=console,
        )
        self._tasks: dict[str, TaskID] = {}

    def __call__(self, step: str, done: int, total: int | None) -> None:
        if not self._tasks:
            self._progress.start()  # not before: an early error stands alone
        if step not in self._tasks:
            self._finish_others(step)
            self._tasks[step] = self._progress.add_task(step, total=total)
        self._progress.update(self._tasks[step], completed=done, total=total)

    def close(self, *, complete: bool) -> None:
        """Stop drawing; ``complete``: the last step has ended well."""
        if complete:
            self._finish_others("")
        if self._tasks:  # else a blank line would be drawn
            self._progress.stop()

    def _finish_others(self, step: str) -> None:
        """Steps run one after the other: a new one means that the last one is done."""
        for name, task in self._tasks.items():
            if name != step:
                done = max(self._progress.tasks[task].completed, 1)
                self._progress.update(task, completed=done, total=done)


@dataclass
class _State:
    """What was last reported of a step."""

    step: str
    done: int
    total: int | None
    began: float
    """Seconds, when the step was first reported."""
    done_before: int
    """What was done by then: the rest of a resumed step sets the pace."""

    def line(self, now: float) -> str:
        count = "" if self.total is None else f" {self.done}/{self.total}"
        elapsed = now - self.began
        words = [f"{self.step}{count}", _duration(elapsed)]
        new = self.done - self.done_before
        if self.total is not None and new > 0 and elapsed >= _MIN_ELAPSED_SECONDS:
            left = elapsed * (self.total - self.done) / new
            words += [f"about {_duration(left)} left"] if self.done < self.total else []
        return ", ".join(words)


class PlainLines:
    """Lines for files and pipes: step, count, time in the step and time left.

    At most one every `LINE_SECONDS`; of a step that is over sooner there is none.

    Args:
        stream: where they go, each flushed.
        clock: seconds.
    """

    def __init__(
        self, stream: TextIO, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._stream, self._clock = stream, clock
        self._state: _State | None = None
        self._shown: tuple[str, int, int | None] | None = None
        self._last, self._line = float("-inf"), ""
        self._lock = threading.Lock()
        self._closed = threading.Event()
        self._watch = threading.Thread(target=self._run, daemon=True)

    def __call__(self, step: str, done: int, total: int | None) -> None:
        with self._lock:
            now = self._clock()
            if self._state is None or self._state.step != step:
                self._state = _State(step, done, total, now, done)
            self._state.done, self._state.total = done, total
        self.tick()
        if self._watch.ident is None:
            self._watch.start()

    def tick(self) -> None:
        """Write a line if one is due."""
        with self._lock:
            if self._state is None:
                return
            now, state = self._clock(), self._state
            now_shown = (state.step, state.done, state.total)
            pause = LINE_SECONDS if now_shown != self._shown else HEARTBEAT_SECONDS
            line = state.line(now)
            if now - self._last >= pause and line != self._line:
                print(line, file=self._stream, flush=True)
                self._last, self._shown, self._line = now, now_shown, line

    def close(self, *, complete: bool) -> None:
        """Write no more lines; what became of the job is for others to say."""
        self._closed.set()

    def _run(self) -> None:
        while not self._closed.wait(LINE_SECONDS / 4):
            self.tick()


def _duration(seconds: float) -> str:
    """As "7 s", "3 min" or "2 h 05 min"."""
    if seconds < 99.5:
        return f"{seconds:.0f} s"
    minutes = round(seconds / 60)
    return (
        f"{minutes} min"
        if minutes < 100
        else f"{minutes // 60} h {minutes % 60:02d} min"
    )


def display(console: Console) -> Bars | PlainLines:
    """What suits where ``console`` writes."""
    widgets = importlib.util.find_spec("ipywidgets") is not None
    if console.is_terminal or (console.is_jupyter and widgets):
        return Bars(console)
    return PlainLines(sys.stderr)


@contextmanager
def notebook_display() -> Iterator[Bars | PlainLines | None]:
    """Bars below the cell of a notebook that runs this; None: there is no notebook."""
    console = Console(stderr=True) if "IPython" in sys.modules else None
    if console is None or not console.is_jupyter:
        yield None
        return
    shown = display(console)
    complete = False
    try:
        yield shown
        complete = True
    finally:
        shown.close(complete=complete)

"""How long steps report: a plain callback, drawn by the command line only."""

from collections.abc import Callable

Progress = Callable[[str, int, int | None], None]
"""Called as ``progress(step, done, total)``; ``total`` is None while unknown."""


def silent(step: str, done: int, total: int | None) -> None:
    """Report nothing: the default in library calls."""

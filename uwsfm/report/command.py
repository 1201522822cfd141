"""The command that makes a result again."""

import shlex
from collections.abc import Sequence
from pathlib import Path

from uwsfm.options.jobs import JobOptions


def command_line(
    command: str, inputs: Sequence[object], out: str | Path, options: JobOptions
) -> str | None:
    """A job as the user would type it.

    Args:
        command: of ``uwsfm``.
        inputs: what it takes before its options: paths, as given.
        out: folder for the results, as given.
        options: of the job.

    Returns:
        None: the job has what no command takes: a rig that is no file, or fields of
        `CalibrateOptions` that are no options.
    """
    if options.adjustment.further:
        return None
    words = ["uwsfm", command]
    for value in inputs:
        if not isinstance(value, (str, Path)):
            return None
        words.append(str(value))
    words += ["--out", str(out)]
    for item, value in options.items():
        words += item.words(value)
    return shlex.join(words)

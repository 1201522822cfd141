"""The front end's work as tasks for workers."""

from __future__ import annotations

from pathlib import Path

from uwsfm.sfm.options import StartOptions
from uwsfm.tasks import Workers


def workers_of(options: StartOptions, work_dir: Path) -> Workers:
    """The workers that some options ask for."""
    return Workers(options.scheduler, work_dir, options.threads)

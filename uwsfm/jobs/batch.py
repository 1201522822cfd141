"""Many dives, each by itself: what stops one never stops another."""

from __future__ import annotations

import logging
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from uwsfm._base.progress import Progress, silent
from uwsfm._base.tasks import LOCAL, Workers, require_threads
from uwsfm.errors import InputError, UwsfmError
from uwsfm.jobs.checks import checked_rig
from uwsfm.jobs.dives_file import Dive, load_dives
from uwsfm.jobs.output_folder import output_folder
from uwsfm.jobs.reconstruct import reconstruct
from uwsfm.results.log import LOG, log_file
from uwsfm.sfm.frontend.images import find_frames
from uwsfm.trust.verdict import Word

logger = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """What became of a dive."""

    name: str
    reason: str | None
    """Why it failed, one sentence; None: it did not."""
    seconds: float
    num_frames: int = 0
    num_registered_frames: int = 0
    rms_px: float = float("nan")
    """True reprojection error."""
    verdict: Word | None = None
    """On the result; None: there is none."""
    cause: str | None = None
    """Why it is not "fits": the mistake that explains it, or else the first reason."""


def run_batch(
    dives: str | Path | Sequence[Dive],
    *,
    scheduler: str = LOCAL,
    num_threads: int = -1,
    progress: Progress = silent,
) -> list[Outcome]:
    """Reconstruct many dives, each in a process of its own, some at a time.

    Args:
        dives: A dives.yaml, see `uwsfm.jobs.dives_file`, or what it holds.
        scheduler: "local", or the address of a Dask scheduler.
        num_threads: Of all dives together; -1 for all cores.
        progress: Called with the step "dives".

    Returns:
        What became of each, in their order. A dive that was stopped or has failed goes
        on where it was when it is run again.

    Raises:
        InputError: the file, the scheduler or the number of threads is not usable.
    """
    require_threads(num_threads)
    if isinstance(dives, (str, Path)):
        dives = load_dives(dives)
    limit = None if num_threads < 0 else num_threads
    with Workers(scheduler, max_processes=limit) as workers:
        for folder in {dive.out.parent for dive in dives}:
            if workers.elsewhere:
                folder.mkdir(parents=True, exist_ok=True)
                workers.require_sight(folder)
        wrong: dict[int, Outcome] = {}
        if not workers.elsewhere:
            wrong = _refused(dives)
        todo = [index for index in range(len(dives)) if index not in wrong]
        threads = 1
        if todo and not workers.elsewhere:
            threads = max(1, workers.num_processes // len(todo))
        outcomes: dict[int, Outcome | UwsfmError] = {**wrong}
        if todo:
            found = workers.outcomes(
                run_dive,
                [(dives[index], threads) for index in todo],
                "dives",
                lambda step, done, _: progress(step, len(wrong) + done, len(dives)),
            )
            outcomes.update(zip(todo, found, strict=True))
    return [
        outcome
        if isinstance(outcome, Outcome)
        else Outcome(name=dive.name, reason=str(outcome), seconds=float("nan"))
        for dive, outcome in ((dive, outcomes[i]) for i, dive in enumerate(dives))
    ]


def _refused(dives: Sequence[Dive]) -> dict[int, Outcome]:
    """Dives whose rig or folders cannot be used, told before any process starts."""
    wrong = {}
    for index, dive in enumerate(dives):
        try:
            output_folder(dive.out, dive.images)
            find_frames(dive.images, checked_rig(dive.rig))
        except InputError as error:
            logger.warning("dive %s: %s", dive.name, error)
            wrong[index] = run_dive(dive, 1)
    return wrong


def run_dive(dive: Dive, num_threads: int) -> Outcome:
    """Reconstruct a dive; whatever goes wrong is its outcome, and in its log."""
    began = time.monotonic()
    try:
        out = output_folder(dive.out, dive.images)
        out.mkdir(parents=True, exist_ok=True)
        with log_file(out / LOG):
            logger.info("dive %s, images %s", dive.name, dive.images)
            options = dive.options.with_settings({"num_threads": num_threads})
            result = reconstruct(dive.rig, dive.images, out, options)
    except UwsfmError as error:
        reason = str(error)
    except MemoryError:
        reason = "out of memory"
    except Exception as error:
        reason = f"{type(error).__name__}: {error}; see {dive.out / LOG}"
    else:
        summary = result.summary
        return Outcome(
            name=dive.name,
            reason=None,
            seconds=time.monotonic() - began,
            num_frames=summary["num_frames"],
            num_registered_frames=summary["num_registered_frames"],
            rms_px=summary["reprojection_rms_px"]["after"],
            verdict=result.verdict.verdict,
            cause=cause_of(summary),
        )
    return Outcome(name=dive.name, reason=reason, seconds=time.monotonic() - began)


def cause_of(summary: Mapping[str, Any]) -> str | None:
    """What a summary names as the cause, or else the first reason of its verdict."""
    causes = [*summary["explanations"], *summary["reasons"]]
    return causes[0]["text"] if causes else None

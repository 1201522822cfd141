"""`uwsfm check --halves`: disjoint halves of a result's frames against each other."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from uwsfm._base.progress import Progress, silent
from uwsfm.calibration.enlarged import enlarged
from uwsfm.calibration.error_budget import error_budget
from uwsfm.errors import InputError
from uwsfm.jobs.judgement import housing_warnings
from uwsfm.report.files import write_report
from uwsfm.report.gather import PAGE
from uwsfm.results.calibration_file import RUN_AGAIN
from uwsfm.results.files import SUMMARY
from uwsfm.results.folder import Result, given_rig, open_result, store_judgement
from uwsfm.results.halves_summary import KEY, halves_numbers
from uwsfm.results.log import job_log
from uwsfm.results.refined import refined_summary
from uwsfm.results.summary import (
    housing_summary,
    scale_summary,
    write_json,
)
from uwsfm.results.verdict_summary import with_verdict
from uwsfm.rig.rig import Rig
from uwsfm.trust.goodness import Used
from uwsfm.trust.halves import CrossValidation, cross_validate
from uwsfm.trust.halves_reason import halves_reasons, untested_notes
from uwsfm.trust.verdict import judged, with_reasons


def check_halves(out: str | Path, progress: Progress = silent) -> dict[str, Any]:
    """Cross-validate a result of any size.

    The summary of the result receives the comparison, and standard deviations that the
    halves find too small are enlarged in its tables and notes, and in housing.yaml;
    halves that differ far are a reason of its verdict. A report is written again.

    Args:
        out: folder that `reconstruct`, `refine_model` or `run_demo` wrote.
        progress: called with the steps "adjusting halves" and "report".

    Returns:
        The comparison, as in ``summary.json`` under "cross_validation".

    Raises:
        InputError: the folder is not such a one, or has too few frames.
        UwsfmError: no halves could be adjusted.
    """
    result = open_result(out)
    if "goodness" not in result.summary:
        raise InputError(
            f"{result.folder / SUMMARY} has no verdict: an earlier version of uwsfm "
            f"made this result; {RUN_AGAIN}"
        )
    given = given_rig(result.folder)
    with job_log(result.folder, f"uwsfm check {out} --halves", {}, progress) as log:
        log.progress("adjusting halves", 0, None)
        found = cross_validate(given, result.solved)
        summary = cross_validated(result, given, found)
        larger = enlarged(result.solved, found.enlarged)
        store_judgement(result, larger, summary["verdict"])
        write_json(summary, result.folder / SUMMARY)
        if (result.folder / PAGE).is_file():
            log.progress("report", 0, None)
            write_report(result.folder)
        log.result(summary)
    numbers: dict[str, Any] = summary[KEY]
    return numbers


def cross_validated(
    result: Result, given: Rig, found: CrossValidation
) -> dict[str, Any]:
    """The summary of a result with a cross-validation, in the place of an earlier one.

    Args:
        result: as it is stored.
        given: its rig as it was given.
        found: of its frames.
    """
    rig, summary = result.model.rig, result.summary
    now, budget = enlarged(result.solved, found.enlarged), error_budget(result.solved)
    used = Used(**summary["goodness"]["used"])
    verdict = with_reasons(judged(given, now, used), halves_reasons(found))
    # Notes are sentences with numbers in them: those of before go, all others stay.
    old = housing_warnings(rig, result.calibration, budget, summary["verdict"])
    old += untested_notes(result.calibration, has_model=True)
    new = housing_warnings(rig, now, budget, verdict.verdict)
    cameras = zip(housing_summary(rig, now), summary["cameras"], strict=True)
    numbers = {
        "cameras": [{**fresh, **_of_the_lens(stored)} for fresh, stored in cameras],
        "refined": refined_summary(rig, now),
        "scale": scale_summary(now),
        "warnings": [text for text in summary["warnings"] if text not in old] + new,
        KEY: halves_numbers(found),
    }
    return with_verdict(verdict, {**summary, **numbers})


def _of_the_lens(camera: Mapping[str, Any]) -> dict[str, Any]:
    """How well a lens was converted, which only its first rig file showed."""
    return {key: camera[key] for key in camera if key.startswith("lens_conversion")}

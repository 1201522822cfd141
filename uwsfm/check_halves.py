"""`uwsfm check --halves`: disjoint halves of a result's frames against each other."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from uwsfm.export.files import SUMMARY
from uwsfm.export.halves_summary import KEY, with_cross_validation
from uwsfm.export.summary import write_json
from uwsfm.report.files import write_report
from uwsfm.report.gather import PAGE
from uwsfm.result_folder import open_result
from uwsfm.trust.halves import cross_validate


def check_halves(out: str | Path) -> dict[str, Any]:
    """Cross-validate a result of any size.

    The summary of the result receives the comparison, and standard deviations that the
    halves find too small are enlarged there; a report is written again.

    Args:
        out: folder that `reconstruct`, `refine_model` or `run_demo` wrote.

    Returns:
        The comparison, as in ``summary.json`` under "cross_validation".

    Raises:
        InputError: the folder is not such a one.
        UwsfmError: there are too few frames, or no halves could be adjusted.
    """
    result = open_result(out)
    found = cross_validate(result.model.rig, result.calibration)
    summary = with_cross_validation(result.summary, found)
    write_json(summary, result.folder / SUMMARY)
    if (result.folder / PAGE).is_file():
        write_report(result.folder)
    numbers: dict[str, Any] = summary[KEY]
    return numbers

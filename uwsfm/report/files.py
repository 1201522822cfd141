"""report.html and the folder report/, as files of an output folder."""

import shutil
import time
from contextlib import suppress
from pathlib import Path
from typing import Any

from uwsfm._base.files import replaced_dir, replaced_file
from uwsfm._base.progress import Progress, silent
from uwsfm._base.signals import interruption_in
from uwsfm.calibration.result import CalibrationResult, Covariance
from uwsfm.colmap.model import Model
from uwsfm.errors import InputError
from uwsfm.report.gather import FOLDER, NUMBERS, PAGE, gather, numbers_of
from uwsfm.results.files import SUMMARY
from uwsfm.results.folder import open_result
from uwsfm.results.summary import write_json


def write_report(out: str | Path) -> Path:
    """Write the report of an output folder again.

    Args:
        out: Folder that `reconstruct`, `refine_model` or `run_demo` wrote.

    Returns:
        The page, ``out/report.html``.

    Raises:
        InputError: the folder is not such a one, or cannot be written to.
    """
    result = open_result(out)
    covariance = result.calibration.covariance
    return write_files(result.folder, result.model, covariance, result.summary)


def write_with_report(
    out: Path,
    model: Model,
    calibration: CalibrationResult,
    summary: dict[str, Any],
    progress: Progress = silent,
    *,
    wanted: bool = True,
) -> None:
    """Write summary.json and then the report, which may fail without losing a result.

    A report of an earlier run does not stay beside a result that it is not of.

    Args:
        out: The output folder; all else is there already.
        model: The result.
        calibration: Of its scene.
        summary: Gets the time that the report took, and a warning if it failed.
        progress: Called with the step "report".
        wanted: Whether to write one.
    """
    write_json(summary, out / SUMMARY)
    if not wanted:
        _remove(out)
        return
    progress("report", 0, None)
    clock = time.perf_counter()
    try:
        write_files(out, model, calibration.covariance, summary)
    except Exception as error:  # whatever it is, the result is worth more
        if interruption_in(error) is not None:
            raise
        _remove(out)
        why = f"{error}" if isinstance(error, InputError) else repr(error)
        summary["warnings"].append(f"the report could not be written: {why}")
    summary["timings_s"]["report"] = time.perf_counter() - clock
    progress("report", 1, 1)
    write_json(summary, out / SUMMARY)


def _remove(out: Path) -> None:
    with suppress(OSError):
        (out / PAGE).unlink(missing_ok=True)
    if (out / FOLDER / NUMBERS).is_file():
        shutil.rmtree(out / FOLDER, ignore_errors=True)


def write_files(
    out: str | Path, model: Model, covariance: Covariance, summary: dict[str, Any]
) -> Path:
    """Write ``report.html`` and ``report/`` of a result; each replaced as a whole.

    Args:
        out: The output folder.
        model: The result.
        covariance: Of its scene.
        summary: What its summary.json holds.

    Returns:
        The page.

    Raises:
        InputError: the place is taken by what uwsfm did not write, or cannot be
            written to.
    """
    from uwsfm.report.page import page_of
    from uwsfm.report.pictures import draw_pictures

    out = Path(out)
    folder, page = out / FOLDER, out / PAGE
    if folder.exists() and not (folder / NUMBERS).is_file():
        raise InputError(f"{folder} exists and was not made by uwsfm: move it away")
    report = gather(model, covariance, summary, out)
    with replaced_file(page) as partial, replaced_dir(folder) as drawn:
        partial.write_text(page_of(report), encoding="utf-8")
        write_json(numbers_of(report), drawn / NUMBERS)
        draw_pictures(report, drawn)
    return page

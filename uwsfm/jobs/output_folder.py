"""The output folder of a run: never over what others made, one run at a time."""

import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path

from filelock import FileLock, Timeout

from uwsfm._base.checksums import SUMS
from uwsfm._base.disk import explained
from uwsfm._base.partial import remove_stale
from uwsfm.errors import InputError, UwsfmError
from uwsfm.options.file import OPTIONS
from uwsfm.report.files import FOLDER, PAGE
from uwsfm.results.calibration_file import CALIBRATION
from uwsfm.results.files import (
    HOUSING,
    HOUSING_SUMMARY,
    POINTS,
    RIG_GIVEN,
    SPARSE,
    SUMMARY,
    WORK,
    read_summary,
)
from uwsfm.results.folder import read_told
from uwsfm.results.log import LOG
from uwsfm.sfm.steps import FILE_NAME as STEPS_FILE

LOCK = "lock"
RESULTS = (
    SPARSE,
    HOUSING,
    RIG_GIVEN,
    OPTIONS,
    POINTS,
    CALIBRATION,
    SUMS,
    SUMMARY,
    PAGE,
    FOLDER,
)
"""What a run writes."""


def made_of_files(rig: object, source: str | Path) -> dict[str, str | None]:
    """What a result is made of: a run into its folder is the same job again only if it
    is made of the same.

    Args:
        rig: path of the rig file; of a rig in memory nothing is known.
        source: folder of the images, or of the model.
    """
    known = isinstance(rig, (str, Path))
    return {
        "rig": os.path.realpath(str(rig)) if known else None,
        "source": os.path.realpath(source),
    }


def require_elsewhere(out: str | Path, source: str | Path) -> None:
    """Refuse to write results among the files that they are made of.

    Raises:
        InputError: ``out`` is the folder ``source``.
    """
    if os.path.realpath(out) == os.path.realpath(source):
        raise InputError(
            f"{out} is the folder of the model itself: choose another for results"
        )


def output_folder(
    out: str | Path,
    images: str | Path | None = None,
    made_of: Mapping[str, str | None] | None = None,
) -> Path:
    """Refuse what would overwrite another dive's result, or files that are not ours, or
    mix with the images.

    Args:
        out: the folder.
        images: of the run.
        made_of: of the run, see `made_of_files`.

    Raises:
        InputError: a file, the folder of the images, or one with other results.
    """
    out = Path(out)
    if images is not None and os.path.realpath(out) == os.path.realpath(images):
        raise InputError(
            f"{out} is the folder of the images: choose another for results"
        )
    if out.exists() and not out.is_dir():
        raise InputError(f"{out} is a file, not a folder for results")
    if _made_by_us(out):
        _require_same_job(out, made_of or {})
        return out
    for name in (*RESULTS, WORK):
        if (out / name).exists():
            raise InputError(
                f"{out / name} exists and was not made by uwsfm: choose another folder"
            )
    return out


def _require_same_job(out: Path, made_of: Mapping[str, str | None]) -> None:
    """Refuse to write over a finished result that is made of something else."""
    for name in (SUMMARY, HOUSING_SUMMARY):
        before = read_told(out / name).get("made_of") or {}
        for key, value in made_of.items():
            other = before.get(key)
            if None not in (value, other) and value != other:
                raise InputError(
                    f"{out} holds the result of another job, made of {other} and not "
                    f"of {value}: choose another folder (with a copy of {WORK} from "
                    "here, features and matches are not made again), or delete this "
                    "one first"
                )


def _made_by_us(out: Path) -> bool:
    """Whether an earlier run, finished or not, left its marks in a folder."""
    if (out / WORK / STEPS_FILE).exists() or (out / WORK / LOCK).exists():
        return True
    try:
        versions = (read_summary(out) or {}).get("versions")
    except InputError:
        return False
    return isinstance(versions, dict) and "uwsfm" in versions


@contextmanager
def locked(out: Path) -> Iterator[None]:
    """Keep a second run out of the folder: both would write the same database.

    What killed runs left half-written there is removed, and a full disk is explained.

    The folders that a run made only to lock them go when it ends with nothing in them
    but its log, unless that holds the traceback of an error that no sentence explains.
    """
    work = out / WORK
    made = [folder for folder in (work, *work.parents) if not folder.exists()]
    logged_before, told = (out / LOG).exists(), True
    try:
        work.mkdir(parents=True, exist_ok=True)
        lock = FileLock(work / LOCK)
        lock.acquire(timeout=0)
    except Timeout:
        raise InputError(f"another uwsfm is at work in {out}") from None
    except OSError as error:
        raise InputError(f"cannot write to {out}: {error.strerror}") from None
    remove_stale(out, deep=True)
    try:
        with explained(out):
            yield
    except Exception as error:
        told = isinstance(error, UwsfmError)
        raise
    finally:
        # Beside results the lock is the mark that they are ours.
        bare = made and not any((out / name).exists() for name in RESULTS)
        bare = bare and told and list(work.glob("*")) == [work / LOCK]
        if bare:
            if not logged_before:
                (out / LOG).unlink(missing_ok=True)
            with suppress(OSError):  # Windows: the release removes it
                (work / LOCK).unlink()
        lock.release()
        if bare:
            with suppress(OSError):  # up to the first that holds something else
                for folder in made:
                    folder.rmdir()

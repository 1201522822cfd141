"""The folder that `uwsfm reconstruct`, `refine` and `demo` leave, read again."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from uwsfm._base.checksums import write_checksums
from uwsfm._base.files import read_json
from uwsfm.calibration.enlarged import enlarged
from uwsfm.calibration.result import CalibrationResult
from uwsfm.colmap.model import Model
from uwsfm.errors import InputError
from uwsfm.results.calibration_file import (
    CALIBRATION,
    RUN_AGAIN,
    fingerprint,
    read_calibration,
    write_calibration,
)
from uwsfm.results.files import (
    HOUSING,
    HOUSING_SUMMARY,
    MAX_SUMMARY,
    RIG_GIVEN,
    SPARSE,
    SUMMARY,
    read_model,
    read_summary,
)
from uwsfm.results.halves_summary import KEY
from uwsfm.results.housing import export_housing
from uwsfm.results.summary import write_json
from uwsfm.rig.file import load_rig
from uwsfm.rig.rig import Rig

DENSE_CLOUD = "dense/cloud.ply"
"""Where `uwsfm dense` leaves its cloud."""
MAP, MESH, WATER = "map.json", "mesh.json", "water.json"
"""What `uwsfm map`, `mesh` and `color` tell of the files they write beside it."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Result:
    """A reconstruction and all that is known of it."""

    folder: Path
    model: Model
    calibration: CalibrationResult
    """Of ``model.scene``: every observation there is an inlier. Its deviations are
    those of the summary, enlarged where halves of the frames differ."""
    solved: CalibrationResult
    """The same, before anything was enlarged."""
    summary: dict[str, Any]
    """summary.json"""
    images: Path | None
    """Folder that holds one folder of images per camera; None if it is not known, or
    no longer there."""
    fingerprint: str
    """Of the model and the housing: what is made of them later names it."""

    @property
    def unit(self) -> str:
        """Of all lengths: "metre" or "scale arbitrary"."""
        arbitrary = self.calibration.covariance.scale_stddev is None
        return "scale arbitrary" if arbitrary else "metre"

    def require_images(self) -> Path:
        """The folder of the images.

        Raises:
            InputError: it is not known; says what to do.
        """
        if self.images is not None:
            return self.images
        recorded = self.summary.get("images")
        where = "it is not known where" if recorded is None else f"not at {recorded}"
        raise InputError(
            f"the images of {self.folder} are missing ({where}): say with --images "
            "where they are"
        )


def open_result(out: str | Path, images: str | Path | None = None) -> Result:
    """Read an output folder, covariances included.

    Args:
        out: folder that `reconstruct`, `refine_model` or `run_demo` wrote.
        images: where the images are now; default: where they were.

    Raises:
        InputError: one sentence, if the folder is not such a one, a file is missing or
            damaged, the files are of different runs, or ``images`` lacks an image.
    """
    folder = Path(out)
    if (folder / HOUSING_SUMMARY).is_file() and not (folder / SPARSE).is_dir():
        raise InputError(
            f"{folder} is a result of uwsfm calibrate, which names the cause of a "
            "misfit itself and keeps no model: give the output of uwsfm reconstruct or "
            "refine"
        )
    model = read_model(folder)
    summary = read_summary(folder)
    if summary is None:
        raise InputError(
            f"{folder / SUMMARY} is missing: the run has not finished; {RUN_AGAIN}"
        )
    mark = fingerprint_of(folder)
    solved = read_calibration(folder / CALIBRATION, model.scene, mark)
    return Result(
        folder=folder,
        model=model,
        calibration=enlarged(solved, summary.get(KEY, {}).get("enlarged", {})),
        solved=solved,
        summary=summary,
        images=_image_folder(model, images, summary.get("images")),
        fingerprint=mark,
    )


def given_rig(folder: Path) -> Rig:
    """The rig as it was given for a result.

    Raises:
        InputError: the folder does not have it.
    """
    path = folder / RIG_GIVEN
    if not path.is_file():
        raise InputError(
            f"{path} is missing: the rig as given is not known; {RUN_AGAIN}"
        )
    return load_rig(path)


def find_dense_cloud(folder: Path) -> Path | None:
    """The dense cloud of a result folder; None if there is none.

    Raises:
        InputError: its summary names another model than the folder's.
    """
    cloud = folder / DENSE_CLOUD
    if not cloud.is_file():
        return None
    require_model(cloud, folder, "run uwsfm dense again")
    return cloud


def fingerprint_of(folder: Path) -> str:
    """Of the model and the housing of a result folder, as they are now.

    Raises:
        InputError: one of them is missing.
    """
    return fingerprint(folder / SPARSE, folder / HOUSING)


def told_of(path: Path) -> Mapping[str, Any]:
    """What the JSON file beside a cloud, a mesh or a map tells of it: that of the same
    name, or else the one of its folder; empty for what was put there by hand."""
    names = (path.with_suffix(".json").name, MAP, MESH, WATER, SUMMARY)
    there = [path.with_name(name) for name in names if path.with_name(name).is_file()]
    return read_told(there[0]) if there else {}


def read_told(path: Path) -> Mapping[str, Any]:
    """What a JSON file that uwsfm wrote holds; empty if it is another's, or damaged."""
    try:
        told = read_json(path, MAX_SUMMARY)
    except InputError:
        return {}
    return told if isinstance(told, dict) else {}


def require_model(path: Path, folder: Path, advice: str) -> None:
    """See to it that a file was made of the model that a result folder has now.

    What names no model was put there by hand, and passes.

    Args:
        path: a cloud, a mesh or a map.
        folder: of the result.
        advice: what to do if not, for the message.

    Raises:
        InputError: it names another model.
    """
    mark = told_of(path).get("model")
    if mark is not None and mark != fingerprint_of(folder):
        raise InputError(f"{path} is of another model: {advice}")


def store_calibration(calibration: CalibrationResult, out: Path) -> None:
    """Write calibration.npz beside the model and the housing that are there, and
    their checksums."""
    mark = fingerprint_of(out)
    write_calibration(calibration, out / CALIBRATION, mark)
    write_checksums(out, [*(out / SPARSE).iterdir(), out / HOUSING])


def store_judgement(result: Result, shown: CalibrationResult, verdict: str) -> None:
    """Write housing.yaml anew, with another verdict and the deviations that are shown.

    What was made of the result stays its own: only what is said of it has changed.

    Args:
        result: as it is stored.
        shown: its calibration with the deviations that a person reads.
        verdict: on it.
    """
    out = result.folder
    export_housing(result.model.rig, out / HOUSING, shown, verdict=verdict)
    store_calibration(result.solved, out)
    mark = fingerprint_of(out)
    for path in out.glob("*.json"):
        told = read_told(path)
        if told.get("model") == result.fingerprint:
            write_json({**told, "model": mark}, path)


def recorded_images(images: Path | None) -> str | None:
    """What summary.json says of the images."""
    return None if images is None else str(images.absolute())


def _image_folder(
    model: Model, given: str | Path | None, recorded: object
) -> Path | None:
    if given is None:
        found = Path(recorded) if isinstance(recorded, str) else None
        return found if found is not None and found.is_dir() else None
    folder = Path(given)
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder of images")
    places = [
        (camera, frame)
        for camera in range(len(model.rig.cameras))
        for frame in range(model.scene.num_frames)
        if model.has_image(camera, frame)
    ]
    first = model.image_name(*places[0])
    if not (folder / first).is_file():
        raise InputError(f"{folder} lacks {first}, an image of the model")
    return folder

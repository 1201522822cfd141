"""calibration.npz: a `CalibrationResult` as arrays, to be had again with its model.

What is in sparse/ and housing.yaml is not repeated: the file is read with the model,
whose fingerprint it holds. Entries: ``about`` (JSON: format version, options, summary,
fingerprint), the covariances (``border``, ``border_cols``, ``frames``, ``points``,
``determined``, ``scale_stddev``), how well the given numbers are known and what their
errors add (``given.*``, ``in_all.*``), standard deviations of the cameras
(``camera_stddevs``, ``distance_at_zero``), and, where they were given, what was known
of lengths and positions (``entered.*``, ``bars.*``) and how it fits (``lengths.*``,
``positions.*``). ``frames`` is of left tangents [rotation, translation] of
rig_from_world, see `Covariance.frames`.
"""

import dataclasses
import hashlib
import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from uwsfm._base.files import replaced_file
from uwsfm._base.npz import read_npz
from uwsfm.calibration.given_accuracy import GivenAccuracy
from uwsfm.calibration.lengths import (
    Distances,
    LengthFit,
    Lengths,
    PositionFit,
    Positions,
)
from uwsfm.calibration.problem import CalibrateOptions
from uwsfm.calibration.result import (
    CalibrateSummary,
    CalibrationResult,
    CameraCovariance,
    Covariance,
    InAll,
    SolveHistory,
)
from uwsfm.errors import InputError
from uwsfm.geometry.rigid3 import Array
from uwsfm.residuals.border import BORDER_SIZE
from uwsfm.scene import Scene

CALIBRATION = "calibration.npz"
VERSION = 2
RUN_AGAIN = "run the command that made it again"

_BARS = ("points", "camera_idx", "frame_idx", "point_idx", "xy")
_T = TypeVar("_T")
_Arrays = Mapping[str, Any]


def fingerprint(sparse: Path, housing: Path) -> str:
    """SHA-256 over the files of a COLMAP model and its housing, names included.

    Raises:
        InputError: one cannot be read, or there is no such model.
    """
    digest = hashlib.sha256()
    if not sparse.is_dir():
        raise InputError(f"{sparse}: no such COLMAP model folder")
    files = sorted(path for path in sparse.iterdir() if path.is_file())
    for path in [*files, housing]:
        digest.update(path.name.encode() + b"\0")
        try:
            digest.update(hashlib.sha256(path.read_bytes()).digest())
        except OSError as error:
            raise InputError(f"{path}: cannot be read: {error.strerror}") from None
    return digest.hexdigest()


def write_calibration(calibration: CalibrationResult, path: Path, mark: str) -> None:
    """Write a calibration whose observations are all in its model.

    Args:
        calibration: of the model's scene.
        path: the file, replaced as a whole.
        mark: `fingerprint` of the model and the housing, as they are on disk.
    """
    covariance = calibration.covariance
    about = {
        "version": VERSION,
        "options": _options(calibration.options),
        "summary": dataclasses.asdict(calibration.summary),
        "fingerprint": mark,
    }
    arrays: dict[str, Any] = {
        "about": json.dumps(about),
        "border": covariance.border,
        "border_cols": covariance.border_cols,
        "frames": covariance.frames,
        "points": covariance.points,
        "determined": covariance.determined,
        "camera_stddevs": np.array([_camera_row(c) for c in covariance.cameras]),
        "distance_at_zero": np.array([c.distance_at_zero for c in covariance.cameras]),
    }
    if covariance.scale_stddev is not None:
        arrays["scale_stddev"] = covariance.scale_stddev
    arrays |= _given(calibration)
    arrays |= _fields("lengths.", calibration.lengths)
    arrays |= _fields("positions.", calibration.positions)
    entered = calibration.entered
    if entered is not None:
        arrays |= _fields("entered.between_points.", entered.between_points)
        arrays |= _fields("entered.between_frames.", entered.between_frames)
        arrays |= _fields("entered.positions.", entered.positions)
    if calibration.bars is not None:
        arrays |= {f"bars.{name}": getattr(calibration.bars, name) for name in _BARS}
    with replaced_file(path) as partial:
        np.savez(partial, allow_pickle=False, **arrays)


def read_calibration(path: Path, scene: Scene, mark: str) -> CalibrationResult:
    """Read what `write_calibration` wrote.

    Args:
        path: the file.
        scene: of the model beside it.
        mark: `fingerprint` of the model and the housing.

    Raises:
        InputError: there is no such file, it is damaged or of another version, or it
            is of another model.
    """
    if not path.is_file():
        raise InputError(
            f"{path} is missing: an earlier version of uwsfm made this result, or not "
            f"all of it was copied; {RUN_AGAIN}"
        )
    try:
        arrays = read_npz(path)
        about = json.loads(str(arrays["about"]))
        version, found = about["version"], about["fingerprint"]
    except _DAMAGE:
        raise _damaged(path) from None
    if version != VERSION:
        raise InputError(
            f"{path} has format {version}, this version of uwsfm reads {VERSION}: "
            f"{RUN_AGAIN}"
        )
    if found != mark:
        raise InputError(
            f"{path} is of another model than the one beside it: sparse/ or "
            f"housing.yaml was changed, or comes from another run; {RUN_AGAIN}"
        )
    try:
        calibration = _calibration(about, arrays, scene)
    except _DAMAGE:
        raise _damaged(path) from None
    return calibration


def _options(options: CalibrateOptions) -> dict[str, Any]:
    """What JSON can hold; the accuracy of what was given is kept as arrays."""
    return dataclasses.asdict(dataclasses.replace(options, given=None))


def _given(calibration: CalibrationResult) -> dict[str, Any]:
    """How well the given numbers are known, and deviations in all."""
    arrays: dict[str, Any] = {}
    given, in_all = calibration.options.given, calibration.covariance.in_all
    if given is not None:
        arrays["given.covariance"] = given.covariance
        arrays["given.assumed"] = given.assumed
        arrays["given.names"] = np.array(given.names)
        arrays["given.correlated_prior"] = given.correlated_prior
    if in_all is not None:
        arrays["in_all.cameras"] = np.array([_camera_row(c) for c in in_all.cameras])
        arrays["in_all.border"] = in_all.border
        arrays["in_all.given"] = in_all.given
        arrays["in_all.frames"] = in_all.frames
        if in_all.scale_stddev is not None:
            arrays["in_all.scale_stddev"] = in_all.scale_stddev
    return arrays


def _read_given(arrays: _Arrays, num_cameras: int) -> GivenAccuracy | None:
    if "given.covariance" not in arrays:
        return None
    size = num_cameras * BORDER_SIZE
    if arrays["given.covariance"].shape != (size, size):
        raise ValueError("accuracy of another rig")
    return GivenAccuracy(
        covariance=arrays["given.covariance"],
        assumed=arrays["given.assumed"],
        names=tuple(arrays["given.names"].tolist()),
        correlated_prior=bool(arrays["given.correlated_prior"]),
    )


def _in_all(arrays: _Arrays, at_zero: Array) -> InAll | None:
    if "in_all.border" not in arrays:
        return None
    scale = arrays.get("in_all.scale_stddev")
    rows = zip(arrays["in_all.cameras"], at_zero, strict=True)
    return InAll(
        cameras=tuple(_camera(row, bool(zero)) for row, zero in rows),
        border=arrays["in_all.border"],
        given=arrays["in_all.given"],
        frames=arrays["in_all.frames"],
        scale_stddev=None if scale is None else float(scale),
    )


_DAMAGE = (ValueError, LookupError, TypeError, AttributeError, RecursionError)
"""What arrays of other shapes than those written raise where they are used."""


def _damaged(path: Path) -> InputError:
    return InputError(f"{path} is damaged, or of another version of uwsfm: {RUN_AGAIN}")


def _calibration(
    about: dict[str, Any], arrays: _Arrays, scene: Scene
) -> CalibrationResult:
    num_cameras = len(scene.cameras)
    shapes = {
        "border_cols": (num_cameras, BORDER_SIZE),
        "frames": (scene.num_frames, 6, 6),
        "points": (scene.num_points, 3, 3),
        "camera_stddevs": (num_cameras, 9),
    }
    if any(arrays[name].shape != shape for name, shape in shapes.items()):
        raise ValueError("arrays of another size than the model")
    scale = arrays.get("scale_stddev")
    columns = zip(arrays["camera_stddevs"], arrays["distance_at_zero"], strict=True)
    covariance = Covariance(
        border=arrays["border"],
        border_cols=arrays["border_cols"],
        frames=arrays["frames"],
        points=arrays["points"],
        cameras=tuple(_camera(row, bool(zero)) for row, zero in columns),
        determined=bool(arrays["determined"]),
        scale_stddev=None if scale is None else float(scale),
        in_all=_in_all(arrays, arrays["distance_at_zero"]),
    )
    options = {
        name: tuple(value) if isinstance(value, list) else value
        for name, value in about["options"].items()
    }
    options["given"] = _read_given(arrays, num_cameras)
    return CalibrationResult(
        scene=scene,
        inliers=np.ones(scene.num_observations, dtype=bool),
        summary=_summary(about["summary"]),
        covariance=covariance,
        options=CalibrateOptions.parsed(options),
        lengths=_read("lengths.", LengthFit, arrays),
        positions=_read("positions.", PositionFit, arrays),
        entered=_entered(arrays),
        bars=_bars(arrays, scene),
    )


def _summary(about: dict[str, Any]) -> CalibrateSummary:
    solves = [{**solve, "costs": tuple(solve["costs"])} for solve in about["solves"]]
    return CalibrateSummary(
        **{**about, "solves": tuple(SolveHistory(**solve) for solve in solves)}
    )


def _camera_row(camera: CameraCovariance) -> list[float]:
    return [
        camera.normal_stddev_deg,
        camera.distance_stddev_m,
        camera.rotation_stddev_deg,
        *camera.translation_stddev_m,
        *camera.center_stddev_m,
    ]


def _camera(row: Array, at_zero: bool) -> CameraCovariance:
    normal, distance, rotation, x, y, z, *center = row.tolist()
    return CameraCovariance(
        normal_stddev_deg=normal,
        distance_stddev_m=distance,
        rotation_stddev_deg=rotation,
        translation_stddev_m=(x, y, z),
        center_stddev_m=(center[0], center[1], center[2]),
        distance_at_zero=at_zero,
    )


def _entered(arrays: _Arrays) -> Lengths | None:
    found = Lengths(
        between_points=_read("entered.between_points.", Distances, arrays),
        between_frames=_read("entered.between_frames.", Distances, arrays),
        positions=_read("entered.positions.", Positions, arrays),
    )
    return found if found.give_scale else None


def _bars(arrays: _Arrays, scene: Scene) -> Scene | None:
    if "bars.points" not in arrays:
        return None
    return Scene.from_arrays(
        cameras=scene.cameras,
        cam_from_rig=scene.cam_from_rig,
        rig_from_world=scene.rig_from_world,
        **{name: arrays[f"bars.{name}"] for name in _BARS},
    )


def _fields(prefix: str, values: Any) -> dict[str, Any]:
    """A dataclass of arrays and numbers, by names; nothing of None."""
    if values is None:
        return {}
    names = [field.name for field in dataclasses.fields(values)]
    return {prefix + name: getattr(values, name) for name in names}


def _read(prefix: str, kind: Callable[..., _T], arrays: _Arrays) -> _T | None:
    """A dataclass of arrays and numbers; None if it is not there."""
    found = {
        name[len(prefix) :]: value if value.ndim else value.item()
        for name, value in arrays.items()
        if name.startswith(prefix)
    }
    return kind(**found) if found else None

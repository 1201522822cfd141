"""summary.json: everything measured, each estimate with what is known of it."""

import importlib.metadata
import json
import math
import platform
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from uwsfm._base.files import replaced_file
from uwsfm.calibration.error_budget import BudgetRow
from uwsfm.calibration.length_verdicts import scale_verdict, small_unit
from uwsfm.calibration.lengths import LengthFit, PositionFit
from uwsfm.calibration.observability import (
    center_verdict,
    distance_verdict,
    normal_verdict,
)
from uwsfm.calibration.result import CalibrationResult, CameraCovariance
from uwsfm.calibration.tilt import paper_tilt, slope_stddevs_deg, turn_stddevs_deg
from uwsfm.models.ports.port import DomePort, PlanePort
from uwsfm.rig.rig import Rig, RigCamera
from uwsfm.scene import Scene

PACKAGES = (
    "uwsfm",
    "pycolmap",
    "numpy",
    "scipy",
    "numba",
    "opencv-contrib-python-headless",
)


def housing_summary(rig: Rig, calibration: CalibrationResult) -> list[dict]:
    """One entry per camera: the estimates, their standard deviations, the verdicts.

    A standard deviation is null where the value was held, or where the images do not
    determine it; the verdict shows which. Those "in all" add the errors of what was
    given, and verdicts go by them; what was held has the one it was given with.
    """
    entries = []
    covariance = calibration.covariance
    for index, camera in enumerate(rig.cameras):
        cov, in_all = covariance.cameras[index], covariance.judged_cameras[index]
        pose = calibration.scene.cam_from_rig[index]
        turned = index > 0 and calibration.options.refine_cam_from_rig
        placed = index > 0
        own, total = turn_stddevs_deg(calibration, index)
        entries.append(
            {
                "name": camera.name,
                "lens_conversion_max_px": camera.conversion_max_px,
                "lens_conversion_rms_px": camera.conversion_rms_px,
                **_port_summary(camera, calibration, index),
                "cam_from_rig": {
                    "rotation_xyzw": pose[:4].tolist(),
                    "translation_m": pose[4:].tolist(),
                    "rotation_stddev_deg": _stddev(cov.rotation_stddev_deg, turned),
                    "turn_xyz_stddev_deg": own if turned else 3 * [None],
                    "translation_stddev_m": [
                        _stddev(value, turned) for value in cov.translation_stddev_m
                    ],
                    "rotation_stddev_in_all_deg": _stddev(
                        in_all.rotation_stddev_deg, placed
                    ),
                    "turn_xyz_stddev_in_all_deg": total if placed else 3 * [None],
                    "translation_stddev_in_all_m": [
                        _stddev(value, placed) for value in in_all.translation_stddev_m
                    ],
                },
            }
        )
    return entries


def _port_summary(
    camera: RigCamera, calibration: CalibrationResult, index: int
) -> dict[str, Any]:
    """What is known of a port; what is measured has the names of the rig file."""
    port = calibration.scene.ports[index]
    stated = {"port": port.word, **port.stated()}
    if not port.refracts:
        return stated
    cov = calibration.covariance.cameras[index]
    in_all = calibration.covariance.judged_cameras[index]
    estimates: dict[str, Any] = {}
    if isinstance(port, DomePort):
        estimates = _dome_summary(camera, port, cov, in_all)
    if isinstance(port, PlanePort):
        own, total = slope_stddevs_deg(calibration, index)
        estimates = {
            **_plane_summary(camera, port, cov, in_all),
            "tilt_xy_stddev_deg": own,
            "tilt_xy_stddev_in_all_deg": total,
            **asdict(paper_tilt(calibration, index)),
        }
    return {**stated, **estimates, "water_index": port.n_water}


def _dome_summary(
    camera: RigCamera, port: DomePort, cov: CameraCovariance, in_all: CameraCovariance
) -> dict[str, Any]:
    refined = camera.refine_center
    return {
        "center_stddev_m": [_stddev(v, refined) for v in cov.center_stddev_m],
        "center_stddev_in_all_m": [_stddev(v, True) for v in in_all.center_stddev_m],
        "center_verdict": center_verdict(port.radius, in_all, refined),
    }


def _plane_summary(
    camera: RigCamera,
    port: PlanePort,
    cov: CameraCovariance,
    in_all: CameraCovariance,
) -> dict[str, Any]:
    free = not cov.distance_at_zero
    return {
        "normal_stddev_deg": _stddev(cov.normal_stddev_deg, camera.refine_normal),
        "normal_stddev_in_all_deg": _stddev(in_all.normal_stddev_deg, True),
        "normal_verdict": normal_verdict(in_all, camera.refine_normal),
        "distance_stddev_m": _stddev(
            cov.distance_stddev_m, camera.refine_distance and free
        ),
        "distance_stddev_in_all_m": _stddev(in_all.distance_stddev_m, free),
        "distance_verdict": distance_verdict(
            port.distance, in_all, camera.refine_distance
        ),
    }


def _stddev(value: float, refined: bool) -> float | None:
    return value if refined and math.isfinite(value) else None


def errors_summary(calibration: CalibrationResult) -> dict[str, Any]:
    """Counts and true reprojection errors, of the observations that were used."""
    summary = calibration.summary
    scene, _ = calibration.scene.select(calibration.inliers)
    errors = np.linalg.norm(scene.residuals(), axis=1)
    return {
        "num_registered_frames": calibration.scene.num_frames,
        "num_registered_images": _num_images(scene),
        "num_points": scene.num_points,
        "num_observations": scene.num_observations,
        "num_invalid": int(np.count_nonzero(~np.isfinite(errors))),
        "reprojection_rms_px": float(np.sqrt(np.nanmean(errors**2))),
        "reprojection_mean_px": float(np.nanmean(errors)),
        "sigma_px": summary.sigma_px,
        "solver_iterations": summary.num_iterations,
        "solver_converged": summary.converged,
        "solves": [asdict(solve) for solve in summary.solves],
        "scale": scale_summary(calibration),
    }


def _num_images(scene: Scene) -> int:
    """Images that see a point."""
    return len(np.unique(scene.camera_idx * scene.num_frames + scene.frame_idx))


def scale_summary(calibration: CalibrationResult) -> dict[str, Any]:
    """Whether the lengths of a result are metres, and how well the factor is known that
    all point-to-point distances share, see `uwsfm.calibration.scale`."""
    covariance = calibration.covariance
    stddev, in_all = covariance.scale_stddev, covariance.judged_scale_stddev
    return {
        "verdict": scale_verdict(in_all),
        "relative_stddev": _stddev(math.nan if stddev is None else stddev, True),
        "relative_stddev_in_all": _stddev(math.nan if in_all is None else in_all, True),
        "unit": "scale arbitrary" if stddev is None else "metre",
        "small_unit": small_unit(stddev),
    }


def outside_summary(
    calibration: CalibrationResult, frame_names: Sequence[str]
) -> dict[str, Any]:
    """What came of lengths and positions from outside; null if none were given."""
    return {
        "known_lengths": _lengths_summary(calibration.lengths),
        "positions": _positions_summary(calibration.positions, frame_names),
    }


def _lengths_summary(fit: LengthFit | None) -> list[dict[str, float]] | None:
    if fit is None:
        return None
    columns = zip(fit.given_m, fit.stddevs_m, fit.found_m, strict=True)
    return [
        {"given_m": float(given), "stddev_m": float(stddev), "found_m": float(found)}
        for given, stddev, found in columns
    ]


def _positions_summary(
    fit: PositionFit | None, frame_names: Sequence[str]
) -> dict[str, Any] | None:
    if fit is None:
        return None
    miss = np.linalg.norm(fit.misses_m, axis=1)
    turn, axis = fit.turn
    place = np.sqrt(np.diag(fit.covariance)[3:]).tolist()
    return {
        "num_positions": len(fit.inliers),
        "outliers": [frame_names[f] for f in fit.frame_idx[~fit.inliers]],
        "rms_miss_m": float(np.sqrt(np.mean(miss[fit.inliers] ** 2))),
        "scatter": fit.scatter,
        "place_stddev_m": [
            value if known else None
            for value, known in zip(place, fit.measured, strict=True)
        ],
        "turn_stddev_deg": math.degrees(turn),
        "turn_axis": axis.tolist(),
    }


def budget_summary(
    rows: Sequence[BudgetRow], scale_stddev: float | None
) -> list[dict[str, Any]]:
    """What one standard deviation of each given number would do, the largest first and
    all together last; null if that is not determined.

    Args:
        rows: of `uwsfm.calibration.error_budget`.
        scale_stddev: of the same result's covariance; None: its scale is arbitrary,
            and lengths without a unit have no error.
    """
    return [
        {
            "if": row.name,
            "amount": row.amount,
            "deviation": _source(row),
            "scale": _stddev(row.scale, scale_stddev is not None),
            "cameras": [
                {
                    "tilt_deg": _stddev(shift.tilt_deg, True),
                    "distance_m": _stddev(shift.distance_m, True),
                    "center_m": [_stddev(value, True) for value in shift.center_m],
                    "rotation_deg": _stddev(shift.rotation_deg, True),
                    "lens": [_stddev(value, True) for value in shift.lens],
                }
                for shift in row.shifts
            ],
        }
        for row in rows
    ]


def _source(row: BudgetRow) -> str | None:
    """Where the standard deviation of a row comes from; null in the last."""
    if not row.amount:
        return None
    return "prior" if row.prior else "assumed" if row.assumed else "given"


def versions() -> dict[str, str]:
    """Of the program, of Python, and of the packages that shape the result."""
    found = {name: importlib.metadata.version(name) for name in PACKAGES}
    return {"python": platform.python_version(), **found}


def write_json(data: dict[str, Any], path: str | Path) -> None:
    """Write strict JSON (no NaN), replacing the file as a whole."""
    text = json.dumps(data, indent=2, allow_nan=False)
    with replaced_file(Path(path)) as partial:
        partial.write_text(text + "\n", encoding="utf-8")

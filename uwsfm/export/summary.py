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

from uwsfm._files import replaced_file
from uwsfm.calibration.error_budget import BudgetRow
from uwsfm.calibration.length_verdicts import scale_verdict, small_unit
from uwsfm.calibration.lengths import LengthFit, PositionFit
from uwsfm.calibration.observability import (
    center_verdict,
    distance_verdict,
    normal_verdict,
)
from uwsfm.calibration.problem import CalibrationResult, CameraCovariance
from uwsfm.models.lens import param_slots
from uwsfm.models.port import DomePort, NoPort, Port
from uwsfm.residuals import border
from uwsfm.rig import Rig, RigCamera
from uwsfm.solver.layout import HELD

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
    determine it; the verdict tells which.
    """
    entries = []
    for index, camera in enumerate(rig.cameras):
        cov = calibration.covariance.cameras[index]
        pose = calibration.scene.cam_from_rig[index]
        turned = index > 0 and calibration.options.refine_cam_from_rig
        entries.append(
            {
                "name": camera.name,
                "lens_conversion_max_px": camera.conversion_max_px,
                "lens_conversion_rms_px": camera.conversion_rms_px,
                **_port_summary(camera, calibration.scene.ports[index], cov),
                "cam_from_rig": {
                    "rotation_xyzw": pose[:4].tolist(),
                    "translation_m": pose[4:].tolist(),
                    "rotation_stddev_deg": _stddev(cov.rotation_stddev_deg, turned),
                    "translation_stddev_m": [
                        _stddev(value, turned) for value in cov.translation_stddev_m
                    ],
                },
            }
        )
    return entries


def _port_summary(
    camera: RigCamera, port: Port, cov: CameraCovariance
) -> dict[str, Any]:
    """What is known of a port; what is measured has the names of the rig file."""
    if isinstance(port, NoPort):
        return {"port": "none"}
    if isinstance(port, DomePort):
        place: dict[str, Any] = {
            "port": "dome",
            "center_m": list(port.center),
            "center_stddev_m": [
                _stddev(value, camera.refine_center) for value in cov.center_stddev_m
            ],
            "center_verdict": center_verdict(port.radius, cov, camera.refine_center),
            "radius_m": port.radius,
        }
    else:
        at_zero = cov.distance_at_zero
        place = {
            "port": "flat",
            "normal": list(port.normal),
            "normal_stddev_deg": _stddev(cov.normal_stddev_deg, camera.refine_normal),
            "normal_verdict": normal_verdict(cov, camera.refine_normal),
            "distance_m": port.distance,
            "distance_stddev_m": _stddev(
                cov.distance_stddev_m, camera.refine_distance and not at_zero
            ),
            "distance_verdict": distance_verdict(
                port.distance, cov, camera.refine_distance
            ),
        }
    return {
        **place,
        "thickness_m": port.thickness,
        "glass_index": port.n_glass,
        "water_index": port.n_water,
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
        "num_points": scene.num_points,
        "num_observations": scene.num_observations,
        "num_invalid": int(np.count_nonzero(~np.isfinite(errors))),
        "reprojection_rms_px": float(np.sqrt(np.nanmean(errors**2))),
        "reprojection_mean_px": float(np.nanmean(errors)),
        "sigma_px": summary.sigma_px,
        "solver_iterations": summary.num_iterations,
        "solver_converged": summary.converged,
        "solves": [asdict(solve) for solve in summary.solves],
        "housing_determined": calibration.covariance.determined,
        "scale": scale_summary(calibration),
    }


def scale_summary(calibration: CalibrationResult) -> dict[str, Any]:
    """Whether the lengths of a result are metres, and how well their scale is known."""
    stddev = calibration.covariance.scale_stddev
    return {
        "verdict": scale_verdict(stddev),
        "relative_stddev": _stddev(math.nan if stddev is None else stddev, True),
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
    place = np.sqrt(np.diag(fit.covariance)[3:])
    return {
        "num_positions": len(fit.inliers),
        "outliers": [frame_names[f] for f in fit.frame_idx[~fit.inliers]],
        "rms_miss_m": float(np.sqrt(np.mean(miss[fit.inliers] ** 2))),
        "scatter": fit.scatter,
        "place_stddev_m": place.tolist(),
        "turn_stddev_deg": math.degrees(turn),
        "turn_axis": axis.tolist(),
    }


def refined_summary(rig: Rig, calibration: CalibrationResult) -> list[dict[str, Any]]:
    """Estimates beside ports and placement: water, baselines, lenses."""
    covariance, scene = calibration.covariance, calibration.scene
    stddevs = np.sqrt(np.append(np.diag(covariance.border), np.nan))
    entries = []

    def add(name: str, camera: int, slot: int, value: float) -> None:
        column = int(covariance.border_cols[camera, slot])
        if column != HELD:
            stddev = _stddev(float(stddevs[column]), True)
            entries.append({"name": name, "value": value, "stddev": stddev})

    waters = calibration.covariance.border_cols[:, border.WATER_INDEX]
    for c in [c for c in range(len(waters)) if waters[c] not in waters[:c]]:
        name = "water index" if len({*waters} - {HELD}) == 1 else "water index at {}"
        text = name.format(rig.cameras[c].name)
        add(text, c, border.WATER_INDEX, scene.ports[c].n_water)
    for c, item in enumerate(rig.cameras):
        length = float(np.linalg.norm(scene.cam_from_rig[c, 4:]))
        add(f"baseline of {item.name} (m)", c, border.LENGTH, length)
        lens = scene.cameras[c].camera
        names = item.camera.params_info.split(", ")
        slots = param_slots(lens.model_name)
        for name, slot, value in zip(names, slots, lens.params, strict=True):
            text = f"{name} of {item.name}"
            add(text, c, border.FIRST_LENS + slot, float(value))
    return entries


def budget_summary(rows: Sequence[BudgetRow]) -> list[dict[str, Any]]:
    """What errors of the given numbers would do; null if that is not determined."""
    return [
        {
            "if": row.name,
            "cameras": [
                {
                    "tilt_deg": _stddev(shift.tilt_deg, True),
                    "distance_m": _stddev(shift.distance_m, True),
                    "center_m": [_stddev(value, True) for value in shift.center_m],
                }
                for shift in row.shifts
            ],
        }
        for row in rows
    ]


def versions() -> dict[str, str]:
    """Of the program, of Python, and of the packages that shape the result."""
    found = {name: importlib.metadata.version(name) for name in PACKAGES}
    return {"python": platform.python_version(), **found}


def write_json(data: dict[str, Any], path: str | Path) -> None:
    """Write strict JSON (no NaN), replacing the file as a whole."""
    text = json.dumps(data, indent=2, allow_nan=False)
    with replaced_file(Path(path)) as partial:
        partial.write_text(text + "\n", encoding="utf-8")

"""summary.json: everything measured, each estimate with what is known of it."""

import importlib.metadata
import json
import math
import platform
from pathlib import Path
from typing import Any

import numpy as np

from uwsfm._files import replaced_file
from uwsfm.calibration.problem import CalibrationResult, CameraCovariance
from uwsfm.colmap import Model

PACKAGES = (
    "uwsfm",
    "pycolmap",
    "numpy",
    "scipy",
    "numba",
    "opencv-contrib-python-headless",
)


def housing_summary(model: Model, calibration: CalibrationResult) -> list[dict]:
    """One entry per camera: the estimates, their standard deviations, the verdict.

    A standard deviation is null where the value was held, or where the images do not
    determine it; the verdict tells which.
    """
    entries = []
    for index, camera in enumerate(model.rig.cameras):
        cov = calibration.covariance.cameras[index]
        pose = model.scene.cam_from_rig[index]
        port = model.scene.ports[index]
        entries.append(
            {
                "name": camera.name,
                "lens_conversion_max_px": camera.conversion_max_px,
                "lens_conversion_rms_px": camera.conversion_rms_px,
                "normal": list(port.normal),
                "normal_stddev_deg": _stddev(
                    cov.normal_stddev_deg, camera.refine_normal
                ),
                "distance_m": port.distance,
                "distance_stddev_m": _stddev(
                    cov.distance_stddev_m,
                    camera.refine_distance and not cov.distance_at_zero,
                ),
                "distance_verdict": distance_verdict(
                    port.distance, cov, camera.refine_distance
                ),
                "thickness_m": port.thickness,
                "glass_index": port.n_glass,
                "cam_from_rig": {
                    "rotation_xyzw": pose[:4].tolist(),
                    "translation_m": pose[4:].tolist(),
                    "rotation_stddev_deg": _stddev(cov.rotation_stddev_deg, index > 0),
                    "translation_stddev_m": [
                        _stddev(value, index > 0) for value in cov.translation_stddev_m
                    ],
                },
            }
        )
    return entries


def _stddev(value: float, refined: bool) -> float | None:
    return value if refined and math.isfinite(value) else None


def distance_verdict(distance: float, cov: CameraCovariance, refined: bool) -> str:
    """Whether the images determine a port's distance: a word for people."""
    stddev = cov.distance_stddev_m
    if not refined:
        return "held"
    if cov.distance_at_zero:
        return "ran into zero"
    if not math.isfinite(stddev) or stddev >= abs(distance):
        return "not determined"
    return "determined" if stddev < 0.25 * abs(distance) else "weakly determined"


def errors_summary(model: Model, calibration: CalibrationResult) -> dict[str, Any]:
    """Counts and true reprojection errors."""
    summary = calibration.summary
    errors = model.errors_px()
    return {
        "num_registered_frames": model.scene.num_frames,
        "num_points": model.scene.num_points,
        "num_observations": model.scene.num_observations,
        "num_invalid": int(np.count_nonzero(~np.isfinite(errors))),
        "reprojection_rms_px": float(np.sqrt(np.nanmean(errors**2))),
        "reprojection_mean_px": float(np.nanmean(errors)),
        "sigma_px": summary.sigma_px,
        "solver_iterations": summary.num_iterations,
        "solver_converged": summary.converged,
        "housing_determined": calibration.covariance.determined,
    }


def versions() -> dict[str, str]:
    """Of the program, of Python, and of the packages that shape the result."""
    found = {name: importlib.metadata.version(name) for name in PACKAGES}
    return {"python": platform.python_version(), **found}


def write_json(data: dict[str, Any], path: str | Path) -> None:
    """Write strict JSON (no NaN), replacing the file as a whole."""
    text = json.dumps(data, indent=2, allow_nan=False)
    with replaced_file(Path(path)) as partial:
        partial.write_text(text + "\n", encoding="utf-8")

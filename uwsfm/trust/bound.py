"""Port distances that ran into zero: by chance, or because the input is wrong?"""

from dataclasses import fields, replace

import numpy as np

from uwsfm.calibration.bundle_adjustment import calibrate
from uwsfm.calibration.problem import PRIORS
from uwsfm.calibration.result import CalibrationResult
from uwsfm.models.ports.port import PlanePort
from uwsfm.scene import Scene

STEP_M = 0.005
"""Distances at which the cost is looked at: this, and twice as much. A port of a few
millimetres is told from none there, and the cost is still a parabola."""


def pull_below_zero(calibration: CalibrationResult) -> float | None:
    """How strongly the images want ports behind their cameras, in standard deviations.

    The distances that were held at zero are held at two other values, all else is
    adjusted: the parabola through the three costs has its minimum at a negative
    distance, and lies there by z^2 noise variances below the cost at zero. A port that
    is truly close gives 0 to 3.

    Args:
        calibration: The result.

    Returns:
        None: no distance ran into zero; or the result is no optimum of the reprojection
        error alone, as priors and lengths take part.
    """
    at_zero = [camera.distance_at_zero for camera in calibration.covariance.cameras]
    options = calibration.options
    weighed = calibration.entered is not None or options.baseline_stddev_m > 0.0
    weighed |= options.strategy != "joint" or options.error_name != "reprojection"
    weighed |= any(getattr(options, name) is not None for name in PRIORS)
    if not any(at_zero) or weighed:
        return None
    scene, _ = calibration.scene.select(calibration.inliers)
    flags = np.broadcast_to(options.refine_distances, len(at_zero)) & ~np.array(at_zero)
    how = {field.name: getattr(options, field.name) for field in fields(options)}
    how |= {"loss": "l2", "refine_distances": tuple(flags.tolist())}
    costs = [float(np.nansum(scene.residuals() ** 2))]
    for factor in (1.0, 2.0):
        moved = _with_distance(scene, at_zero, factor * STEP_M)
        summary = calibrate(moved, **how).summary
        costs.append(summary.num_observations * summary.rms_px**2)
    noise = calibration.summary.sigma_px**2
    at_0, at_1, at_2 = (cost / noise for cost in costs)
    slope = (4.0 * at_1 - at_2 - 3.0 * at_0) / 2.0
    curvature = at_2 - 2.0 * at_1 + at_0
    if slope <= 0.0:
        return 0.0
    # Where it bends the wrong way, what one step costs is the least that is known.
    gain = slope**2 / (2.0 * curvature) if curvature > 0.0 else slope
    return float(np.sqrt(gain))


def _with_distance(scene: Scene, at_zero: list[bool], distance: float) -> Scene:
    cameras = [
        camera.with_port(camera.port.changed(distance=distance))
        if held and isinstance(camera.port, PlanePort)
        else camera
        for camera, held in zip(scene.cameras, at_zero, strict=True)
    ]
    return replace(scene, cameras=tuple(cameras))

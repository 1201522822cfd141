"""Would the images rather have other numbers than those that are held?

Ports, poses and points take up most of what a wrong lens or placement does, so its
residuals hardly show by place. An adjustment in which lenses, or the placement of the
cameras, are free as well finds what is left: by likelihood theory (Wilks 1938) the
squares it saves, in noise variances, are chi-square with as many degrees as it has more
numbers, if what was held is right. In simulated dives of six frames, 16 numbers of two
lenses save 10 to 17 where they are, 70 to 80 where both focal lengths are 1 % too long,
and 190 to 350 where p1 is 0.003 off or cy 5 px; a rotation that is held 3.5 degrees
off, which a port tilt takes up to the noise, lets 5 numbers of the placement save 450.
"""

from dataclasses import dataclass, fields, replace
from typing import Any, NamedTuple

import numpy as np

from uwsfm.calibration.bundle_adjustment import calibrate
from uwsfm.calibration.result import CalibrationResult
from uwsfm.errors import UwsfmError
from uwsfm.geometry.rigid3 import Array
from uwsfm.models.lens import param_slots
from uwsfm.residuals import border
from uwsfm.scene import Scene
from uwsfm.solver.layout import HELD

MAX_OBSERVATIONS = 120_000
"""A larger scene is judged by `PART` of them, of consecutive frames: the rig is the
same in all, and the adjustment would take as long as that of the result."""
PART = 60_000
FREE_LENSES = {
    "refine_focal": True,
    "refine_principal_point": True,
    "refine_distortion": True,
    "focal_stddev": 0.05,
    "distortion_stddev": 0.1,
}
"""With wide priors, which only keep the weakest combinations solvable."""
CENTER_SHARE = 0.03
"""The same of the principal point, by the longer side of the image."""


@dataclass(frozen=True, kw_only=True)
class Freed:
    """What numbers that were held change in the residuals once they are free."""

    px: float
    """Root mean square, over the observations, of what vanishes."""
    p_value: float
    """Chance that right numbers let as much vanish, if every observation errs alone."""
    gain: float
    """Squares saved, in variances of the noise."""
    num_freed: int
    """Numbers that were free."""
    sigma_px: float
    """Noise of one coordinate that is left then."""
    evenness: float
    """Sum of what is saved at the points, over the root of its squares: wrong numbers
    are seen by all points, an outlier that was kept by a few."""


class FreedNumbers(NamedTuple):
    """What each kind of held numbers changes, once it is free.

    None: they were free already, the result is no optimum of the reprojection error
    alone (another error, lengths from outside), or the images do not tell.
    """

    lenses: Freed | None = None
    placement: Freed | None = None
    """Of the cameras in the rig."""


def freed_numbers(calibration: CalibrationResult) -> FreedNumbers:
    """Adjust a result once more with its lenses free, and with its placement free.

    Args:
        calibration: The result.
    """
    options = calibration.options
    kinds = _lenses(calibration), _placement(calibration)
    alone = options.strategy == "joint" and options.error_name == "reprojection"
    if not alone or calibration.entered is not None or not any(kinds):
        return FreedNumbers()
    scene, _ = calibration.scene.select(calibration.inliers)
    how: dict[str, Any] = {f.name: getattr(options, f.name) for f in fields(options)}
    how |= {"loss": "l2", "given": None}  # what is known of them must not hold them
    if scene.num_observations > MAX_OBSERVATIONS:
        try:
            result = calibrate(_some_frames(scene), **how)
        except UwsfmError:
            return FreedNumbers()
        scene, _ = result.scene.select(result.inliers)
    return FreedNumbers(*(kind and _freed(scene, how, *kind) for kind in kinds))


_Kind = tuple[dict[str, Any], int]
"""Further options, and how many more numbers they let move."""


def _lenses(calibration: CalibrationResult) -> _Kind | None:
    cameras = calibration.scene.cameras
    columns = calibration.covariance.border_cols
    if np.any(columns[:, border.FIRST_LENS :] != HELD):
        return None
    size = max(max(camera.width, camera.height) for camera in cameras)
    count = sum(len(param_slots(camera.camera.model_name)) for camera in cameras)
    return {**FREE_LENSES, "principal_point_stddev_px": CENTER_SHARE * size}, count


def _placement(calibration: CalibrationResult) -> _Kind | None:
    others = len(calibration.scene.cameras) - 1
    if others == 0 or calibration.options.refine_cam_from_rig:
        return None
    # The length of the first baseline stays held: it is the scale.
    return {"refine_cam_from_rig": True}, 6 * others - 1


def _freed(
    scene: Scene, how: dict[str, Any], more: dict[str, Any], count: int
) -> Freed | None:
    """What further options change, which let so many more numbers move."""
    from scipy.stats import chi2  # heavy

    try:
        result = calibrate(scene, **{**how, **more})
    except UwsfmError:
        return None
    after, of_point = result.summary, _saved(scene, result.scene)
    saved = max(float(of_point.sum()), 0.0)
    spread = float(np.linalg.norm(of_point))
    gain = saved / after.sigma_px**2
    return Freed(
        px=float(np.sqrt(saved / after.num_observations)),
        p_value=float(chi2.sf(gain, count)),
        gain=gain,
        num_freed=count,
        sigma_px=after.sigma_px,
        evenness=saved / spread if spread > 0.0 else 0.0,
    )


def _saved(before: Scene, after: Scene) -> Array:
    """Squares saved at each point (P,), px^2."""
    saved = np.sum(before.residuals() ** 2 - after.residuals() ** 2, axis=1)
    of_point = np.zeros(before.num_points)
    np.add.at(of_point, before.point_idx, np.nan_to_num(saved))
    return of_point


def _some_frames(scene: Scene) -> Scene:
    """Consecutive frames from the middle with about `PART` observations."""
    counts = np.bincount(scene.frame_idx, minlength=scene.num_frames)
    middle = np.searchsorted(np.cumsum(counts), 0.5 * scene.num_observations)
    half = 1
    while half < scene.num_frames:
        inside = slice(max(middle - half, 0), middle + half + 1)
        if counts[inside].sum() >= PART:
            break
        half += 1
    low, high = inside.start, min(inside.stop, scene.num_frames)
    kept = (scene.frame_idx >= low) & (scene.frame_idx < high)
    seen = np.bincount(scene.point_idx[kept], minlength=scene.num_points)
    part, _ = scene.select(kept & (seen[scene.point_idx] >= 2))
    return replace(
        part,
        rig_from_world=scene.rig_from_world[low:high],
        frame_idx=part.frame_idx - low,
    )

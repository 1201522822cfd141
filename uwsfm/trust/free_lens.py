"""Would the images rather have another lens? What the residuals lose if it is free.

Ports, poses and points take up most of what a wrong lens does, so its residuals hardly
show by place. An adjustment in which the lenses are free as well finds what is left: by
likelihood theory (Wilks 1938) the squares it saves, in noise variances, are chi-square
with as many degrees as it has more numbers, if the lenses are right. In simulated dives
of six frames, 16 numbers save 10 to 17 where they are, 70 to 80 where both focal
lengths are 1 % too long, and 190 to 350 where p1 is 0.003 off or cy 5 px.
"""

from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np

from uwsfm.calibration.bundle_adjustment import calibrate
from uwsfm.calibration.problem import CalibrationResult
from uwsfm.errors import UwsfmError
from uwsfm.models.lens import param_slots
from uwsfm.residuals import border
from uwsfm.scene import Scene
from uwsfm.solver.layout import HELD

MAX_OBSERVATIONS = 120_000
"""A larger scene is judged by `PART` of them, of consecutive frames: the lenses are the
same in all, and the adjustment would take as long as that of the result."""
PART = 60_000
FREEDOM = {
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
class FreeLens:
    """What free lenses change in the residuals."""

    px: float
    """Root mean square, over the observations, of what vanishes."""
    p_value: float
    """Chance that right lenses let as much vanish, if every observation errs alone."""
    gain: float
    """Squares saved, in variances of the noise."""
    num_freed: int
    """Numbers that were free."""
    sigma_px: float
    """Noise of one coordinate that is left then."""


def free_lens(calibration: CalibrationResult) -> FreeLens | None:
    """Adjust a result once more with its lenses free.

    Args:
        calibration: The result.

    Returns:
        None: its lenses were free already, it is no optimum of the reprojection error
        alone (another error, lengths from outside), or the images do not tell.
    """
    from scipy.stats import chi2  # heavy

    options = calibration.options
    freed = calibration.covariance.border_cols[:, border.FIRST_LENS :] != HELD
    alone = options.strategy == "joint" and options.error_name == "reprojection"
    if np.any(freed) or not alone or calibration.entered is not None:
        return None
    scene, _ = calibration.scene.select(calibration.inliers)
    how: dict[str, Any] = {f.name: getattr(options, f.name) for f in fields(options)}
    how |= {
        "loss": "l2",
        "given": None,
    }  # what is known of the lenses must not hold them
    size = max(max(camera.width, camera.height) for camera in scene.cameras)
    more = {**FREEDOM, "principal_point_stddev_px": CENTER_SHARE * size}
    try:
        if scene.num_observations > MAX_OBSERVATIONS:
            result = calibrate(_some_frames(scene), **how)
            scene, _ = result.scene.select(result.inliers)
        after = calibrate(scene, **{**how, **more}).summary
    except UwsfmError:
        return None
    before = float(np.nansum(scene.residuals() ** 2))
    saved = max(before - after.num_observations * after.rms_px**2, 0.0)
    gain = saved / after.sigma_px**2
    count = sum(len(param_slots(c.camera.model_name)) for c in scene.cameras)
    return FreeLens(
        px=float(np.sqrt(saved / after.num_observations)),
        p_value=float(chi2.sf(gain, count)),
        gain=gain,
        num_freed=count,
        sigma_px=after.sigma_px,
    )


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

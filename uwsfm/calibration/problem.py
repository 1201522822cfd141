"""What a calibration is asked to do, and what it reports."""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from uwsfm.errors import InputError
from uwsfm.geometry.rigid3 import Array
from uwsfm.scene import IndexArray, Scene
from uwsfm.solver.layout import HELD
from uwsfm.solver.losses import LOSS_CODES

PerCamera = bool | tuple[bool, ...]


@dataclass(frozen=True, kw_only=True)
class CalibrateOptions:
    """Options of `uwsfm.calibrate`."""

    loss: str = "cauchy"
    """"cauchy": robust first, then outliers are pruned and least squares finish;
    "l2": least squares on everything, for data without outliers."""
    loss_scale_px: float = 3.0
    """Cauchy's c: keeps 15 % outliers at 1.1x the clean bound."""
    prune_sigma: float = 3.5
    """Observations beyond this many standard deviations are outliers."""
    max_iterations: int = 50
    """Of each of the two solves; 5-8 are usual."""
    initial_damping: float = 1e-4
    """1e-2 if the normals may be more than 30 degrees off."""
    refine_normals: PerCamera = True
    refine_distances: PerCamera = True
    refine_cam_from_rig: bool = True
    """Rotations and the directions of the translations."""
    refine_water_index: bool = False
    """One index shared by all ports."""
    baseline_stddev_m: float = 0.0
    """Standard deviation of every baseline length; 0 holds the lengths. They are the
    only source of scale: without them no length is determined."""

    def __post_init__(self) -> None:
        if self.loss not in LOSS_CODES:
            raise InputError(
                f"loss must be one of {', '.join(LOSS_CODES)}, got {self.loss!r}"
            )
        for name in ("loss_scale_px", "prune_sigma", "initial_damping"):
            if not getattr(self, name) > 0.0:
                raise InputError(f"{name} must be positive, got {getattr(self, name)}")
        if self.max_iterations < 1:
            raise InputError(f"max_iterations must be >= 1, got {self.max_iterations}")
        if not 0.0 <= self.baseline_stddev_m < np.inf:
            raise InputError(
                f"baseline_stddev_m must be >= 0, got {self.baseline_stddev_m}"
            )

    def border_columns(self, at_zero: NDArray[np.bool_]) -> IndexArray:
        """(C, BORDER_SIZE) columns of what is refined, HELD for the rest.

        Args:
            at_zero: (C,) ports whose distance is held at zero, its bound.
        """
        num_cameras = len(at_zero)
        normals = _per_camera("refine_normals", self.refine_normals, num_cameras)
        distances = _per_camera("refine_distances", self.refine_distances, num_cameras)
        free = np.zeros((num_cameras, 9), dtype=bool)
        free[1:, :5] = self.refine_cam_from_rig
        free[1:, 5] = self.baseline_stddev_m > 0.0
        free[:, 6:8] = normals[:, None]
        free[:, 8] = distances & ~at_zero
        columns = np.full((num_cameras, 10), HELD, dtype=np.int64)
        columns[:, :9][free] = np.arange(np.count_nonzero(free))
        if self.refine_water_index:
            columns[:, 9] = np.count_nonzero(free)
        return columns


def _per_camera(name: str, value: PerCamera, count: int) -> NDArray[np.bool_]:
    flags = np.asarray(value, dtype=bool)
    if flags.ndim == 0:
        return np.full(count, bool(flags))
    if flags.shape != (count,):
        raise InputError(f"{name} has {flags.size} entries for {count} cameras")
    return flags


@dataclass(frozen=True, kw_only=True)
class CameraCovariance:
    """Standard deviations of one camera's housing; 0 means held, NaN undetermined.

    Each is the larger of two: that of `Covariance.border`, where every observation errs
    alone, and that where the observations of a quarter of an image may err together, by
    as much as their residuals show. On real images the second is up to three times the
    first.
    """

    normal_stddev_deg: float
    """Root mean square angle between the estimated and the true normal."""
    distance_stddev_m: float
    rotation_stddev_deg: float
    """Root mean square angle of cam_from_rig's rotation."""
    translation_stddev_m: tuple[float, float, float]
    """Of cam_from_rig's translation; its length adds only if it is not held."""
    distance_at_zero: bool
    """The images wanted a negative port distance, which no housing has: it was held at
    zero. They contradict the lens or the water index that was given."""


@dataclass(frozen=True, kw_only=True)
class Covariance:
    """Posterior covariance at the optimum, scaled by the noise found in the data.

    Parameters of a camera, in the order of ``border_cols``: rotation of cam_from_rig
    (3, left tangent, radians), direction of its translation (2, tangent), its length
    (1, metres), port normal (2, tangent), port distance (1, metres), water index (1).
    """

    border: Array
    """(B, B), marginal over poses and points, if every observation errs alone."""
    border_cols: IndexArray
    """(C, 10) column of each parameter of each camera, -1 if held."""
    frames: Array
    """(F, 6, 6) of rig_from_world [rotation, translation]; zero for the held first."""
    points: Array
    """(P, 3, 3) in the world, relative to the held first frame; NaN if undetermined."""
    cameras: tuple[CameraCovariance, ...]
    determined: bool
    """False: the data leave some direction of the refined parameters free, and every
    standard deviation is NaN."""


@dataclass(frozen=True, kw_only=True)
class CalibrateSummary:
    """What happened. Errors are true reprojection errors in pixels."""

    num_frames: int
    num_points: int
    """Points with at least two observations that took part."""
    num_observations: int
    """That took part in the last solve."""
    num_outliers: int
    num_invalid: int
    """That could not be projected at the optimum; never counted as a fit."""
    num_iterations: int
    converged: bool
    initial_rms_px: float
    """Of all observations that could be projected at the start."""
    rms_px: float
    """Root mean square of |residual| over the last solve's observations."""
    mean_error_px: float
    """Mean of |residual| over the last solve's observations."""
    sigma_px: float
    """Noise of one coordinate, corrected for the fitted parameters."""
    solve_s: float


@dataclass(frozen=True, kw_only=True)
class CalibrationResult:
    """A refined scene. Indices are those of the input scene."""

    scene: Scene
    """Points without two good observations are NaN."""
    inliers: NDArray[np.bool_] = field(repr=False)
    """(N,) observations that took part in the last solve."""
    summary: CalibrateSummary
    covariance: Covariance

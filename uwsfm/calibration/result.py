"""What a calibration reports: the scene, what happened, and how well all is known."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from uwsfm.calibration.lengths import LengthFit, Lengths, PositionFit
from uwsfm.calibration.problem import CalibrateOptions
from uwsfm.geometry.rigid3 import Array
from uwsfm.scene import IndexArray, Scene


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
    center_stddev_m: tuple[float, float, float]
    """Of a dome's centre, x, y, z in the camera frame."""
    distance_at_zero: bool
    """The images wanted a negative port distance, which no housing has: it was held at
    zero. They contradict the lens or the water index that was given."""


@dataclass(frozen=True, kw_only=True, eq=False)
class InAll:
    """What `Covariance` holds, from the images and from errors of what was given."""

    cameras: tuple[CameraCovariance, ...]
    """What was held has the standard deviation that it was given, or assumed, with."""
    border: Array
    """(B, B) of the refined parameters."""
    given: Array
    """(C BORDER_SIZE, C BORDER_SIZE) what errors of given numbers add, of all
    parameters, the given ones included."""
    frames: Array
    """(F, 6, 6)"""
    scale_stddev: float | None


@dataclass(frozen=True, kw_only=True)
class Covariance:
    """Posterior covariance at the optimum, scaled by the noise found in the data.

    The parameters of a camera are those of `uwsfm.residuals.border`, in its order:
    rotation of cam_from_rig (3, left tangent, radians), direction of its translation
    (2, tangent), its length (metres), port normal (2, tangent) and port distance
    (metres) or the centre of a dome (3, metres), water index, glass thickness, glass
    index, radius of a dome, and the lens. The covariance is that of
    the maximum likelihood: another error than reprojection scatters at least so much.
    """

    border: Array
    """(B, B), marginal over poses and points, if every observation errs alone."""
    border_cols: IndexArray
    """(C, BORDER_SIZE) column of each parameter of each camera, -1 if held."""
    frames: Array
    """(F, 6, 6) of rig_from_world, left tangents [w (radians), v (metres)] as of
    `uwsfm.geometry.rigid3.perturb`, which make x -> Exp(w) (R x + t) + v of the
    estimate (R, t): v is t' - Exp(w) t, no difference of translations, and the rig's
    centre moves by -R^T v. Zero for the held first."""
    points: Array
    """(P, 3, 3) in the world, relative to the held first frame; NaN if undetermined."""
    cameras: tuple[CameraCovariance, ...]
    determined: bool
    """False: the data leave some direction of the refined parameters free, and every
    standard deviation is NaN."""
    scale_stddev: float | None
    """Relative standard deviation of the factor that all distances of points share, see
    `uwsfm.calibration.scale`. None: nothing determines the scale, every length is in an
    arbitrary unit, and what is said of lengths takes one distance between two frames
    for known."""
    in_all: InAll | None = None
    """With the errors of what was given, see `uwsfm.calibration.given_errors`; all of
    the above is from the images and priors alone."""
    enlarged: Mapping[str, float] = field(default_factory=dict)
    """Groups of numbers whose deviations halves of the frames found too small, and by
    which factor they were multiplied, see `uwsfm.calibration.enlarged`."""

    @property
    def judged_cameras(self) -> tuple[CameraCovariance, ...]:
        """In all if that is known, else from the images: what verdicts go by."""
        return self.cameras if self.in_all is None else self.in_all.cameras

    @property
    def judged_scale_stddev(self) -> float | None:
        """The same, of the scale."""
        own = self.scale_stddev
        if own is None or not np.isfinite(own) or self.in_all is None:
            return own
        return self.in_all.scale_stddev


@dataclass(frozen=True, kw_only=True)
class SolveHistory:
    """How the cost of one solve fell."""

    error: str
    loss: str
    num_observations: int
    costs: tuple[float, ...]
    """0.5 sum rho, priors included, px^2 (of an error in space: m^2): of the start
    and after each step; of the nested strategy, after each pass."""


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
    solves: tuple[SolveHistory, ...]
    """In their order: robust ones come before least squares on what they left."""
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
    options: CalibrateOptions
    """That were asked for."""
    lengths: LengthFit | None = None
    positions: PositionFit | None = None
    """Then the scene is in the frame of the positions."""
    entered: Lengths | None = field(default=None, repr=False)
    """The lengths as the last solve weighed them: positions that were believed, with
    their covariances enlarged by how much they scatter. None without any."""
    bars: Scene | None = field(default=None, repr=False)
    """Clicked ends of scale bars that took part and are not in ``scene``: ``entered``
    counts these points after those of ``scene``."""

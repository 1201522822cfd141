"""What a calibration is asked to do, and what it reports."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from uwsfm.calibration.choices import DEFAULT_ERRORS, PRIORS, ErrorName, Strategy
from uwsfm.calibration.given_accuracy import GivenAccuracy
from uwsfm.calibration.lengths import LengthFit, Lengths, PositionFit
from uwsfm.errors import InputError
from uwsfm.geometry.rigid3 import Array
from uwsfm.models.lens import NUM_PARAMS, param_slots
from uwsfm.models.ports.port import DomePort, FlatPort, NoPort, Port
from uwsfm.models.refractive import RefractiveCamera
from uwsfm.residuals import border
from uwsfm.scene import IndexArray, Scene
from uwsfm.solver.error_models import ERROR_CODES
from uwsfm.solver.layout import HELD
from uwsfm.solver.losses import LOSS_CODES

PerCamera = bool | tuple[bool, ...]

LENS_PRIORS = PRIORS[4:]
LENS_PARTS = {
    "focal": slice(0, 2),
    "principal_point": slice(2, 4),
    "distortion": slice(4, NUM_PARAMS),
}
"""What of a lens is refined together, and its slots."""


@dataclass(frozen=True, kw_only=True)
class CalibrateOptions:
    """Options of `uwsfm.calibrate`."""

    loss: str = "cauchy"
    """"cauchy": robust first, then outliers are pruned and least squares finish;
    "l2": least squares on everything, for data without outliers."""
    loss_scale_px: float = 3.0
    """Cauchy's c: keeps 15 % outliers at 1.1x the clean bound."""
    prune_sigma: float = 4.0
    """Observations beyond this many standard deviations, of noise by the median, are
    outliers: one in 3000 of normal errors. Those of real features have longer tails:
    in frames of a compressed video 4 leaves out 6 % of what agrees within 4 px."""
    max_iterations: int = 50
    """Of each of the two solves; 5-8 are usual."""
    initial_damping: float = 1e-4
    """1e-2 if the normals may be more than 30 degrees off."""
    strategy: Strategy = "joint"
    """"joint": everything moves together; "nested": the loops of the paper's fig. 5,
    some ten times slower, with the same end where the motion is rich. On a
    straight or level track their distances scatter more; with
    "virtual_camera_tangential" they are several standard deviations too long there."""
    error: ErrorName | None = None
    """What is minimised: "reprojection" (pixels), "virtual_camera" or
    "virtual_camera_tangential" (metres on the port; the paper's eq. 6-10, centred on
    the axis or on the other sheet of the caustic), "point_3d" (metres in space). None:
    the strategy's own, reprojection if joint, virtual_camera in the outer loop if
    nested."""
    refine_normals: PerCamera = True
    """Of flat ports."""
    refine_distances: PerCamera = True
    """Of flat ports."""
    refine_centers: PerCamera = True
    """Of domes, all three coordinates."""
    refine_cam_from_rig: bool = True
    """Rotations and the directions of the translations."""
    refine_water_index: bool = False
    """Shared by all ports that start from the same index."""
    separate_water_index: bool = False
    """Every port refines an index of its own."""
    refine_focal: PerCamera = False
    """Focal lengths of every camera; they trade against water index and distance."""
    refine_principal_point: PerCamera = False
    """Trades against the normal."""
    refine_distortion: PerCamera = False
    """All distortion parameters that the camera's model has."""
    baseline_stddev_m: float = 0.0
    """Standard deviation of every baseline length; 0 holds the lengths. They are the
    only source of scale: without them no length is determined."""
    distance_stddev_m: float | None = None
    """How well the port distances of the start are known; None: not at all. So for all
    that follow; they matter for what is refined only."""
    normal_stddev_deg: float | None = None
    """Root mean square angle."""
    center_stddev_m: float | None = None
    """Per coordinate of the centres of domes."""
    water_index_stddev: float | None = None
    focal_stddev: float | None = None
    """Relative: 1e-3 is 0.1 %."""
    principal_point_stddev_px: float | None = None
    """Per coordinate."""
    distortion_stddev: float | None = None
    """Of each distortion parameter."""
    given: GivenAccuracy | None = field(default=None, compare=False, repr=False)
    """How well what is held is known, for `Covariance.in_all`, and the correlated prior
    of lenses if it asks for one. None: the defaults, which are assumed."""

    def __post_init__(self) -> None:
        _one_of("loss", self.loss, LOSS_CODES)
        _one_of("strategy", self.strategy, DEFAULT_ERRORS)
        _one_of("error", self.error_name, ERROR_CODES)
        for name in ("loss_scale_px", "prune_sigma", "initial_damping"):
            if not getattr(self, name) > 0.0:
                raise InputError(f"{name} must be positive, got {getattr(self, name)}")
        for name in PRIORS:
            value = getattr(self, name)
            if value is not None and not 0.0 < value < np.inf:
                raise InputError(f"{name} must be positive and finite, got {value}")
        if self.max_iterations < 1:
            raise InputError(f"max_iterations must be >= 1, got {self.max_iterations}")
        if not 0.0 <= self.baseline_stddev_m < np.inf:
            raise InputError(
                f"baseline_stddev_m must be >= 0, got {self.baseline_stddev_m}"
            )
        self._check_error()

    @classmethod
    def parsed(cls, options: dict[str, Any]) -> "CalibrateOptions":
        """Options by name.

        Raises:
            InputError: an unknown name, or a value out of range.
        """
        try:
            return cls(**options)
        except TypeError as error:
            raise InputError(f"calibrate: {error}") from None

    def _check_error(self) -> None:
        """Refuse what another error than reprojection does not determine."""
        given = [name for name in PRIORS if getattr(self, name) is not None]
        if self.given is not None and self.given.correlated_prior:
            twice = [name for name in given if name in LENS_PRIORS]
            if twice:
                raise InputError(
                    f"{twice[0]}: the rig file has lens_prior: correlated, which is a "
                    "prior of the lenses already; leave one of the two out"
                )
            if any(np.any(getattr(self, f"refine_{name}")) for name in LENS_PARTS):
                given.append("lens_prior")
        pixels = self.strategy == "joint" and self.error_name == "reprojection"
        if given and not pixels:
            raise InputError(
                f"{given[0]} needs the joint strategy and the reprojection error: "
                "elsewhere it cannot be weighed against the noise of the images"
            )
        if self.error_name == "reprojection":
            return
        for name in ("refine_focal", "refine_principal_point", "refine_distortion"):
            if np.any(getattr(self, name)):
                raise InputError(
                    f"{name} needs the reprojection error: in {self.error_name} the "
                    "pixels' rays in air are given"
                )
        if self.error_name == "point_3d" and self.strategy == "nested":
            raise InputError(
                "error 'point_3d' does not lead the nested loops anywhere, not even on "
                "exact data: hold the distances, or take a virtual camera"
            )
        if self.error_name == "point_3d" and self.baseline_stddev_m > 0.0:
            raise InputError(
                "error 'point_3d' is measured in metres, which a free baseline "
                "shrinks: give baseline_stddev_m=0"
            )
        if self.strategy == "joint" and np.any(self.refine_distances):
            raise InputError(
                f"error {self.error_name!r} is measured in metres, which a port "
                "distance shrinks: hold the distances (refine_distances=False; refine: "
                "[normal] in a rig file), or take strategy='nested'"
            )

    @property
    def error_name(self) -> str:
        """What is minimised; if nested, in the outer loop."""
        return self.error or DEFAULT_ERRORS[self.strategy]

    def border_columns(
        self, cameras: Sequence[RefractiveCamera], at_zero: NDArray[np.bool_]
    ) -> IndexArray:
        """(C, BORDER_SIZE) columns of what is refined, HELD for the rest.

        Args:
            cameras: C of them; what can move depends on their lenses and ports.
            at_zero: (C,) ports whose distance is held at zero, its bound.
        """
        count, ports = len(at_zero), [camera.port for camera in cameras]
        flat = np.array([isinstance(port, FlatPort) for port in ports])
        dome = np.array([isinstance(port, DomePort) for port in ports])
        normals = _per_camera("refine_normals", self.refine_normals, count)
        distances = _per_camera("refine_distances", self.refine_distances, count)
        centers = _per_camera("refine_centers", self.refine_centers, count)
        free = np.zeros((count, border.BORDER_SIZE), dtype=bool)
        free[1:, border.ROTATION] = self.refine_cam_from_rig
        free[1:, border.DIRECTION] = self.refine_cam_from_rig
        free[1:, border.LENGTH] = self.baseline_stddev_m > 0.0
        free[:, border.NORMAL] = (normals & flat)[:, None]
        free[:, border.DISTANCE] = distances & flat & ~at_zero
        free[dome, border.CENTER] = centers[dome, None]
        wanted = np.zeros((count, NUM_PARAMS), dtype=bool)
        for part, slots in LENS_PARTS.items():
            name = f"refine_{part}"
            flags = _per_camera(name, getattr(self, name), count)
            wanted[:, slots] = flags[:, None]
        models = [camera.camera.model_name for camera in cameras]
        for c, model in enumerate(models):
            for slot in param_slots(model):
                free[c, border.FIRST_LENS + slot] = wanted[c, slot]
        water = self._first_of_water(ports)
        for c, first in enumerate(water):
            free[c, border.WATER_INDEX] = self.refine_water_index and c == first
        columns = np.full(free.shape, HELD, dtype=np.int64)
        columns[free] = np.arange(np.count_nonzero(free))
        for c, first in enumerate(water):
            if first is not None:
                columns[c, border.WATER_INDEX] = columns[first, border.WATER_INDEX]
        for c, model in enumerate(models):
            if 1 not in param_slots(model):  # one focal length for both axes
                fx = columns[c, border.FIRST_LENS]
                columns[c, border.FIRST_LENS + 1] = fx
        return columns

    def _first_of_water(self, ports: Sequence[Port]) -> list[int | None]:
        """The first port that shares each port's water; None: no refraction."""
        first: dict[float, int] = {}
        return [
            None
            if isinstance(port, NoPort)
            else c
            if self.separate_water_index
            else first.setdefault(port.n_water, c)
            for c, port in enumerate(ports)
        ]


def _one_of(name: str, value: str, allowed: Iterable[str]) -> None:
    if value not in allowed:
        raise InputError(f"{name} must be one of {', '.join(allowed)}, got {value!r}")


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

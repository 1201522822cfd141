"""What a calibration is asked to do, and what it reports."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from uwsfm.calibration.choices import DEFAULT_ERRORS, PRIORS, ErrorName, Strategy
from uwsfm.calibration.given_accuracy import GivenAccuracy
from uwsfm.errors import InputError
from uwsfm.models.lens import NUM_PARAMS, param_slots
from uwsfm.models.ports.port import Port
from uwsfm.models.refractive import RefractiveCamera
from uwsfm.residuals import border
from uwsfm.scene import IndexArray
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
        plane = np.array([port.has("normal") for port in ports])
        dome = np.array([port.has("center") for port in ports])
        normals = _per_camera("refine_normals", self.refine_normals, count)
        distances = _per_camera("refine_distances", self.refine_distances, count)
        centers = _per_camera("refine_centers", self.refine_centers, count)
        free = np.zeros((count, border.BORDER_SIZE), dtype=bool)
        free[1:, border.ROTATION] = self.refine_cam_from_rig
        free[1:, border.DIRECTION] = self.refine_cam_from_rig
        free[1:, border.LENGTH] = self.baseline_stddev_m > 0.0
        free[:, border.NORMAL] = (normals & plane)[:, None]
        free[:, border.DISTANCE] = distances & plane & ~at_zero
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
            if not port.refracts
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

"""What a calibration is asked to do, and what it reports."""

import textwrap
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, make_dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from uwsfm.calibration.choices import DEFAULT_ERRORS, ErrorName, Strategy
from uwsfm.calibration.given_accuracy import GivenAccuracy
from uwsfm.calibration.parameter import Parameter
from uwsfm.calibration.parameters import LENS, PARAMETERS, PRIORS
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

LENS_PRIORS = tuple(each.prior.field for each in LENS if each.prior is not None)
LENS_REFINED = tuple(each.refine.field for each in LENS if each.refine is not None)


def _fields() -> list[tuple[str, Any, Any]]:
    """Name, type and default of the options that parameters declare."""
    flags = [each.refine for each in PARAMETERS if each.refine is not None]
    return [
        *((flag.field, PerCamera, field(default=flag.default)) for flag in flags),
        *((name, float | None, field(default=None)) for name in PRIORS),
    ]


if TYPE_CHECKING:

    class _OfParameters:
        def __getattr__(self, name: str) -> Any: ...
else:
    _OfParameters = make_dataclass(
        "_OfParameters", _fields(), frozen=True, kw_only=True
    )


def _documented(kind: type["CalibrateOptions"]) -> type["CalibrateOptions"]:
    """Add the options that parameters declare to the docstring."""
    lines = [kind.__doc__ or "", "", "Args:"]
    wrapper = textwrap.TextWrapper(
        88, initial_indent=4 * " ", subsequent_indent=8 * " "
    )
    flags = [(p.refine.field, p.refine.help) for p in PARAMETERS if p.refine]
    priors = [(p.prior.field, p.prior.help) for p in PARAMETERS if p.prior]
    lines += [wrapper.fill(f"{name}: {text}") for name, text in (*flags, *priors)]
    kind.__doc__ = "\n".join(lines)
    return kind


@_documented
@dataclass(frozen=True, kw_only=True)
class CalibrateOptions(_OfParameters):
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
    refine_cam_from_rig: bool = True
    """Rotations and the directions of the translations."""
    separate_water_index: bool = False
    """Every port refines an index of its own."""
    baseline_stddev_m: float = 0.0
    """Standard deviation of every baseline length; 0 holds the lengths. They are the
    only source of scale: without them no length is determined."""
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
        self._check_exact()

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
            if any(np.any(getattr(self, name)) for name in LENS_REFINED):
                given.append("lens_prior")
        given += [each.refine.field for each in self._by_accuracy if each.refine]
        pixels = self.strategy == "joint" and self.error_name == "reprojection"
        if given and not pixels:
            raise InputError(
                f"{given[0]} needs the joint strategy and the reprojection error: "
                "elsewhere it cannot be weighed against the noise of the images"
            )
        if self.error_name == "reprojection":
            return
        for name in LENS_REFINED:
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
    def _by_accuracy(self) -> list[Parameter]:
        """What is refined with a prior that the accuracy of the rig can be."""
        return [
            each
            for each in PARAMETERS
            if each.has_prior_by_accuracy
            and each.refine is not None
            and np.any(getattr(self, each.refine.field))
        ]

    def _check_exact(self) -> None:
        """Refuse to refine what the rig states as exact."""
        for each in self._by_accuracy:
            if self.given is None or self.prior(each) is not None:
                continue
            if not np.any(self.given.stddevs[:, each.slots] > 0.0):
                raise InputError(exact_error(each, "the rig"))

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
        free = np.zeros((count, border.BORDER_SIZE), dtype=bool)
        free[1:, border.ROTATION] = self.refine_cam_from_rig
        free[1:, border.DIRECTION] = self.refine_cam_from_rig
        free[1:, border.LENGTH] = self.baseline_stddev_m > 0.0
        for parameter in PARAMETERS:
            has = np.array([parameter.of(port) for port in ports])
            free[has & self.refines(parameter, count), parameter.slots] = True
        free[at_zero, border.DISTANCE] = False
        models = [camera.camera.model_name for camera in cameras]
        for c, model in enumerate(models):
            absent = [k for k in range(NUM_PARAMS) if k not in param_slots(model)]
            free[c, border.FIRST_LENS + np.array(absent, dtype=np.int64)] = False
        water = self._first_of_water(ports)
        for c, first in enumerate(water):
            free[c, border.WATER_INDEX] &= c == first
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

    def refines(self, parameter: Parameter, count: int) -> NDArray[np.bool_]:
        """(C,) of which cameras a parameter is to be refined, where they have it."""
        if parameter.refine is None:
            return np.zeros(count, dtype=bool)
        name = parameter.refine.field
        return _per_camera(name, getattr(self, name), count)

    def prior(self, parameter: Parameter) -> float | None:
        """What is known of a parameter beforehand, in the unit of its option."""
        if parameter.prior is None:
            return None
        stddev: float | None = getattr(self, parameter.prior.field)
        return stddev

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


def exact_error(parameter: Parameter, where: str) -> str:
    """That what is exact cannot be refined."""
    assert parameter.refine is not None and parameter.prior is not None
    return (
        f"{parameter.refine.field}: the accuracy of {where} states the "
        f"{parameter.name} as exact; give --prior {parameter.prior.field}=..., or hold "
        "it"
    )


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

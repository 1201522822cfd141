"""How well the given numbers are known: lenses, glass, water, baseline, held poses.

A person gives standard deviations one by one, or the covariance that a calibration
yields; whatever is left out has a default, which is *assumed* and shown as that. All of
it becomes one covariance over the parameters of `uwsfm.residuals.border`.
"""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from uwsfm.calibration.named_covariance import (
    NamedCovariance,
    require_stated_once,
    steps_of_names,
)
from uwsfm.calibration.parameter import Parameter
from uwsfm.calibration.parameters import (
    BASELINE,
    CENTER,
    DIRECTION,
    FOCAL,
    OF_PORTS,
    OF_RIG,
    PRINCIPAL_POINT,
    ROTATION,
    TILT,
    WATER_INDEX,
)
from uwsfm.errors import InputError
from uwsfm.geometry.rigid3 import Array
from uwsfm.models.lens_row import CX, CY, FX
from uwsfm.models.ports.kind import Port
from uwsfm.residuals import border

CORNER = 0.005
"""How far each radial coefficient alone may move the image corner, as a share of its
distance from the centre: 0.01 of k1 for a lens whose corners are 35 degrees off."""
MAX_CORNER = 0.3
"""Of a standard deviation that a person states: coefficients move no corner so far."""
TANGENTIAL = 1e-3
NEXT_COEFFICIENT = -0.9
"""Correlation of k1 with k2, k2 with k3 ... if they are not given as a covariance, for
every calibration trades one for the next. Together they move the corner by a pixel or
so, as two calibrations of one lens differ."""
FX_AGAINST_FY = 0.99
"""Correlation of fx and fy: pixels are square to a tenth of the focal accuracy."""

_BROWN = ({4: 2, 5: 4, 8: 6}, {9: 2, 10: 4, 11: 6})
"""Lens slots of radial coefficients with the power of the radius: above and below the
fraction line."""
_FISHEYE = ({4: 2, 5: 4, 8: 6, 9: 8},)
_SHAPE = ({4: 0}, {5: 0})
"""Of lenses whose numbers are no powers: they err each by itself."""


def _radial(camera: "GivenCamera") -> tuple[dict[int, int], ...]:
    # It compiles kernels, and a rig file is read without them.
    from uwsfm.models.lens import ANGLE_KINDS, BROWN, KIND, PINHOLE

    if camera.lens[KIND] in ANGLE_KINDS:
        return _FISHEYE
    return _BROWN if camera.lens[KIND] in (PINHOLE, BROWN) else _SHAPE


@dataclass(frozen=True, kw_only=True)
class CameraAccuracy:
    """Standard deviations of one camera's given numbers; None: the default is assumed.

    What is refined without a prior is not given: its entry has no effect on estimates
    and deviations, only on the verdict, for which it is a claim. Of what the images
    hardly determine (`Prior.from_accuracy`: the glass) the entry is the prior.
    """

    focal: float | None = None
    """Relative."""
    principal_point_px: float | None = None
    distortion: tuple[float, ...] | None = None
    """One per coefficient of the lens model, in its order."""
    thickness_m: float | None = None
    glass_index: float | None = None
    radius_m: float | None = None
    normal_deg: float | None = None
    distance_m: float | None = None
    center_m: float | None = None
    rotation_deg: float | None = None
    """Per axis of the camera."""
    direction_deg: float | None = None


@dataclass(frozen=True, kw_only=True, eq=False)
class RigAccuracy:
    """What is known of the numbers that cameras share."""

    baseline_m: float | None = None
    """Of a baseline that is held."""
    water_index: float | None = None
    covariance: NamedCovariance | None = None
    """In the place of the defaults of the parameters that it names. Their assumed
    correlations with parameters that it does not name end, too."""
    lens_prior: Literal["independent", "correlated"] = "independent"
    """"correlated": lens parameters that are refined have the covariance as a prior."""
    exact: bool = False
    """What has no standard deviation here or in its camera is exact: a simulation."""


@dataclass(frozen=True, kw_only=True, eq=False)
class GivenAccuracy:
    """The covariance of all given numbers, in the units of the border's steps."""

    covariance: Array
    """(C BORDER_SIZE, C BORDER_SIZE), zero for what is exact or does not exist."""
    assumed: NDArray[np.bool_]
    """(C, BORDER_SIZE) the standard deviation is a default."""
    names: tuple[str, ...] = field(default=())
    """Of the cameras."""
    correlated_prior: bool = False

    @property
    def stddevs(self) -> Array:
        """(C, BORDER_SIZE)"""
        return np.sqrt(np.diag(self.covariance)).reshape(self.assumed.shape)

    def block(self, slots: ArrayLike) -> Array:
        """Covariance (G, G) of parameters (G, 2) of camera and slot."""
        camera, slot = np.asarray(slots, dtype=np.int64).reshape(-1, 2).T
        rows = camera * border.BORDER_SIZE + slot
        return self.covariance[np.ix_(rows, rows)]


@dataclass(frozen=True, kw_only=True)
class GivenCamera:
    """What the accuracy of one camera's numbers depends on."""

    name: str
    lens: Array
    """(LENS_SIZE,) as of `uwsfm.models.lens`."""
    param_names: tuple[str, ...]
    slots: tuple[int, ...]
    """Where each parameter of the lens model is in ``lens``."""
    size_px: tuple[int, int]
    port: type[Port]
    port_row: Array
    translation: Array
    """(3,) of cam_from_rig; zeros if only its length is known."""
    accuracy: CameraAccuracy = CameraAccuracy()


def given_accuracy(
    cameras: Sequence[GivenCamera], rig: RigAccuracy, baseline_m: float | None = None
) -> GivenAccuracy:
    """The covariance of all that is given of a rig.

    Args:
        cameras: in the rig's order.
        rig: what is known of the shared numbers.
        baseline_m: length of the second camera's translation, for one without a pose.

    Raises:
        InputError: the covariance names what the rig does not have.
    """
    names = tuple(camera.name for camera in cameras)
    if rig.covariance is not None:
        require_stated_once(cameras, rig.baseline_m, rig.covariance)
    if rig.exact:
        cameras = [replace(c, accuracy=_otherwise_exact(c)) for c in cameras]
        shared: dict[str, Any] = {key: getattr(rig, key) or 0.0 for key in OF_RIG}
        rig = replace(rig, **shared)
    size = border.BORDER_SIZE
    stddevs = np.zeros((len(cameras), size))
    assumed = np.zeros((len(cameras), size), dtype=bool)
    for c, camera in enumerate(cameras):
        row = _Row(camera, rig, stddevs[c], assumed[c])
        row.lens()
        row.port()
        if c > 0:
            row.placement(baseline_m)
    covariance = np.diag(stddevs.ravel() ** 2)
    _couple_lenses(cameras, stddevs, covariance)
    _couple_water(cameras, stddevs, covariance)
    if rig.covariance is not None:
        _replace_named(cameras, rig, covariance, assumed)
    return GivenAccuracy(
        covariance=covariance,
        assumed=assumed,
        names=names,
        correlated_prior=rig.lens_prior == "correlated",
    )


def _otherwise_exact(camera: GivenCamera) -> CameraAccuracy:
    """What is not said to be inexact is exact."""
    own = asdict(camera.accuracy)
    coefficients = sum(slot > 3 for slot in camera.slots)
    zeros: dict[str, Any] = {**dict.fromkeys(own, 0.0), "distortion": ()}
    if coefficients:
        zeros["distortion"] = (0.0,) * coefficients
    given = {name: value for name, value in own.items() if value is not None}
    return CameraAccuracy(**{**zeros, **given})


@dataclass(frozen=True, eq=False)
class _Row:
    """The standard deviations of one camera, slot by slot."""

    camera: GivenCamera
    rig: RigAccuracy
    stddevs: Array
    """(BORDER_SIZE,) to be filled."""
    assumed: NDArray[np.bool_]
    """(BORDER_SIZE,) to be filled."""

    def set(
        self, slots: int | slice, stated: float | None, default: float, per: float
    ) -> None:
        self.stddevs[slots] = per * (default if stated is None else stated)
        self.assumed[slots] = stated is None

    def parameter(self, parameter: Parameter, value: float = 0.0) -> None:
        """What is stated of a parameter, or else its default.

        Args:
            parameter: that the camera has.
            value: of it, on which its default may depend.
        """
        accuracy = parameter.accuracy
        assert accuracy is not None
        of = self.rig if accuracy.of_rig else self.camera.accuracy
        stated: float | None = getattr(of, accuracy.key)
        default = accuracy.default(value)
        if not accuracy.relative:
            self.set(parameter.slots, stated, default, accuracy.per)
            return
        for slot in range(parameter.first, parameter.first + parameter.size):
            scale = float(self.camera.lens[slot - border.FIRST_LENS])
            self.set(slot, stated, default, scale)

    def port(self) -> None:
        for parameter in (TILT, CENTER, *OF_PORTS):
            if parameter.of(self.camera.port):
                column = parameter.column
                row = self.camera.port_row
                self.parameter(parameter, 0.0 if column is None else float(row[column]))

    def placement(self, baseline_m: float | None) -> None:
        length = float(np.linalg.norm(self.camera.translation)) or baseline_m or 0.0
        self.parameter(ROTATION)
        self.parameter(DIRECTION)
        self.parameter(BASELINE, length)

    def lens(self) -> None:
        camera = self.camera
        self.parameter(FOCAL)
        self.parameter(PRINCIPAL_POINT)
        coefficients = [slot for slot in camera.slots if slot > 3]
        stated = camera.accuracy.distortion
        if stated is not None and len(stated) != len(coefficients):
            names = ", ".join(camera.param_names[-len(coefficients) :] or ("none",))
            raise InputError(
                f"camera {camera.name!r}: accuracy.distortion has {len(stated)} "
                f"values, its lens model has {len(coefficients) or 'no'} coefficients "
                f"({names})"
            )
        radial = {slot for chain in _radial(camera) for slot in chain}
        for k, slot in enumerate(coefficients):
            reach = corner_shift(camera, slot)
            # A number that moves nothing, as beta of EUCM with alpha zero, is known.
            radially = CORNER / reach if reach > 0.0 else 0.0
            default = radially if slot in radial else TANGENTIAL
            value = None if stated is None else stated[k]
            moved = (value or 0.0) * reach
            if moved > MAX_CORNER:
                raise InputError(
                    f"camera {camera.name!r}: accuracy.distortion[{k}] is {value:g}, "
                    f"which would move the image corner by {1e2 * moved:.0f} % of its "
                    "distance from the centre; it is one standard deviation of the "
                    "coefficient"
                )
            self.set(border.FIRST_LENS + slot, value, default, 1.0)


def corner_shift(camera: GivenCamera, slot: int) -> float:
    """How far one unit of a coefficient moves the image corner, as a share of its
    distance from the centre."""
    if _radial(camera) is _SHAPE:
        return _shape_shift(camera.lens, camera.size_px, slot)
    powers = {slot: power for chain in _radial(camera) for slot, power in chain.items()}
    corner = float(np.hypot(*camera.size_px)) / 2.0 / float(camera.lens[FX])
    return corner ** powers.get(slot, 2)


def _shape_shift(lens: Array, size_px: tuple[int, int], slot: int) -> float:
    """The same of a lens whose numbers are no coefficients, by its derivative."""
    from uwsfm.models.lens import NUM_PARAMS, dir_from_img, jac_by_params

    corner = float(np.hypot(*size_px)) / 2.0
    x, _, z = dir_from_img(lens[CX] + corner, lens[CY], lens)
    if not z > 0.0:  # as far as it sees
        x, _, z = dir_from_img(lens[CX] + 0.5 * min(size_px), lens[CY], lens)
    jac = np.empty((2, NUM_PARAMS))
    jac_by_params(x / z, 0.0, lens, jac)
    return float(abs(jac[0, slot])) / corner


def _couple_lenses(
    cameras: Sequence[GivenCamera], stddevs: Array, covariance: Array
) -> None:
    for c, camera in enumerate(cameras):
        pairs = [(0, 1, FX_AGAINST_FY if 1 in camera.slots else 1.0)]
        for chain in _radial(camera):
            slots = [slot for slot in chain if slot in camera.slots]
            pairs += [
                (i, j, NEXT_COEFFICIENT ** (n + 1))
                for at, i in enumerate(slots)
                for n, j in enumerate(slots[at + 1 :])
            ]
        for i, j, value in pairs:
            slot = border.FIRST_LENS + np.array([i, j])
            a, b = c * border.BORDER_SIZE + slot
            both = value * stddevs[c, slot[0]] * stddevs[c, slot[1]]
            covariance[a, b] = covariance[b, a] = both


def _couple_water(
    cameras: Sequence[GivenCamera], stddevs: Array, covariance: Array
) -> None:
    """Ports in one water err together."""
    slot, column = WATER_INDEX.first, WATER_INDEX.column
    for j, second in enumerate(cameras):
        for i, first in enumerate(cameras[:j]):
            if (
                second.port.refracts
                and first.port_row[column] == second.port_row[column]
            ):
                a, b = (k * border.BORDER_SIZE + slot for k in (i, j))
                both = stddevs[i, slot] * stddevs[j, slot]
                covariance[a, b] = covariance[b, a] = both


def _replace_named(
    cameras: Sequence[GivenCamera],
    rig: RigAccuracy,
    covariance: Array,
    assumed: NDArray[np.bool_],
) -> None:
    """Put a named covariance in the place of the single deviations."""
    named = rig.covariance
    assert named is not None
    onto = steps_of_names(cameras, named.names)
    touched = np.flatnonzero(np.any(onto != 0.0, axis=1))
    covariance[touched] = 0.0
    covariance[:, touched] = 0.0
    covariance += onto @ named.matrix @ onto.T
    assumed.reshape(-1)[touched] = False

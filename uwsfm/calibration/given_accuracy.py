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
from uwsfm.errors import InputError
from uwsfm.geometry.rigid3 import Array
from uwsfm.models.lens_row import CX, CY, FX
from uwsfm.models.ports.kind import Port
from uwsfm.models.ports.row import DISTANCE, N_WATER, RADIUS, THICKNESS
from uwsfm.residuals import border

FOCAL = 1e-3
"""Relative. Two calibrations in air of one lens differ by so much, or by more."""
PRINCIPAL_POINT_PX = 1.0
"""Per coordinate; the same comparison."""
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
GLASS_INDEX = 0.01
"""Between kinds of glass, or of acrylic."""
THICKNESS_SHARE, THICKNESS_M = 0.1, 5e-4
"""The larger of the two: data sheets promise 10 %, a calliper 0.5 mm."""
RADIUS_SHARE = 0.02
"""Of a dome's radius: 1 mm of 50."""
WATER_INDEX = 0.002
"""15 degrees of temperature, or 10 g/kg of salt."""
BASELINE_SHARE = 0.005
"""1 mm of 200: a stereo calibration, or a careful ruler."""
NORMAL_DEG = 2.0
"""RMS angle of a held normal: ports are mounted no better."""
DISTANCE_SHARE, DISTANCE_M = 0.2, 2e-3
"""The larger of the two, of a held port distance: the entrance pupil is not visible."""
CENTER_M = 2e-3
"""Per coordinate, of a held dome centre: the same."""
ROTATION_DEG = 0.1
"""Per axis, of a held cam_from_rig."""
DIRECTION_DEG = 0.1
"""Per component, of the direction of its translation."""

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
    and deviations, only on the verdict, for which it is a claim.
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
        rig = replace(
            rig, baseline_m=rig.baseline_m or 0.0, water_index=rig.water_index or 0.0
        )
    size = border.BORDER_SIZE
    stddevs = np.zeros((len(cameras), size))
    assumed = np.zeros((len(cameras), size), dtype=bool)
    for c, camera in enumerate(cameras):
        _lens(camera, stddevs[c], assumed[c])
        _port(camera, stddevs[c], assumed[c])
        if camera.port.refracts:
            _set(
                stddevs[c], assumed[c], border.WATER_INDEX, rig.water_index, WATER_INDEX
            )
        if c > 0:
            _placement(camera, rig, baseline_m, stddevs[c], assumed[c])
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


def _set(
    stddevs: Array,
    assumed: NDArray[np.bool_],
    slot: int | slice,
    given: float | None,
    default: float,
    factor: float = 1.0,
) -> None:
    stddevs[slot] = factor * (default if given is None else given)
    assumed[slot] = given is None


def _lens(camera: GivenCamera, stddevs: Array, assumed: NDArray[np.bool_]) -> None:
    accuracy, lens, first = camera.accuracy, camera.lens, border.FIRST_LENS
    for slot in (0, 1):
        _set(stddevs, assumed, first + slot, accuracy.focal, FOCAL, float(lens[slot]))
    for slot in (2, 3):
        _set(
            stddevs,
            assumed,
            first + slot,
            accuracy.principal_point_px,
            PRINCIPAL_POINT_PX,
        )
    coefficients = [slot for slot in camera.slots if slot > 3]
    given = accuracy.distortion
    if given is not None and len(given) != len(coefficients):
        names = ", ".join(camera.param_names[-len(coefficients) :] or ("none",))
        raise InputError(
            f"camera {camera.name!r}: accuracy.distortion has {len(given)} values, its "
            f"lens model has {len(coefficients) or 'no'} coefficients ({names})"
        )
    radial = {slot for chain in _radial(camera) for slot in chain}
    for k, slot in enumerate(coefficients):
        reach = corner_shift(camera, slot)
        # A number that moves nothing, as beta of EUCM with alpha zero, is known.
        radially = CORNER / reach if reach > 0.0 else 0.0
        default = radially if slot in radial else TANGENTIAL
        value = None if given is None else given[k]
        moved = (value or 0.0) * reach
        if moved > MAX_CORNER:
            raise InputError(
                f"camera {camera.name!r}: accuracy.distortion[{k}] is {value:g}, which "
                f"would move the image corner by {1e2 * moved:.0f} % of its distance "
                "from the centre; it is one standard deviation of the coefficient"
            )
        _set(stddevs, assumed, first + slot, value, default)


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


def _port(camera: GivenCamera, stddevs: Array, assumed: NDArray[np.bool_]) -> None:
    accuracy, row = camera.accuracy, camera.port_row
    kind = camera.port
    if kind.has("thickness"):
        thickness = max(THICKNESS_SHARE * float(row[THICKNESS]), THICKNESS_M)
        _set(stddevs, assumed, border.THICKNESS, accuracy.thickness_m, thickness)
        _set(stddevs, assumed, border.GLASS_INDEX, accuracy.glass_index, GLASS_INDEX)
    if kind.has("radius"):
        radius = RADIUS_SHARE * float(row[RADIUS])
        _set(stddevs, assumed, border.RADIUS, accuracy.radius_m, radius)
    if kind.has("center"):
        _set(stddevs, assumed, border.CENTER, accuracy.center_m, CENTER_M)
    if kind.has("distance"):
        distance = max(DISTANCE_SHARE * float(row[DISTANCE]), DISTANCE_M)
        _set(stddevs, assumed, border.DISTANCE, accuracy.distance_m, distance)
    if kind.has("normal"):
        # The RMS angle is sqrt(2) of its two components.
        tilt = float(np.radians(1.0) / np.sqrt(2.0))
        _set(stddevs, assumed, border.NORMAL, accuracy.normal_deg, NORMAL_DEG, tilt)


def _placement(
    camera: GivenCamera,
    rig: RigAccuracy,
    baseline_m: float | None,
    stddevs: Array,
    assumed: NDArray[np.bool_],
) -> None:
    accuracy, radian = camera.accuracy, float(np.radians(1.0))
    length = float(np.linalg.norm(camera.translation)) or baseline_m or 0.0
    _set(stddevs, assumed, border.ROTATION, accuracy.rotation_deg, ROTATION_DEG, radian)
    _set(
        stddevs,
        assumed,
        border.DIRECTION,
        accuracy.direction_deg,
        DIRECTION_DEG,
        radian,
    )
    _set(stddevs, assumed, border.LENGTH, rig.baseline_m, BASELINE_SHARE * length)


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
    slot = border.WATER_INDEX
    for j, second in enumerate(cameras):
        for i, first in enumerate(cameras[:j]):
            if (
                second.port.refracts
                and first.port_row[N_WATER] == second.port_row[N_WATER]
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

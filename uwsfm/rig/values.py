"""What the numbers of a rig may be: each check returns its value or raises InputError.

They catch what people get wrong: millimetres for metres, flipped signs, lost digits.
"""

from __future__ import annotations

import math
from contextvars import ContextVar
from pathlib import PurePosixPath, PureWindowsPath

import numpy as np

from uwsfm.calibration.parameters import PARAMETERS
from uwsfm.errors import InputError

UNIT_TOLERANCE = 1e-9
"""Quaternions and normals nearer to unit length than this are taken as they are."""
# Hand-copied unit vectors and rotations have few decimals; more than this is a mistake.
_COPY_TOLERANCE = 1e-3


IMPLAUSIBLE_ALLOWED: ContextVar[bool] = ContextVar("IMPLAUSIBLE_ALLOWED", default=False)
"""Whether numbers are read that no person would type: lengths without a unit, and
estimates of an adjustment, which end wherever the images take them."""


def _checked_metres(value: float, noun: str, plural: str, limit: float) -> float:
    """Refuses negative lengths, and millimetres taken for metres."""
    if value < 0:
        raise InputError(f"{value:g} m is negative; a {noun} cannot be")
    if value > limit and not IMPLAUSIBLE_ALLOWED.get():
        guesses = [
            f"{np.format_float_positional(float(f'{value / per:.6g}'), min_digits=3)} "
            f"(as {unit})"
            for unit, per in (("millimetres", 1000.0), ("centimetres", 100.0))
            if value / per <= limit
        ]
        raise InputError(
            f"{value:g} m is not a {noun}; {plural} are in metres, "
            f"did you mean {' or '.join(guesses) or 'another number'}?"
        )
    return value


def checked_port_distance(value: float, limit: float) -> float:
    """From the camera to the glass or the water, metres.

    Args:
        value: what is given.
        limit: ``max_distance_m`` of the kind of port.
    """
    return _checked_metres(value, "port distance", "distances", limit)


def checked_center(values: tuple[float, ...]) -> tuple[float, ...]:
    """The centre of a dome (3,), metres."""
    _checked_metres(math.hypot(*values), "distance of a dome's centre", "centres", 0.5)
    return values


def checked_radius(value: float) -> float:
    """The inner radius of a dome, metres."""
    if value == 0:
        raise InputError("a dome of radius zero holds no camera")
    return _checked_metres(value, "dome radius", "radii", 1.0)


def checked_thickness(value: float) -> float:
    """Of the glass, metres."""
    return _checked_metres(value, "glass thickness", "thicknesses", 0.5)


def checked_baseline(value: float) -> float:
    """Between two cameras, metres."""
    if value == 0:
        raise InputError("a baseline of length zero gives no scale")
    return _checked_metres(value, "baseline", "baselines", 10.0)


def checked_index(value: float) -> float:
    """A refractive index of water, glass or plastic."""
    if not 1 <= value <= (4.0 if IMPLAUSIBLE_ALLOWED.get() else 2.5):
        raise InputError(
            f"{value:g} is not a refractive index; expected 1 to 2.5 "
            "(water about 1.33, acrylic 1.49, glass 1.46 to 1.52)"
        )
    return value


def checked_unit(values: tuple[float, ...]) -> tuple[float, ...]:
    """A vector or quaternion of unit length, made exact if it was rounded."""
    length = math.hypot(*values)
    if abs(length - 1) > _COPY_TOLERANCE:
        raise InputError(f"must have length 1, has length {length:.4g}")
    if abs(length - 1) <= UNIT_TOLERANCE:
        return values
    return tuple(value / length for value in values)


def checked_normal(values: tuple[float, ...]) -> tuple[float, ...]:
    """A port normal (3,), which goes from the camera to the water."""
    if not any(values):
        raise InputError("has no length: 0, 0, 1 is the optical axis")
    if values[2] <= 0:
        raise InputError(
            "points back at the camera (its z must be positive): the normal goes from "
            "the camera to the water, is its sign flipped?"
        )
    return checked_unit(values)


def checked_rotation(
    rows: tuple[tuple[float, ...], ...],
) -> tuple[tuple[float, ...], ...]:
    """A rotation matrix (3, 3), as its rows."""
    matrix = np.array(rows)
    off = np.max(np.abs(matrix @ matrix.T - np.eye(3)))
    if not off <= _COPY_TOLERANCE:
        raise InputError(
            "is not a rotation: rows must have length 1 and be perpendicular, they are "
            f"off by {off:.2g}"
        )
    if np.linalg.det(matrix) < 0:
        raise InputError("is a reflection (determinant -1), not a rotation")
    return rows


def checked_text(value: str) -> str:
    """A name: one line, not blank."""
    if not value.strip() or not value.isprintable():
        raise InputError(f"must be one line of text, not {value!r}")
    return value


def checked_folder(value: str) -> str:
    """A folder inside the image directory, with forward slashes and no dots."""
    path = PurePosixPath(checked_text(value))
    if "\\" in value:
        raise InputError(f"write {value!r} with forward slashes")
    absolute = path.is_absolute() or PureWindowsPath(value).drive
    if absolute or ".." in path.parts or not path.parts:
        raise InputError(f"{value!r} must be a folder inside the image directory")
    return str(path)


ACCURACIES: dict[str, tuple[float, str]] = {
    each.accuracy.key: (each.accuracy.most, each.accuracy.unit)
    for each in PARAMETERS
    if each.accuracy is not None and math.isfinite(each.accuracy.most)
}
"""Accuracies that a person may state: what each stays below, and its unit. Per cent,
pixels or millimetres in the place of that unit lie beyond. Distortion coefficients have
no common size: `uwsfm.calibration.given_accuracy` asks how far they move the corner."""


def checked_accuracy(key: str, value: object) -> None:
    """Refuse a standard deviation that must be in another unit.

    Args:
        key: of a rig file's "accuracy", or of a prior ("focal_stddev" is "focal").
        value: anything but a number passes.
    """
    most, unit = ACCURACIES.get(key.replace("_stddev", ""), (math.inf, ""))
    if not isinstance(value, float) or value < most or IMPLAUSIBLE_ALLOWED.get():
        return
    raise InputError(
        f"{value:g} is no plausible standard deviation; it is given {unit}, and must "
        f"be less than {most:g}"
    )

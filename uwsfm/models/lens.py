"""In-air lenses: from a viewing direction to a pixel and back, with the Jacobian.

Every Brown model of COLMAP is FULL_OPENCV with zeros, and every fisheye OPENCV_FISHEYE;
the other kinds are in `uwsfm.models.lens_wide`. A lens is one row of LENS_SIZE numbers

    [fx, fy, cx, cy, k1, k2, p1, p2, k3, k4, k5, k6, kind, limit]

where ``kind`` is one of `KINDS` and ``limit`` is the largest squared radius (of a
fisheye: angle) up to which the radial distortion grows: beyond it a second, false ray
would share the pixel. Pixels follow COLMAP: the first one's centre is (0.5, 0.5).
"""

import math
from collections.abc import Sequence
from typing import Final

import numpy as np

from uwsfm._base.jit import inner, lane
from uwsfm.errors import InputError
from uwsfm.geometry.rigid3 import Array
from uwsfm.models.lens_row import (
    CX,
    CY,
    DISTORTION,
    FX,
    FY,
    K1,
    K2,
    K3,
    K4,
    K5,
    K6,
    KIND,
    LENS_SIZE,
    LIMIT,
    NUM_PARAMS,
    P1,
    P2,
)
from uwsfm.models.lens_wide import (
    EUCM,
    FOV,
    THIN_PRISM,
    dir_from_wide,
    distort_wide,
    scaled,
    wide_by_params,
    wide_limit,
)

PINHOLE: Final = 0
BROWN: Final = 1
FISHEYE: Final = 2
_ALL = tuple(range(NUM_PARAMS))

# The kind of each COLMAP model, and where it keeps its parameters in the common row.
_MODELS: dict[str, tuple[int, tuple[int, ...]]] = {
    "SIMPLE_PINHOLE": (BROWN, (0, 2, 3)),
    "PINHOLE": (BROWN, (0, 1, 2, 3)),
    "SIMPLE_RADIAL": (BROWN, (0, 2, 3, 4)),
    "RADIAL": (BROWN, (0, 2, 3, 4, 5)),
    "OPENCV": (BROWN, (0, 1, 2, 3, 4, 5, 6, 7)),
    "FULL_OPENCV": (BROWN, _ALL),
    "SIMPLE_RADIAL_FISHEYE": (FISHEYE, (0, 2, 3, 4)),
    "RADIAL_FISHEYE": (FISHEYE, (0, 2, 3, 4, 5)),
    "OPENCV_FISHEYE": (FISHEYE, (0, 1, 2, 3, 4, 5, 8, 9)),
    "THIN_PRISM_FISHEYE": (THIN_PRISM, _ALL),
    "FOV": (FOV, (0, 1, 2, 3, 4)),
    "EUCM": (EUCM, (0, 1, 2, 3, 4, 5)),
}
SUPPORTED_MODELS = tuple(_MODELS)
KINDS = (PINHOLE, BROWN, FISHEYE, FOV, EUCM, THIN_PRISM)
ANGLE_KINDS = (FISHEYE, THIN_PRISM)
"""Their radial coefficients are of the angle, and so is their ``limit``."""


def param_slots(model: str) -> tuple[int, ...]:
    """Where the parameters of a COLMAP model are in its lens row; fx may be fy too."""
    return _MODELS[model][1]


def lens_row(model: str, params: Sequence[float] | Array) -> Array:
    """The row (LENS_SIZE,) of a COLMAP camera model and its parameters.

    Raises:
        InputError: the model has no kernel here, or the parameters do not fit it.
    """
    if model not in _MODELS:
        raise InputError(
            f"camera model {model} has no projection here; "
            f"use one of {', '.join(SUPPORTED_MODELS)}"
        )
    kind, slots = _MODELS[model]
    values = np.asarray(params, dtype=np.float64)
    if values.shape != (len(slots),) or not np.all(np.isfinite(values)):
        raise InputError(
            f"camera model {model} takes {len(slots)} finite parameters, "
            f"got {values.tolist()}"
        )
    row = np.zeros(LENS_SIZE)
    row[list(slots)] = values
    if 1 not in slots:
        row[FY] = row[FX]
    if row[FX] <= 0.0 or row[FY] <= 0.0:
        raise InputError(f"camera model {model}: the focal length must be positive")
    row[KIND] = kind
    row = with_limit(row)
    if not row[LIMIT] > 0.0:
        raise InputError(
            f"camera model {model}: {values[4:].tolist()} are no parameters of such a "
            "lens (FOV: 0 < omega < pi; EUCM: alpha >= 0, beta > 0)"
        )
    return row


def with_limit(row: Array) -> Array:
    """A lens row with ``kind`` and ``limit`` as its parameters demand."""
    row = row.copy()
    if row[KIND] not in KINDS:
        raise InputError(f"{row[KIND]:g} is no kind of lens")
    if row[KIND] in ANGLE_KINDS:
        row[LIMIT] = _fisheye_limit(row)
    elif row[KIND] in (FOV, EUCM):
        row[LIMIT] = wide_limit(row)
    else:
        row[KIND] = BROWN if np.any(row[DISTORTION] != 0.0) else PINHOLE
        row[LIMIT] = _brown_limit(row)
    return row


def _smallest_positive_root(coefficients: Array) -> float:
    """The smallest positive real root of a polynomial, lowest power first; or inf."""
    trimmed = np.trim_zeros(np.asarray(coefficients, dtype=np.float64), "b")
    if len(trimmed) < 2:
        return math.inf
    roots = np.polynomial.polynomial.polyroots(trimmed)
    real = roots[np.abs(roots.imag) <= 1e-9 * np.abs(roots)].real
    positive = real[real > 0.0]
    return float(positive.min()) if len(positive) else math.inf


def _brown_limit(row: Array) -> float:
    """Smallest s = r^2 where d(r N(s) / D(s)) / dr = 0 or the denominator vanishes."""
    num = np.array([1.0, row[K1], row[K2], row[K3]])
    den = np.array([1.0, row[K4], row[K5], row[K6]])
    poly = np.polynomial.polynomial
    slope = poly.polymul(poly.polyder(num), den)
    slope = poly.polysub(slope, poly.polymul(num, poly.polyder(den)))
    turning = poly.polyadd(poly.polymul(num, den), poly.polymul([0.0, 2.0], slope))
    return min(_smallest_positive_root(turning), _smallest_positive_root(den))


def _fisheye_limit(row: Array) -> float:
    """Smallest angle where d(theta_d) / d(theta) = 0, at most 90 degrees."""
    k1, k2, k3, k4 = row[K1], row[K2], row[K3], row[K4]
    square = _smallest_positive_root(np.array([1, 3 * k1, 5 * k2, 7 * k3, 9 * k4]))
    return min(math.sqrt(square), 0.5 * math.pi)


@inner
def distort(u, v, lens):
    """Distorted (u, v), and d(distorted) / d(u, v) as 4 scalars; NaN out of range."""
    if lens[KIND] == PINHOLE:
        return u, v, 1.0, 0.0, 0.0, 1.0
    if lens[KIND] == BROWN:
        return _distort_brown(u, v, lens)
    if lens[KIND] == FISHEYE:
        return _distort_fisheye(u, v, lens)
    return distort_wide(u, v, lens)


@lane
def coefficients(lens):
    """Distortion parameters of a row, as a tuple (k1, k2, p1, p2, k3, k4, k5, k6)."""
    return (
        lens[K1],
        lens[K2],
        lens[P1],
        lens[P2],
        lens[K3],
        lens[K4],
        lens[K5],
        lens[K6],
    )


@lane
def brown(u, v, params):
    """Brown's distortion, whatever the range: (x, y) and d(x, y) / d(u, v): 6 scalars.

    The Jacobian is symmetric: (x, y, x_u, x_v, y_v, determinant).
    """
    k1, k2, p1, p2, k3, k4, k5, k6 = params
    s = u * u + v * v
    num = 1.0 + s * (k1 + s * (k2 + s * k3))
    inv_den = 1.0 / (1.0 + s * (k4 + s * (k5 + s * k6)))
    num_s = k1 + s * (2.0 * k2 + s * 3.0 * k3)
    den_s = k4 + s * (2.0 * k5 + s * 3.0 * k6)
    radial = num * inv_den
    radial_s = (num_s - radial * den_s) * inv_den
    x = u * radial + 2.0 * p1 * u * v + p2 * (s + 2.0 * u * u)
    y = v * radial + 2.0 * p2 * u * v + p1 * (s + 2.0 * v * v)
    xu = radial + 2.0 * u * u * radial_s + 2.0 * p1 * v + 6.0 * p2 * u
    xv = 2.0 * u * v * radial_s + 2.0 * p1 * u + 2.0 * p2 * v
    yv = radial + 2.0 * v * v * radial_s + 6.0 * p1 * v + 2.0 * p2 * u
    return x, y, xu, xv, yv, xu * yv - xv * xv


@inner
def _distort_brown(u, v, lens):
    x, y, xu, xv, yv, det = brown(u, v, coefficients(lens))
    # Tangential terms fold it a little earlier than the limit of the radial ones.
    if not (u * u + v * v < lens[LIMIT] and det > 0.0):
        return math.nan, math.nan, math.nan, math.nan, math.nan, math.nan
    return x, y, xu, xv, xv, yv


@lane
def fisheye_angle(theta, params):
    """theta_d and its derivative: theta (1 + k1 t^2 + k2 t^4 + k3 t^6 + k4 t^8)."""
    k1, k2, _, _, k3, k4, _, _ = params
    s = theta * theta
    value = theta * (1.0 + s * (k1 + s * (k2 + s * (k3 + s * k4))))
    slope = 1.0 + s * (3.0 * k1 + s * (5.0 * k2 + s * (7.0 * k3 + s * 9.0 * k4)))
    return value, slope


@inner
def _distort_fisheye(u, v, lens):
    s = u * u + v * v
    radius = math.sqrt(s)
    theta = math.atan(radius)
    if not theta < lens[LIMIT]:
        return math.nan, math.nan, math.nan, math.nan, math.nan, math.nan
    if radius < 1e-8:  # theta_d / r = 1 + O(r^2) to rounding
        return u, v, 1.0, 0.0, 0.0, 1.0
    value, slope = fisheye_angle(theta, coefficients(lens))
    scale = value / radius
    # d(scale) / d(radius) / radius
    scale_r = (slope / (1.0 + s) - scale) / s
    return scaled(u, v, scale, scale_r)


@inner
def jac_by_params(u, v, lens, jac):
    """d(pixel) / d(fx, fy, cx, cy, k1, k2, p1, p2, k3 .. k6), (2, 12), written.

    Args:
        u, v: x / z and y / z of a direction within the range of the lens.
    """
    ud, vd, _, _, _, _ = distort(u, v, lens)
    fx, fy = lens[FX], lens[FY]
    jac[0, 0], jac[1, 0], jac[0, 1], jac[1, 1] = ud, 0.0, 0.0, vd
    jac[0, 2], jac[1, 2], jac[0, 3], jac[1, 3] = 1.0, 0.0, 0.0, 1.0
    if lens[KIND] > FISHEYE:
        wide_by_params(u, v, lens, jac)
        return
    s = u * u + v * v
    if lens[KIND] == FISHEYE:
        radius = math.sqrt(s)
        theta = math.atan(radius)
        power = 1.0 if radius < 1e-8 else theta / radius
        s = theta * theta
        for k in range(4, 12):
            jac[0, k], jac[1, k] = 0.0, 0.0
        for k in (4, 5, 8, 9):
            power *= s
            jac[0, k], jac[1, k] = fx * u * power, fy * v * power
        return
    den = 1.0 + s * (lens[K4] + s * (lens[K5] + s * lens[K6]))
    radial = (1.0 + s * (lens[K1] + s * (lens[K2] + s * lens[K3]))) / den
    power = s / den
    for k, m in ((4, 9), (5, 10), (8, 11)):
        jac[0, k], jac[1, k] = fx * u * power, fy * v * power
        jac[0, m], jac[1, m] = -fx * u * power * radial, -fy * v * power * radial
        power *= s
    jac[0, 6], jac[1, 6] = fx * 2.0 * u * v, fy * (s + 2.0 * v * v)
    jac[0, 7], jac[1, 7] = fx * (s + 2.0 * u * u), fy * 2.0 * u * v


@inner
def img_from_dir(x, y, z, lens):
    """Pixel of a direction in the camera frame, and d(pixel) / d(x, y, z).

    Returns:
        (px, py, J11, J12, J13, J21, J22, J23); NaN behind the camera or out of the
        range of the lens.
    """
    nan = math.nan
    if not z > 0.0:
        return nan, nan, nan, nan, nan, nan, nan, nan
    inv_z = 1.0 / z
    u, v = x * inv_z, y * inv_z
    ud, vd, a11, a12, a21, a22 = distort(u, v, lens)
    fx, fy = lens[FX] * inv_z, lens[FY] * inv_z
    return (
        lens[FX] * ud + lens[CX],
        lens[FY] * vd + lens[CY],
        fx * a11,
        fx * a12,
        -fx * (a11 * u + a12 * v),
        fy * a21,
        fy * a22,
        -fy * (a21 * u + a22 * v),
    )


@inner
def dir_from_img(px, py, lens):
    """Unit direction in the camera frame of a pixel; NaN where none exists."""
    nan = math.nan
    xd = (px - lens[CX]) / lens[FX]
    yd = (py - lens[CY]) / lens[FY]
    if lens[KIND] == FISHEYE:
        return _dir_from_fisheye(xd, yd, lens)
    if lens[KIND] > FISHEYE:
        return dir_from_wide(xd, yd, lens)
    u, v = xd, yd
    if lens[KIND] == BROWN:
        u, v = _undistort_brown(xd, yd, lens)
    norm = math.sqrt(1.0 + u * u + v * v)
    if not norm < math.inf:
        return nan, nan, nan
    return u / norm, v / norm, 1.0 / norm


@inner
def _undistort_brown(xd, yd, lens):
    """Newton on the distortion, halved where it would leave the invertible disc."""
    u, v = xd, yd
    s = u * u + v * v
    if not s < 0.81 * lens[LIMIT]:  # near the limit the slope is too flat to start from
        shrink = 0.9 * math.sqrt(lens[LIMIT] / s)
        u, v = u * shrink, v * shrink
    for _ in range(60):
        x, y, a11, a12, a21, a22 = distort(u, v, lens)
        ex, ey = x - xd, y - yd
        det = a11 * a22 - a12 * a21
        du, dv = (a22 * ex - a12 * ey) / det, (a11 * ey - a21 * ex) / det
        step = 1.0
        while not (u - step * du) ** 2 + (v - step * dv) ** 2 < lens[LIMIT]:
            step *= 0.5
            if step < 1e-3:
                return math.nan, math.nan
        u, v = u - step * du, v - step * dv
        # Quadratic: a step of 1e-12 was the last; less drowns in rounding where flat.
        if du * du + dv * dv <= 1e-24 * (1.0 + u * u + v * v) and step == 1.0:
            return u, v
    return math.nan, math.nan


@inner
def _dir_from_fisheye(xd, yd, lens):
    nan = math.nan
    target = math.sqrt(xd * xd + yd * yd)
    if target < 1e-12:
        return xd, yd, 1.0
    limit, _ = fisheye_angle(lens[LIMIT], coefficients(lens))
    if not target < limit:
        return nan, nan, nan
    low, high = 0.0, lens[LIMIT]
    theta = min(target, 0.5 * (low + high))
    for _ in range(100):  # monotonic up to the limit: Newton inside a bracket
        value, slope = fisheye_angle(theta, coefficients(lens))
        if value > target:
            high = theta
        else:
            low = theta
        moved = theta - (value - target) / slope
        if not low <= moved <= high:
            moved = 0.5 * (low + high)
        if abs(moved - theta) <= 1e-15 * theta:
            theta = moved
            break
        theta = moved
    scale = math.sin(theta) / target
    return xd * scale, yd * scale, math.cos(theta)

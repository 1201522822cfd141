"""Lenses of wide angles beside the fisheye: field of view, enhanced unified, prisms.

Rows are those of `uwsfm.models.lens`; where a model keeps its numbers is in its table:

- FOV (Devernay & Faugeras 2001): omega at k1;
- EUCM, the enhanced unified camera (Khomutenko et al. 2016): alpha at k1, beta at k2;
- THIN_PRISM (Weng et al. 1992, on the angle of a fisheye): k1, k2, p1, p2, k3, k4 in
  their places, sx1 and sy1 at k5 and k6.

They run in scalar kernels only: over lanes every row is left to those.
"""

import math
from typing import Final

from uwsfm._base.jit import inner
from uwsfm.geometry.rigid3 import Array
from uwsfm.models.lens_row import (
    ALPHA,
    BETA,
    FX,
    FY,
    K1,
    K2,
    K3,
    K4,
    KIND,
    LIMIT,
    OMEGA,
    P1,
    P2,
    SX,
    SY,
)

FOV: Final = 3
EUCM: Final = 4
THIN_PRISM: Final = 5
_NEAR: Final = 0.02
"""Of r tan(omega / 2) 2: a series of four terms is exact to rounding below it."""


def fov_limit(row: Array) -> float:
    """Squared radius up to which a lens of this kind is one to one: any."""
    return math.inf if 0.0 < row[OMEGA] < math.pi else 0.0


def eucm_limit(row: Array) -> float:
    """Where d(r / d) / dr = 0, d = alpha sqrt(beta r^2 + 1) + 1 - alpha: squared r."""
    alpha, beta = row[ALPHA], row[BETA]
    if not (alpha >= 0.0 and beta > 0.0):
        return 0.0
    if alpha <= 1.0:
        return math.inf
    return float(((alpha / (alpha - 1.0)) ** 2 - 1.0) / beta)


@inner
def distort_wide(u, v, lens):
    """As `uwsfm.models.lens.distort`, of the kinds of this module."""
    nan = math.nan
    s = u * u + v * v
    if lens[KIND] == THIN_PRISM:
        return _thin_prism(u, v, lens)
    if not s < lens[LIMIT]:
        return nan, nan, nan, nan, nan, nan
    if lens[KIND] == FOV:
        scale, scale_r, _ = _fov_scale(s, lens)
    else:
        q = math.sqrt(lens[BETA] * s + 1.0)
        scale = 1.0 / (lens[ALPHA] * q + 1.0 - lens[ALPHA])
        scale_r = -lens[ALPHA] * lens[BETA] / q * scale * scale
    return scaled(u, v, scale, scale_r)


@inner
def scaled(u, v, scale, scale_r):
    """(u, v) scaled by a function of their radius, and the derivatives as 4 scalars.

    Args:
        u, v: place.
        scale: the factor there.
        scale_r: its derivative by the radius, over the radius.
    """
    xv = u * v * scale_r
    return (
        u * scale,
        v * scale,
        scale + u * u * scale_r,
        xv,
        xv,
        scale + v * v * scale_r,
    )


@inner
def _fov_scale(s, lens):
    """atan(r t) / (r omega) with t = 2 tan(omega / 2), s = r^2; its derivatives by r,
    over r, and by omega."""
    omega = lens[OMEGA]
    t = 2.0 * math.tan(0.5 * omega)
    x2 = s * t * t
    slope = 1.0 / (1.0 + x2)
    if x2 < _NEAR * _NEAR:
        value = 1.0 - x2 * (1.0 / 3.0 - x2 * (0.2 - x2 * (1.0 / 7.0 - x2 / 9.0)))
        bend = -2.0 / 3.0 + x2 * (0.8 - x2 * (6.0 / 7.0 - x2 * 8.0 / 9.0))
    else:
        x = math.sqrt(x2)
        value = math.atan(x) / x
        bend = (slope - value) / x2
    scale = value * t / omega
    by_omega = ((1.0 + 0.25 * t * t) * slope - scale) / omega
    return scale, bend * t * t * t / omega, by_omega


@inner
def _prism_plane(u, v):
    """Coordinates on the plane of angles, equidistant, and derivatives as 4 scalars."""
    s = u * u + v * v
    radius = math.sqrt(s)
    scale, scale_r = 1.0 - s / 3.0, -2.0 / 3.0
    if radius > 1e-4:
        scale = math.atan(radius) / radius
        scale_r = (1.0 / (1.0 + s) - scale) / s
    return scaled(u, v, scale, scale_r)


@inner
def _prism(a, b, lens):
    """Distorted (a, b) of the plane of angles, and derivatives as 4 scalars."""
    k1, k2, p1, p2, k3, k4 = lens[K1], lens[K2], lens[P1], lens[P2], lens[K3], lens[K4]
    sx, sy = lens[SX], lens[SY]
    s = a * a + b * b
    radial = 1.0 + s * (k1 + s * (k2 + s * (k3 + s * k4)))
    radial_s = k1 + s * (2.0 * k2 + s * (3.0 * k3 + s * 4.0 * k4))
    x = a * radial + 2.0 * p1 * a * b + p2 * (s + 2.0 * a * a) + sx * s
    y = b * radial + 2.0 * p2 * a * b + p1 * (s + 2.0 * b * b) + sy * s
    cross = 2.0 * a * b * radial_s + 2.0 * p1 * a + 2.0 * p2 * b
    xa = radial + 2.0 * a * a * radial_s + 2.0 * p1 * b + (6.0 * p2 + 2.0 * sx) * a
    yb = radial + 2.0 * b * b * radial_s + 2.0 * p2 * a + (6.0 * p1 + 2.0 * sy) * b
    return x, y, xa, cross + 2.0 * sx * b, cross + 2.0 * sy * a, yb


@inner
def _thin_prism(u, v, lens):
    nan = math.nan
    a, b, au, av, _, bv = _prism_plane(u, v)
    x, y, xa, xb, ya, yb = _prism(a, b, lens)
    if not (a * a + b * b < lens[LIMIT] * lens[LIMIT] and xa * yb - xb * ya > 0.0):
        return nan, nan, nan, nan, nan, nan
    return (
        x,
        y,
        xa * au + xb * av,
        xa * av + xb * bv,
        ya * au + yb * av,
        ya * av + yb * bv,
    )


@inner
def dir_from_wide(xd, yd, lens):
    """Unit direction of a distorted place; NaN where none leads there."""
    nan = math.nan
    s = xd * xd + yd * yd
    if lens[KIND] == THIN_PRISM:
        return _dir_from_prism(xd, yd, lens)
    if lens[KIND] == FOV:
        angle = math.sqrt(s) * lens[OMEGA]
        if not angle < 0.5 * math.pi:
            return nan, nan, nan
        z = 2.0 * math.tan(0.5 * lens[OMEGA])
        if angle > 1e-9:
            z *= math.sqrt(s) / math.tan(angle)
        else:
            z /= lens[OMEGA]
    else:
        alpha, beta = lens[ALPHA], lens[BETA]
        root = 1.0 - (2.0 * alpha - 1.0) * beta * s
        if not root >= 0.0:
            return nan, nan, nan
        z = (1.0 - beta * alpha * alpha * s) / (alpha * math.sqrt(root) + 1.0 - alpha)
        if not s < lens[LIMIT] * z * z:
            return nan, nan, nan
    if not z > 0.0:
        return nan, nan, nan
    norm = math.sqrt(s + z * z)
    return xd / norm, yd / norm, z / norm


@inner
def _dir_from_prism(xd, yd, lens):
    """Newton on the plane of angles, halved where it would leave the lens."""
    nan = math.nan
    a, b, limit2 = xd, yd, lens[LIMIT] * lens[LIMIT]
    s = a * a + b * b
    if not s < 0.81 * limit2:  # near the limit the slope is too flat to start from
        shrink = 0.9 * math.sqrt(limit2 / s)
        a, b = a * shrink, b * shrink
    for _ in range(60):
        x, y, xa, xb, ya, yb = _prism(a, b, lens)
        ex, ey, det = x - xd, y - yd, xa * yb - xb * ya
        if not det > 0.0:
            return nan, nan, nan
        da, db = (yb * ex - xb * ey) / det, (xa * ey - ya * ex) / det
        step = 1.0
        while not (a - step * da) ** 2 + (b - step * db) ** 2 < limit2:
            step *= 0.5
            if step < 1e-3:
                return nan, nan, nan
        a, b = a - step * da, b - step * db
        # Quadratic: a step of 1e-12 was the last; less drowns in rounding where flat.
        if da * da + db * db <= 1e-24 * (1.0 + a * a + b * b) and step == 1.0:
            theta = math.sqrt(a * a + b * b)
            scale = 1.0 if theta < 1e-9 else math.sin(theta) / theta
            return a * scale, b * scale, math.cos(theta)
    return nan, nan, nan


@inner
def wide_by_params(u, v, lens, jac):
    """Columns 4 to 11 of `uwsfm.models.lens.jac_by_params`, of the kinds here."""
    fx, fy = lens[FX], lens[FY]
    for k in range(4, 12):
        jac[0, k], jac[1, k] = 0.0, 0.0
    if lens[KIND] == THIN_PRISM:
        a, b, _, _, _, _ = _prism_plane(u, v)
        s = a * a + b * b
        power = s
        for k in (4, 5, 8, 9):
            jac[0, k], jac[1, k] = fx * a * power, fy * b * power
            power *= s
        jac[0, 6], jac[1, 6] = fx * 2.0 * a * b, fy * (s + 2.0 * b * b)
        jac[0, 7], jac[1, 7] = fx * (s + 2.0 * a * a), fy * 2.0 * a * b
        jac[0, 10], jac[1, 11] = fx * s, fy * s
        return
    s = u * u + v * v
    if lens[KIND] == FOV:
        _, _, by_omega = _fov_scale(s, lens)
        jac[0, 4], jac[1, 4] = fx * u * by_omega, fy * v * by_omega
        return
    q = math.sqrt(lens[BETA] * s + 1.0)
    scale = 1.0 / (lens[ALPHA] * q + 1.0 - lens[ALPHA])
    by_alpha, by_beta = (1.0 - q) * scale**2, -0.5 * lens[ALPHA] * s / q * scale**2
    jac[0, 4], jac[1, 4] = fx * u * by_alpha, fy * v * by_alpha
    jac[0, 5], jac[1, 5] = fx * u * by_beta, fy * v * by_beta


def wide_limit(row: Array) -> float:
    """``limit`` of a row of this module's kinds; of THIN_PRISM see the fisheye's."""
    return fov_limit(row) if row[KIND] == FOV else eucm_limit(row)

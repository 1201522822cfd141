"""Lenses calibrated the other way round: the polynomial undistorts.

Sedlazeck & Koch (BMVC 2011, section 3) apply the radial polynomial when undistorting
and iterate when distorting. With normalised distorted coordinates,

    (x_u, y_u) = (x_d, y_d) (1 + k1 s + k2 s^2 + k3 s^3),    s = x_d^2 + y_d^2,

which no camera model of COLMAP does: their polynomials distort. So one of them is
fitted to the inverse over the radii that the image holds, and the price is told.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.polynomial.polynomial import polyval
from numpy.typing import ArrayLike

from uwsfm.errors import InputError
from uwsfm.geometry.rigid3 import Array
from uwsfm.models.lens import lens_row

# A hundredth of a pixel drowns in the noise of any feature; a tenth does not.
_GOOD_PX, _ALLOWED_PX = 0.01, 0.1
# COLMAP model, terms of its numerator and denominator. The simplest comes first: its
# distortion grows farthest beyond the image, which COLMAP's own undistortion needs.
_CANDIDATES = (
    ("OPENCV", 2, 0),
    ("FULL_OPENCV", 3, 0),
    ("FULL_OPENCV", 3, 1),
    ("FULL_OPENCV", 3, 2),
    ("FULL_OPENCV", 3, 3),
)
_NUM_RADII = 400
_NUM_GRID = 301
_NUM_REWEIGHTS = 4
# The distortion must still grow a little beyond the corner, whose ray Newton looks for.
_LIMIT_MARGIN = 1.01
# No lens does this; coefficients that belong to a radius in another unit may.
_MAX_STRETCH = 1000.0


@dataclass(frozen=True)
class LensConversion:
    """A COLMAP camera in place of a radial undistortion."""

    model: str
    params: tuple[float, ...]
    """In the order of COLMAP's model."""
    max_px: float
    """Largest distance between a pixel and the projection of its true ray."""
    rms_px: float
    """The same, root mean square over the image."""


def convert_radial_undistortion(
    width: int, height: int, pinhole: Sequence[float], undistortion: Sequence[float]
) -> LensConversion:
    """The simplest COLMAP camera that sees as an undistorting polynomial does.

    Args:
        width: Of the image, pixels.
        height: Of the image, pixels.
        pinhole: fx, fy, cx, cy, pixels; pixel origin as COLMAP.
        undistortion: 1 to 3 values k1, k2, k3.

    Raises:
        InputError: a wrong number of values, a polynomial that is not one-to-one over
            the image, or one that no model follows to 0.1 px.
    """
    if not 1 <= len(undistortion) <= 3:
        raise InputError(f"undistortion has 1 to 3 values, got {len(undistortion)}")
    focal, center = np.array(pinhole[:2]), np.array(pinhole[2:])
    x, y = np.linspace(0, width, _NUM_GRID), np.linspace(0, height, _NUM_GRID)
    offset = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2) - center
    radii = np.linalg.norm(offset / focal, axis=1)
    _check_one_to_one(undistortion, float(radii.max()))
    # All that follows is radial: a wrong scale moves a pixel along its offset.
    scale = _scale(undistortion, radii)
    offset_px = np.linalg.norm(offset, axis=1)
    found = []
    for model, *terms in _CANDIDATES:
        num, den = _fitted_inverse(undistortion, float(radii.max()), *terms)
        params = _colmap_params(model, pinhole, num, den)
        s = (radii * scale) ** 2
        errors = offset_px * np.abs(polyval(s, num) / polyval(s, den) * scale - 1.0)
        if lens_row(model, params)[13] > _LIMIT_MARGIN * s.max():
            rms = float(np.sqrt(np.mean(errors**2)))
            found.append(LensConversion(model, params, float(errors.max()), rms))
        if found and found[-1].max_px < _GOOD_PX:
            return found[-1]
    best = min(found, key=lambda c: c.max_px, default=None)
    if best is None or not best.max_px <= _ALLOWED_PX:
        nearest = f"the nearest is off by {best.max_px:.2g} px" if best else "all fold"
        raise InputError(
            f"undistortion: no COLMAP model follows this polynomial to {_ALLOWED_PX:g} "
            f"px over the image, {nearest}"
        )
    return best


def _scale(undistortion: ArrayLike, radii: Array) -> Array:
    """Undistorted by distorted radius."""
    return polyval(radii**2, np.append(1.0, undistortion))


def _check_one_to_one(undistortion: Sequence[float], reach: float) -> None:
    """Refuse a polynomial that does not grow all the way to the farthest corner."""
    radii = np.linspace(0.0, reach, 10 * _NUM_RADII)
    odd = np.arange(3, 2 * len(undistortion) + 2, 2)
    with np.errstate(over="ignore", invalid="ignore"):
        slope = _scale(odd * undistortion, radii)  # of r (1 + k1 r^2 + k2 r^4 + ...)
    if np.any(slope <= 0.0):
        fold = radii[np.argmax(slope <= 0.0)]
        raise InputError(
            f"undistortion folds the image: it shrinks again {fold:.3g} focal lengths "
            f"from the principal point, and the farthest corner is at {reach:.3g}"
        )
    if not slope.max() < _MAX_STRETCH:
        raise InputError(
            f"undistortion stretches the image {slope.max():.2g}-fold at its border; "
            "its coefficients take the radius in focal lengths"
        )


def _fitted_inverse(
    undistortion: Sequence[float], reach: float, num_terms: int, den_terms: int
) -> tuple[Array, Array]:
    """Numerator and denominator, in powers of s, of distorted by undistorted radius.

    Linear least squares in r_d D(s) = r_u N(s); a denominator is then divided out with
    its last estimate (Sanathanan & Koerner 1963), so that radii count and not D.
    """
    # At Chebyshev's nodes a least-squares fit has nearly the least maximum.
    angles = 0.5 * np.pi * (np.arange(_NUM_RADII) + 0.5) / _NUM_RADII
    distorted = reach * np.sin(angles)
    undistorted = distorted * _scale(undistortion, distorted)
    largest = undistorted.max()
    s = (undistorted / largest) ** 2
    powers = s[:, None] ** np.arange(1, 4)
    columns = np.hstack(
        [
            undistorted[:, None] * powers[:, :num_terms],
            -distorted[:, None] * powers[:, :den_terms],
        ]
    )
    weight, least = np.ones_like(s), np.inf
    best: Array = np.zeros(num_terms + den_terms)
    for _ in range(_NUM_REWEIGHTS if den_terms else 1):
        target = (distorted - undistorted) * weight
        values = np.linalg.lstsq(columns * weight[:, None], target, rcond=None)[0]
        weight = 1.0 / polyval(s, [1.0, *values[num_terms:]])
        model = undistorted * polyval(s, [1.0, *values[:num_terms]]) * weight
        error = np.max(np.abs(model - distorted))
        if error < least:  # the iteration may wander off
            best, least = values, error
    unit = largest ** (2.0 * np.arange(1, 4))
    num, den = best[:num_terms] / unit[:num_terms], best[num_terms:] / unit[:den_terms]
    return np.array([1.0, *num]), np.array([1.0, *den])


def _colmap_params(
    model: str, pinhole: Sequence[float], num: Array, den: Array
) -> tuple[float, ...]:
    """fx, fy, cx, cy, k1, k2, p1, p2 and, of FULL_OPENCV, k3, k4, k5, k6."""
    rest = np.zeros(4 if model == "FULL_OPENCV" else 0)
    rest[: len(num) - 3] = num[3:]
    rest[1 : len(den)] = den[1:]
    return tuple(map(float, [*pinhole, *num[1:3], 0.0, 0.0, *rest]))

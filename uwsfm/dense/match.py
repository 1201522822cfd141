"""Disparities of a rectified pair: semi-global matching, checked and refined.

The semi-global matcher (OpenCV) finds the disparity to about a fifth of a pixel, and
leans to whole pixels. From there a few Gauss-Newton steps compare the grey values in
small windows, each normalised by its mean and contrast: every pixel of a window is
compared at its own disparity, so that slanted surfaces match as well as those that
face the camera. Nothing is invented: where the matcher has no disparity that is the
same from left to right and back, there is none.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

# OpenCV's functions return arrays of any type, as far as type checkers know.
Plane = NDArray[Any]
"""(h, w) float32"""
Gray = NDArray[Any]
"""(h, w) uint8"""

BLOCK = 5
PREFILTER_CAP = 31
UNIQUENESS_PERCENT = 5
LEFT_RIGHT_PX = 1
SPECKLE_PIXELS, SPECKLE_RANGE = 100, 2
MULTIPLE = 16  # StereoSGBM wants the number of disparities so
FRACTIONS = 16  # its results are integers in 1/16 px

WINDOWS_PX = (2.0, 6.0)
"""Standard deviations of the windows that are compared, pixels."""
SMEARED_PX = (0.02, 0.1)
"""Standard deviation of the disparities within them beside a plane."""
NUM_STEPS = 3
MAX_STEP_PX = 0.5
MAX_CHANGE_PX = 1.0
"""Farther from the matcher's result the refinement has gone astray."""
MIN_CONTRAST = 1.0
"""Grey levels; below it a window has only noise."""
MIN_CORRELATION = 0.6
"""Of the windows; below it they show different things."""
MARGIN = 64
"""Pixels around a tile whose costs are aggregated with it."""
COST_BYTES = 6
"""Of the matcher, per pixel and disparity (measured)."""


def num_disparities(span: float) -> int:
    """How many the matcher is given for a span of them."""
    return max(MULTIPLE, int(np.ceil(span / MULTIPLE)) * MULTIPLE)


def match_tiles(left: Gray, right: Gray, count: int, max_bytes: float) -> Plane:
    """Semi-global disparities (h, w) from 0 to count - 1; NaN where there are none.

    Args:
        left, right: (h, w) rectified.
        count: a multiple of 16.
        max_bytes: of the matcher's costs; larger images are matched in tiles.
    """
    height, width = left.shape
    rows, columns = height, width
    if COST_BYTES * count * height * width > max_bytes:
        # A tile needs the costs of what is around it, and on its left all that the
        # disparities reach.
        side = int(np.sqrt(max_bytes / (COST_BYTES * count)))
        rows = max(side - 2 * MARGIN, MARGIN)
        columns = max(side - 2 * MARGIN - count, MARGIN)
    found = np.empty((height, width), dtype=np.float32)
    for top in range(0, height, rows):
        y = slice(max(top - MARGIN, 0), min(top + rows + MARGIN, height))
        for start in range(0, width, columns):
            x = slice(
                max(start - MARGIN - count, 0), min(start + columns + MARGIN, width)
            )
            tile = _match(left[y, x], right[y, x], count)
            found[top : top + rows, start : start + columns] = tile[
                top - y.start : top - y.start + rows,
                start - x.start : start - x.start + columns,
            ]
    return found


def _match(left: Gray, right: Gray, count: int) -> Plane:
    matcher = cv2.StereoSGBM_create(  # type: ignore[attr-defined]
        minDisparity=0,
        numDisparities=count,
        blockSize=BLOCK,
        P1=8 * BLOCK**2,
        P2=32 * BLOCK**2,
        disp12MaxDiff=LEFT_RIGHT_PX,
        preFilterCap=PREFILTER_CAP,
        uniquenessRatio=UNIQUENESS_PERCENT,
        speckleWindowSize=SPECKLE_PIXELS,
        speckleRange=SPECKLE_RANGE,
        mode=cv2.STEREO_SGBM_MODE_HH,
    )
    fixed = matcher.compute(np.ascontiguousarray(left), np.ascontiguousarray(right))
    disparity = fixed.astype(np.float32) / FRACTIONS
    disparity[fixed < 0] = np.nan
    return disparity


def refine(left: Gray, right: Gray, start: Plane, rows: Plane) -> tuple[Plane, Plane]:
    """Gauss-Newton from a matcher's disparities, in small windows and in wide ones.

    Both are averaged by the variances that their residuals and slopes predict: where
    there is texture the small windows decide, elsewhere the wide ones.

    Args:
        left, right: (h, w) rectified.
        start: (h, w) disparities, NaN where there are none.
        rows: (h, w) how far below the row of a pixel its match lies.

    Returns:
        Disparities (h, w), NaN where there are none or where the windows differ, and
        the correlation (h, w) of the windows.
    """
    pair = left.astype(np.float32), right.astype(np.float32)
    weight, total = np.zeros_like(start), np.zeros_like(start)
    correlation = np.full_like(start, -1.0)
    for window, blur_px in zip(WINDOWS_PX, SMEARED_PX, strict=True):
        found = _refined(*pair, start, rows, window)
        # What went astray, in a plain area say, has no weight.
        share = 1.0 / (found.variance + blur_px**2)
        share[~(np.abs(found.disparity - start) < MAX_CHANGE_PX)] = 0.0
        weight += share
        total += share * np.nan_to_num(found.disparity)
        np.maximum(correlation, found.correlation, out=correlation)
    with np.errstate(invalid="ignore", divide="ignore"):
        disparity = np.where(weight > 0.0, total / weight, np.nan)
    disparity[correlation < MIN_CORRELATION] = np.nan
    return disparity, correlation


class _Refined(NamedTuple):
    disparity: Plane
    variance: Plane
    correlation: Plane


def _refined(
    left: Plane, right: Plane, start: Plane, rows: Plane, window: float
) -> _Refined:
    valid = np.isfinite(start)
    mask = valid.astype(np.float32)
    disparity = smoothed(start, valid, window)
    mean, contrast = contrast_of(left, mask, window)
    target = (left - mean) / contrast
    # cv2.Sobel's weights sum to eight pixels.
    gradient = cv2.Sobel(right, cv2.CV_32F, 1, 0, ksize=3, scale=0.125)
    # Pixels that a window averages, were their weights equal.
    count = 4.0 * np.pi * window**2
    for _ in range(NUM_STEPS):
        shown, slope = _warped((right, gradient), disparity, rows)
        mean, contrast = contrast_of(shown, mask, window)
        slope *= mask / contrast
        error = target - (shown - mean) / contrast
        information = np.maximum(blurred(slope * slope, window), 1e-6)
        step = blurred(slope * error, window) / information
        step = np.clip(step, -MAX_STEP_PX, MAX_STEP_PX)
        disparity = smoothed(np.where(valid, disparity - step, np.nan), valid, window)
    variance = blurred(error * error * mask, window) / (count * information)
    (shown,) = _warped((right,), disparity, rows)
    return _Refined(disparity, variance, _correlation(left, shown, mask, window))


def _warped(planes: tuple[Plane, ...], disparity: Plane, rows: Plane) -> list[Plane]:
    """Planes of the right image where the disparities point."""
    height, width = disparity.shape
    y, x = np.mgrid[:height, :width].astype(np.float32)
    at_x = np.nan_to_num(x - disparity, nan=-1.0)
    return [
        cv2.remap(
            plane, at_x, y + rows, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE
        )
        for plane in planes
    ]


def _correlation(first: Plane, second: Plane, mask: Plane, window: float) -> Plane:
    """Of two planes in windows."""
    share = np.maximum(blurred(mask, window), 1e-3)
    means, contrasts = zip(
        *(contrast_of(plane, mask, window) for plane in (first, second)), strict=True
    )
    product = blurred(first * second * mask, window) / share - means[0] * means[1]
    return product / (contrasts[0] * contrasts[1])


def contrast_of(plane: Plane, mask: Plane, window: float) -> tuple[Plane, Plane]:
    """Mean and standard deviation in windows, the latter at least `MIN_CONTRAST`."""
    share = np.maximum(blurred(mask, window), 1e-3)
    mean = blurred(plane * mask, window) / share
    square = blurred(plane * plane * mask, window) / share
    return mean, np.sqrt(np.maximum(square - mean * mean, MIN_CONTRAST**2))


def blurred(plane: Plane, window: float) -> Plane:
    return cv2.GaussianBlur(plane, (0, 0), window, borderType=cv2.BORDER_REFLECT)


def smoothed(disparity: Plane, valid: NDArray[np.bool_], window: float) -> Plane:
    """Local planes through the valid disparities: exact on slants, also at a border."""
    height, width = disparity.shape
    mask = valid.astype(np.float32)
    y, x = np.mgrid[:height, :width].astype(np.float32)
    d = np.where(valid, disparity, 0.0).astype(np.float32)
    # Moments about each pixel: those about the origin lose digits far from it, so take
    # them with kernels k, k x, k y, ... directly.
    radius = int(np.ceil(3 * window))
    t = np.arange(-radius, radius + 1, dtype=np.float32)
    k0 = np.exp(-0.5 * (t / window) ** 2)
    k0 /= k0.sum()
    k1, k2 = k0 * t, k0 * t * t

    def moment(plane: Plane, kx: Plane, ky: Plane) -> Plane:
        return cv2.sepFilter2D(
            plane, cv2.CV_32F, kx, ky, borderType=cv2.BORDER_CONSTANT
        )

    s, sx, sy = moment(mask, k0, k0), moment(mask, k1, k0), moment(mask, k0, k1)
    sxx, sxy, syy = (moment(mask, k2, k0), moment(mask, k1, k1), moment(mask, k0, k2))
    b, bx, by = moment(d, k0, k0), moment(d, k1, k0), moment(d, k0, k1)
    sxx, syy = sxx + 1e-3, syy + 1e-3
    # Cramer's rule for the value at the pixel itself.
    c0, c1, c2 = sxx * syy - sxy * sxy, sxy * sy - sx * syy, sx * sxy - sxx * sy
    det = s * c0 + sx * c1 + sy * c2
    with np.errstate(divide="ignore", invalid="ignore"):
        value = (b * c0 + bx * c1 + by * c2) / det
    return np.where(valid & (det > 1e-6), value, disparity).astype(np.float32)

"""The depth map of a stereo pair: matched in rectified images, measured by water rays.

A match is two rectified pixels. Each goes back through the exact projection to its
pixel, and from there along the exact water ray: the rectified images decide what is
compared, never where it is.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from uwsfm.dense.depth_map import DepthMap, Plane, pixel_rows
from uwsfm.dense.lookup import sampled
from uwsfm.dense.match import WINDOWS_PX, Gray, match_tiles, refine, smoothed
from uwsfm.dense.rectify import Rectification
from uwsfm.geometry import rigid3
from uwsfm.geometry.rays import closest_points
from uwsfm.geometry.rigid3 import Array

MAP_STEP = 4
"""Exact projections are made of every fourth pixel: between them they are straight to
a thousandth of a pixel."""
ROWS_STEP = 8
BAND_PIXELS = 250_000
"""Triangulated at a time, about 400 bytes each."""
BYTES_PER_PIXEL = 160
"""Of a rectified image while it is matched, the matcher's costs apart (measured)."""
MIN_ROWS_PX = 0.02
"""Epipolar deviations below this are not followed."""
BORDER_PX = 1.0
"""Of the right image, which holds no match: rectified images go on beyond it."""
MIXED_PX = 1.0
"""Neighbours farther apart in disparity than this belong to two surfaces."""


def stereo_depth(
    slabs: tuple[Rectification, ...], left: Gray, right: Gray, max_bytes: float
) -> DepthMap:
    """Match two images and triangulate.

    Args:
        slabs: of `rectifications`.
        left, right: grey images as stored.
        max_bytes: what may be allocated.
    """
    shape = left.shape
    ranges = np.full(shape, np.nan, dtype=np.float32)
    sensitivity, best = ranges.copy(), np.full(shape, -np.inf, dtype=np.float32)
    for slab in slabs:
        pixels = slab.size[0] * slab.size[1]
        disparity, rows, correlation = _matched(
            slab, left, right, max_bytes - BYTES_PER_PIXEL * pixels
        )
        count = max(1, BAND_PIXELS // shape[1])
        for top in range(0, shape[0], count):
            band = slice(top, min(top + count, shape[0]))
            found = _triangulated(slab, disparity, rows, correlation, band)
            # The slab that holds the result wins; two neighbours may both, at the
            # limit between them: then the better match.
            wins = np.isfinite(found.ranges) & (found.correlation > best[band])
            for whole, part in (
                (ranges, found.ranges),
                (sensitivity, found.sensitivity),
                (best, found.correlation),
            ):
                whole[band][wins] = part[wins]
    return DepthMap(ranges=ranges, sensitivity=sensitivity)


def rectified_images(slab: Rectification, left: Gray, right: Gray) -> tuple[Gray, Gray]:
    """Both images (h, w) as the central pair of a slab would have taken them."""
    images = []
    for image, back in ((left, slab.left_from_rect), (right, slab.right_from_rect)):
        width, height = slab.size
        at = _grid_map(back, width, height) - np.float32(0.5)
        images.append(
            cv2.remap(
                image,
                at[..., 0],
                at[..., 1],
                cv2.INTER_CUBIC,
                borderMode=cv2.BORDER_REPLICATE,
            )
        )
    return images[0], images[1]


def _grid_map(back, width: int, height: int) -> NDArray[np.float32]:
    """Pixels (height, width, 2) of a map that is exact on a grid."""
    # One node beyond the image on each side: resizing repeats the outermost ones.
    columns, rows = -(-width // MAP_STEP) + 2, -(-height // MAP_STEP) + 2
    x, y = (MAP_STEP * (np.arange(n) - 0.5) for n in (columns, rows))
    xy, _ = back(np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2))
    nodes = xy.reshape(rows, columns, 2).astype(np.float32)
    full = cv2.resize(
        nodes,
        (columns * MAP_STEP, rows * MAP_STEP),
        interpolation=cv2.INTER_LINEAR,
    )
    return full[MAP_STEP : MAP_STEP + height, MAP_STEP : MAP_STEP + width]


def _matched(
    slab: Rectification, left: Gray, right: Gray, max_bytes: float
) -> tuple[Plane, Plane, Plane]:
    """Disparities, epipolar deviations and correlations (h, w) of a slab."""
    a, b = rectified_images(slab, left, right)
    start = match_tiles(a, b, slab.num_disparities, max_bytes)
    rows = np.zeros(start.shape, dtype=np.float32)
    if slab.deviation_px > MIN_ROWS_PX:
        rows = _deviations(slab, start)
    disparity, correlation = refine(a, b, start, rows)
    return disparity, rows, correlation


def _deviations(slab: Rectification, disparity: Plane) -> Plane:
    """How far below its row the match of each pixel lies (h, w), at its own depth."""
    width, height = slab.size
    columns, lines = -(-width // ROWS_STEP), -(-height // ROWS_STEP)
    x, y = (ROWS_STEP * (np.arange(n) + 0.5) for n in (columns, lines))
    uv = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    # Where a cell has no match its neighbours' serve.
    at = np.floor(np.minimum(uv, np.array(slab.size) - 1)).astype(int)
    valid = np.isfinite(disparity)
    values = smoothed(disparity, valid, WINDOWS_PX[-1])[at[:, 1], at[:, 0]]
    values = np.where(np.isfinite(values), values, np.nanmedian(disparity))
    xy, _ = slab.left_from_rect(uv)
    origins, dirs = slab.pair.left.ray_from_img(xy)
    ranges = _ranges(slab, origins, dirs, uv - np.column_stack([values, 0.0 * values]))
    points = origins + ranges[:, None] * dirs
    shown, _ = slab.pair.right.img_from_point(
        rigid3.transform(slab.pair.right_from_left, points)
    )
    below = slab.rect_from_right_img(shown)[:, 1] - uv[:, 1]
    below = np.where(np.isfinite(below), below, 0.0).reshape(lines, columns)
    full = cv2.resize(
        below.astype(np.float32),
        (columns * ROWS_STEP, lines * ROWS_STEP),
        interpolation=cv2.INTER_LINEAR,
    )
    return full[:height, :width]


def _ranges(slab: Rectification, origins: Array, dirs: Array, uv: Array) -> Array:
    """Ranges (N,) along left rays where they meet those of right rectified pixels."""
    xy, valid = slab.right_from_rect(uv)
    limits = np.array([slab.pair.right.width, slab.pair.right.height])
    with np.errstate(invalid="ignore"):
        valid &= np.all((xy > BORDER_PX) & (xy < limits - BORDER_PX), axis=1)
    xy[~valid] = np.nan
    starts, ways = slab.pair.right.ray_from_img(xy)
    left_from_right = rigid3.inverse(slab.pair.right_from_left)
    starts = rigid3.transform(left_from_right, starts)
    ways = rigid3.rotate(left_from_right, ways)
    return closest_points(origins, dirs, starts, ways)[1][:, 0]


@dataclass(frozen=True, kw_only=True, eq=False)
class _Band:
    ranges: Plane
    sensitivity: Plane
    correlation: Plane


def _triangulated(
    slab: Rectification, disparity: Plane, rows: Plane, correlation: Plane, band: slice
) -> _Band:
    """Some rows of the left image, from the disparities of the rectified one."""
    camera = slab.pair.left
    shape = band.stop - band.start, camera.width
    origins, dirs = camera.ray_from_img(pixel_rows(camera, band.start, band.stop))
    uv = slab.rect_from_left_rays(origins, dirs)
    at = (uv - 0.5).astype(np.float32).reshape(*shape, 2)
    seen = _between(disparity, at).reshape(-1)
    found = np.full((len(uv), 2), np.nan)
    ok = np.isfinite(seen)
    below = sampled(rows, at).reshape(-1)
    right = uv[ok] + np.column_stack([-seen[ok], below[ok]])
    origins, dirs = origins[ok], dirs[ok]
    found[ok, 0] = _ranges(slab, origins, dirs, right)
    found[ok, 1] = np.abs(_sensitivities(slab, origins, dirs, right))
    depth = (origins - slab.centers[0]) @ slab.rect_from_left[2]
    depth += found[ok, 0] * (dirs @ slab.rect_from_left[2])
    # A pixel of disparity beyond the slab is noise of what lies within.
    slack = found[ok, 1]
    with np.errstate(invalid="ignore"):
        inside = (depth > slab.near - slack) & (depth < slab.far + slack)
    found[np.flatnonzero(ok)[~inside]] = np.nan
    both = found.astype(np.float32).reshape(*shape, 2)
    return _Band(
        ranges=both[..., 0],
        sensitivity=both[..., 1],
        correlation=sampled(correlation, at),
    )


def _sensitivities(
    slab: Rectification, origins: Array, dirs: Array, uv: Array
) -> Array:
    """Change of the range (N,) per pixel of disparity, metres.

    By the central pair that resembles the cameras: to a hundredth, which is enough for
    a standard deviation.
    """
    steps = []
    for shift in (-0.5, 0.5):
        slopes = (uv + [shift, 0.0] - slab.principal_points[1]) / slab.focal_px
        ways = np.column_stack([slopes, np.ones(len(slopes))]) @ slab.rect_from_left
        ways /= np.linalg.norm(ways, axis=1, keepdims=True)
        centers = np.broadcast_to(slab.centers[1], ways.shape)
        steps.append(closest_points(origins, dirs, centers, ways)[1][:, 0])
    return steps[1] - steps[0]


def _between(plane: Plane, at: Plane) -> Plane:
    """Disparities between the pixels, NaN where two surfaces would be mixed."""
    found, nearest = sampled(plane, at), sampled(plane, at, nearest=True)
    with np.errstate(invalid="ignore"):
        return np.where(np.abs(found - nearest) < MIXED_PX, found, np.nan)

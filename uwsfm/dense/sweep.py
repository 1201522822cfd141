"""The depth map of one camera from neighbouring frames: a plane sweep on water rays.

Planes across the camera's axis, evenly spaced in inverse depth, cut the water rays of
its pixels; the points are projected exactly into the neighbouring images. Where the
grey values around a pixel agree with those of two neighbours, there is the surface.
From the best plane, smoothed over the image by semi-global aggregation, Gauss-Newton
steps follow each pixel's own ray.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from uwsfm.dense.depth_map import DepthMap, Plane, pixel_rows
from uwsfm.dense.match import MIN_CORRELATION, Gray, blurred, contrast_of, smoothed
from uwsfm.dense.semi_global import aggregate
from uwsfm.geometry import rigid3
from uwsfm.geometry.rigid3 import Array
from uwsfm.models.refractive import RefractiveCamera

NODE_STEP = 8
"""Pixels between those that are projected; linear between them to 0.01 px."""
MAX_STEP_PX = 1.0
"""Between two planes, in the image that moves most."""
MIN_LEVELS, MAX_LEVELS = 16, 256
WINDOW = 7
"""Of the sweep, pixels."""
SMALL_CHANGE, LARGE_CHANGE = 8.0, 64.0
"""What it costs to leave a neighbour's plane, of 255 for windows that are opposite."""
REFINE_WINDOW_PX = 2.5
NUM_STEPS = 3
HALO = 32
"""Rows around a band whose costs are aggregated with it."""
BYTES_PER_COST = 6
BYTES_PER_PIXEL = 600
"""Beside the costs (measured)."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Source:
    """A neighbouring image, placed."""

    camera: RefractiveCamera
    from_reference: Array
    """(7,) pose, source camera from reference camera."""
    image: Gray


class _Rays:
    """Water rays of the pixels of a grid (h, w), and where sources see their points."""

    def __init__(self, camera: RefractiveCamera, xy: Array, shape: tuple[int, int]):
        self._origins, self._dirs = camera.ray_from_img(xy)
        self.shape = shape

    def ranges(self, inverse: Array) -> Array:
        """Along the rays (N,), at inverse depths (N,) or one."""
        with np.errstate(divide="ignore", invalid="ignore"):
            depth = 1.0 / np.asarray(inverse, dtype=np.float64)
            found = (depth - self._origins[:, 2]) / self._dirs[:, 2]
        return np.where(found > 0.0, found, np.nan)

    def shown(self, source: Source, inverse: Array) -> Plane:
        """Pixels (h, w, 2) of a source, centres at integers; far outside if none."""
        points = self._origins + self.ranges(inverse)[:, None] * self._dirs
        xy, valid = source.camera.img_from_point(
            rigid3.transform(source.from_reference, points)
        )
        at = np.where(valid[:, None], xy - 0.5, -1e4)
        return np.clip(at, -1e4, 1e5).astype(np.float32).reshape(*self.shape, 2)


def sweep_depth(
    camera: RefractiveCamera,
    image: Gray,
    sources: list[Source],
    near: float,
    far: float,
    max_bytes: float,
) -> DepthMap:
    """Sweep an image, in bands of rows that fit the memory.

    Args:
        camera: of the image.
        image: grey, (H, W), as stored.
        sources: at least two neighbours.
        near, far: depths along the camera's axis, metres.
        max_bytes: what may be allocated.
    """
    inverse = levels(camera, sources, near, far)
    height, width = image.shape
    each = width * (BYTES_PER_COST * len(inverse) + BYTES_PER_PIXEL)
    rows = max(int(max_bytes / each) - 2 * HALO, HALO)
    parts = []
    for top in range(0, height, rows):
        bottom = min(top + rows, height)
        first, last = max(top - HALO, 0), min(bottom + HALO, height)
        found = _band(camera, image, sources, inverse, first, last)
        parts.append(found[:, top - first : bottom - first])
    ranges, sensitivity = np.concatenate(parts, axis=1)
    return DepthMap(ranges=ranges, sensitivity=sensitivity)


def smallest_band(width: int) -> float:
    """Bytes of the smallest band of an image."""
    return 3.0 * HALO * width * (BYTES_PER_COST * MAX_LEVELS + BYTES_PER_PIXEL)


def levels(
    camera: RefractiveCamera, sources: list[Source], near: float, far: float
) -> Array:
    """Inverse depths of the planes, the farthest first."""
    xy = pixel_rows(camera, 0, camera.height, step=4 * NODE_STEP)
    rays = _Rays(camera, xy, (1, len(xy)))
    trial = np.linspace(1.0 / far, 1.0 / near, 9)
    longest = 0.0
    for source in sources:
        path = np.stack([rays.shown(source, value)[0] for value in trial])
        inside = np.all((path >= 0) & (path < source.image.shape[::-1]), axis=(0, 2))
        length = np.linalg.norm(np.diff(path[:, inside], axis=0), axis=2).sum(axis=0)
        if len(length):
            longest = max(longest, float(np.percentile(length, 95)))
    count = int(np.ceil(longest / MAX_STEP_PX)) + 1
    count = min(max(count, MIN_LEVELS), MAX_LEVELS)
    return np.linspace(1.0 / far, 1.0 / near, count)


def _band(
    camera: RefractiveCamera,
    image: Gray,
    sources: list[Source],
    inverse: Array,
    first: int,
    last: int,
) -> Plane:
    """Ranges and sensitivities (2, h, w) of some rows."""
    reference = image[first:last].astype(np.float32)
    cost = _costs(camera, reference, sources, inverse, first)
    total = np.empty(cost.shape, dtype=np.float32)
    aggregate(cost, np.float32(SMALL_CHANGE), np.float32(LARGE_CHANGE), total)
    level, good = _minima(total, cost)
    del cost, total
    rays = _Rays(camera, pixel_rows(camera, first, last), reference.shape)
    step = inverse[1] - inverse[0]
    start = np.where(good, inverse[0] + step * level, np.nan)
    return _refined(rays, reference, sources, start.astype(np.float32), step)


def _costs(
    camera: RefractiveCamera,
    reference: Plane,
    sources: list[Source],
    inverse: Array,
    first: int,
) -> np.ndarray:
    """Costs (h, w, D) uint8: one minus the correlation with the two best sources."""
    height, width = reference.shape
    lines, columns = -(-height // NODE_STEP) + 2, -(-width // NODE_STEP) + 2
    y, x = (NODE_STEP * (np.arange(n) - 0.5) for n in (lines, columns))
    nodes = np.stack(np.meshgrid(x, y + first), axis=-1).reshape(-1, 2)
    rays = _Rays(camera, nodes, (lines, columns))
    size = columns * NODE_STEP, lines * NODE_STEP
    cut = slice(NODE_STEP, NODE_STEP + height), slice(NODE_STEP, NODE_STEP + width)
    own = _moments(reference)
    images = [source.image.astype(np.float32) for source in sources]
    cost = np.empty((height, width, len(inverse)), dtype=np.uint8)
    for index, value in enumerate(inverse):
        best = second = np.float32(-1.0)
        for source, seen in zip(sources, images, strict=True):
            at = cv2.resize(
                rays.shown(source, value), size, interpolation=cv2.INTER_LINEAR
            )[cut]
            found = _correlation(reference, own, _taken(seen, at))
            second = np.maximum(second, np.minimum(best, found))
            best = np.maximum(best, found)
        cost[..., index] = np.clip(127.5 - 63.75 * (best + second), 0.0, 255.0)
    return cost


def _taken(image: Plane, at: Plane) -> Plane:
    return cv2.remap(
        image,
        at[..., 0],
        at[..., 1],
        cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_CONSTANT,
        borderValue=-1e3,
    )


def _moments(plane: Plane) -> tuple[Plane, Plane]:
    """Mean and variance in the windows of the sweep."""
    mean = _boxed(plane)
    return mean, np.maximum(_boxed(plane * plane) - mean * mean, 1.0)


def _boxed(plane: Plane) -> Plane:
    return cv2.boxFilter(plane, -1, (WINDOW, WINDOW), borderType=cv2.BORDER_REFLECT)


def _correlation(first: Plane, moments: tuple[Plane, Plane], second: Plane) -> Plane:
    mean, variance = _moments(second)
    product = _boxed(first * second) - moments[0] * mean
    found = product / np.sqrt(moments[1] * variance)
    found[second < 0.0] = -1.0  # beyond the source's border
    return found


def _minima(total: Plane, cost: np.ndarray) -> tuple[Plane, np.ndarray]:
    """Best level (h, w), between the planes, and whether it is one."""
    count = total.shape[2]
    best = np.argmin(total, axis=2)
    inside = np.clip(best, 1, count - 2)[..., None]
    before, here, after = (
        np.take_along_axis(total, inside + shift, axis=2)[..., 0]
        for shift in (-1, 0, 1)
    )
    curve = np.maximum(before - 2.0 * here + after, 1e-6)
    shift = np.clip(0.5 * (before - after) / curve, -0.5, 0.5)
    # What lies at the end of the sweep lies beyond it.
    good = (best > 0) & (best < count - 1)
    chosen = np.take_along_axis(cost, best[..., None], axis=2)[..., 0]
    good &= chosen < 255.0 * 0.5 * (1.0 - MIN_CORRELATION)
    return (inside[..., 0] + shift).astype(np.float32), good


def _refined(
    rays: _Rays, reference: Plane, sources: list[Source], start: Plane, step: float
) -> Plane:
    """Gauss-Newton along each ray from inverse depths (h, w), in steps of the sweep."""
    valid = np.isfinite(start)
    mask = valid.astype(np.float32)
    window = REFINE_WINDOW_PX
    inverse = smoothed(start, valid, window)
    mean, contrast = contrast_of(reference, mask, window)
    target = (reference - mean) / contrast
    images = [source.image.astype(np.float32) for source in sources]
    for _ in range(NUM_STEPS):
        slopes = np.zeros_like(reference)
        errors, moves = slopes.copy(), slopes.copy()
        num_used = slopes.copy()
        for source, seen in zip(sources, images, strict=True):
            places = [
                rays.shown(source, (inverse + shift * step).ravel())
                for shift in (-0.5, 0.0, 0.5)
            ]
            low, here, high = (_taken(seen, at) for at in places)
            mean, contrast = contrast_of(here, mask, window)
            shown = (here - mean) / contrast
            used = mask * (np.minimum(low, np.minimum(here, high)) > 0.0)
            share = np.maximum(blurred(used, window), 1e-3)
            used *= blurred(target * shown * used, window) / share > 0.3
            slope = used * (high - low) / contrast
            slopes += slope * slope
            errors += slope * (target - shown)
            moves += used * np.sum((places[2] - places[0]) ** 2, axis=-1)
            num_used += used
        change = blurred(errors, window) / np.maximum(blurred(slopes, window), 1e-6)
        moved = inverse + step * np.clip(change, -1.0, 1.0)
        inverse = smoothed(np.where(valid, moved, np.nan), valid, window)
    astray = ~(np.abs(inverse - start) < 2.0 * step) | (num_used < 1.0)
    inverse[astray] = np.nan
    flat = inverse.ravel()
    ranges = rays.ranges(flat)
    with np.errstate(invalid="ignore", divide="ignore"):
        per_step = rays.ranges(flat - 0.5 * step) - rays.ranges(flat + 0.5 * step)
        moved = np.sqrt(moves / num_used).ravel()
        sensitivity = per_step / moved
    return np.stack([ranges, sensitivity]).astype(np.float32).reshape(2, *start.shape)

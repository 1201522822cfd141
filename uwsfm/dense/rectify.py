"""Two refractive images as the central pair that resembles them best at one depth.

Rows of the two rectified images correspond exactly for points on the plane of that
depth; before and behind it they part by the *epipolar deviation*, since no pair of
centres explains rays that were refracted. Rectified images are only searched: what is
found goes back to pixels and their exact water rays.

Rectified frame: origin in the left virtual centre, x towards the right one, z along the
mean view of both. "Left" is the camera whose depth map is made, wherever it hangs.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from uwsfm.dense.match import num_disparities
from uwsfm.errors import InputError
from uwsfm.geometry import rigid3
from uwsfm.geometry.rigid3 import Array
from uwsfm.models.refractive import RefractiveCamera
from uwsfm.sfm.rig_checks.pinhole_fit import MAX_SLOPE, fit_virtual_pinhole

MAX_DEVIATION_PX = 0.5
"""Of rows: beyond it the depth range is split."""
MAX_SLABS = 16
MIN_COMMON_VIEW = 0.05
"""Share of the left image that the right one has to see."""
MIN_BASELINE_ANGLE_DEG = 20.0
"""Between baseline and view; cameras behind each other cannot be rectified."""
_STEPS = 24
_MARGIN_PX = 3
"""Of disparity, on both sides of what a slab's depths give."""


@dataclass(frozen=True, kw_only=True)
class Pair:
    """Two cameras, placed; lengths in metres."""

    left: RefractiveCamera
    right: RefractiveCamera
    right_from_left: Array
    """(7,)"""
    near: float
    """Depths of the scene along the left camera's axis."""
    far: float


@dataclass(frozen=True, kw_only=True)
class Rectification:
    """A rectified pair for the depths of one slab."""

    pair: Pair
    rect_from_left: Array
    """(3, 3) rotation."""
    centers: Array
    """(2, 3) virtual centres of left and right in the left camera's frame."""
    focal_px: float
    principal_points: Array
    """(2, 2) pixels of the rectified z axis, left and right. The right one lies to the
    right by the smallest disparity: the matcher's disparities start at zero."""
    size: tuple[int, int]
    """Width, height. The matcher has no disparity for the first ``num_disparities``
    columns, which lie beyond what both cameras see."""
    near: float
    """Of the slab, along the rectified z axis."""
    depth: float
    """Of reference."""
    far: float
    num_disparities: int
    """From zero on, a margin included."""
    deviation_px: float
    """Largest epipolar deviation in the slab."""

    def left_from_rect(self, uv: ArrayLike) -> tuple[Array, NDArray[np.bool_]]:
        """Pixels (N, 2) of the left camera, and whether there are such."""
        return self.pair.left.img_from_point(self._on_plane(uv, 0))

    def right_from_rect(self, uv: ArrayLike) -> tuple[Array, NDArray[np.bool_]]:
        """Pixels (N, 2) of the right camera, and whether there are such."""
        points = rigid3.transform(self.pair.right_from_left, self._on_plane(uv, 1))
        return self.pair.right.img_from_point(points)

    def rect_from_left_rays(self, origins: Array, dirs: Array) -> Array:
        """Rectified pixels (N, 2) of the left camera's water rays, in its frame."""
        return self._rect_from_rays(origins, dirs, 0)

    def rect_from_right_img(self, xy: ArrayLike) -> Array:
        """Rectified pixels (N, 2) of right pixels (N, 2)."""
        origins, dirs = self.pair.right.ray_from_img(xy)
        left_from_right = rigid3.inverse(self.pair.right_from_left)
        return self._rect_from_rays(
            rigid3.transform(left_from_right, origins),
            rigid3.rotate(left_from_right, dirs),
            1,
        )

    def shown_by(self, origins: Array, dirs: Array, depth: float) -> Array:
        """Where the right image shows left rays' points at a rectified depth (N, 2)."""
        points = _points_at(self, origins, dirs, depth)
        points = rigid3.transform(self.pair.right_from_left, points)
        xy, _ = self.pair.right.img_from_point(points)
        return xy

    def _on_plane(self, uv: ArrayLike, side: int) -> Array:
        pixels = np.asarray(uv, dtype=np.float64)
        slopes = (pixels - self.principal_points[side]) / self.focal_px
        points = self.depth * np.column_stack([slopes, np.ones(len(slopes))])
        return points @ self.rect_from_left + self.centers[side]

    def _rect_from_rays(self, origins: Array, dirs: Array, side: int) -> Array:
        start = (origins - self.centers[side]) @ self.rect_from_left.T
        along = dirs @ self.rect_from_left.T
        ranges = (self.depth - start[:, 2]) / along[:, 2]
        points = start + ranges[:, None] * along
        return self.focal_px * points[:, :2] / self.depth + self.principal_points[side]


def rectifications(pair: Pair) -> tuple[Rectification, ...]:
    """The rectified pairs that together cover the depths of a scene.

    Raises:
        InputError: the cameras stand behind each other, or share too little view.
    """
    whole = _central_pair(pair)
    ends = np.linspace(1.0 / whole.near, 1.0 / whole.far, 2)
    for count in range(1, MAX_SLABS + 1):
        bounds = 1.0 / np.linspace(ends[0], ends[1], count + 1)
        slabs = tuple(
            _slab(whole, near, far)
            for near, far in zip(bounds[:-1], bounds[1:], strict=True)
        )
        if max(slab.deviation_px for slab in slabs) <= MAX_DEVIATION_PX:
            break
    return slabs


def _central_pair(pair: Pair) -> Rectification:
    """Orientation, centres and focal length, without a slab."""
    depths = [pair.near, 2.0 / (1.0 / pair.near + 1.0 / pair.far), pair.far]
    left_from_right = rigid3.inverse(pair.right_from_left)
    fits = [fit_virtual_pinhole(camera, depths) for camera in (pair.left, pair.right)]
    centers = np.stack(
        [
            fits[0].center_in_cam,
            rigid3.transform(left_from_right, fits[1].center_in_cam),
        ]
    )
    views = np.stack(
        [_view(pair.left), rigid3.rotate(left_from_right, _view(pair.right))]
    )
    axis = centers[1] - centers[0]
    axis /= np.linalg.norm(axis)
    view = views.sum(axis=0)
    across = view - axis * (view @ axis)
    limit = np.sin(np.radians(MIN_BASELINE_ANGLE_DEG))
    if not np.linalg.norm(across) > limit * np.linalg.norm(view):
        raise InputError("they stand behind each other")
    across /= np.linalg.norm(across)
    rotation = np.stack([axis, np.cross(across, axis), across])
    # From depths along the left camera's axis to those along the rectified one.
    cosine = max(float(rotation[2, 2]), 0.5)
    shift = float(rotation[2] @ centers[0])
    near, far = (cosine * depth - shift for depth in (pair.near, pair.far))
    return Rectification(
        pair=pair,
        rect_from_left=rotation,
        centers=centers,
        focal_px=0.5 * (fits[0].focal_px + fits[1].focal_px),
        principal_points=np.zeros((2, 2)),
        size=(0, 0),
        near=max(near, 0.5 * pair.near),
        depth=np.nan,
        far=max(far, pair.far),
        num_disparities=0,
        deviation_px=np.nan,
    )


def _view(camera: RefractiveCamera) -> Array:
    """Mean direction (3,) of a camera's water rays, unit."""
    _, dirs = camera.ray_from_img(_grid(camera))
    mean = np.nanmean(dirs, axis=0)
    return mean / np.linalg.norm(mean)


def _grid(camera: RefractiveCamera) -> Array:
    """Pixels (N, 2) all over an image."""
    x = (np.arange(_STEPS) + 0.5) / _STEPS
    grid = np.stack(np.meshgrid(camera.width * x, camera.height * x), axis=-1)
    return grid.reshape(-1, 2)


def _points_at(rect: Rectification, origins: Array, dirs: Array, depth: float) -> Array:
    """Points (N, 3) of the left camera's rays at a rectified depth, in its frame."""
    axis = rect.rect_from_left[2]
    ranges = (depth - (origins - rect.centers[0]) @ axis) / (dirs @ axis)
    return origins + np.where(ranges > 0.0, ranges, np.nan)[:, None] * dirs


def _slab(whole: Rectification, near: float, far: float) -> Rectification:
    """The rectified pair of depths between two limits.

    Raises:
        InputError: the cameras share too little view there.
    """
    rect = replace(whole, near=near, far=far, depth=2.0 / (1.0 / near + 1.0 / far))
    origins, dirs = rect.pair.left.ray_from_img(_grid(rect.pair.left))
    left = rect.rect_from_left_rays(origins, dirs)
    limits = np.array([rect.pair.right.width, rect.pair.right.height])
    disparities, deviations = [], []
    seen = np.zeros(len(left), dtype=bool)
    steep = np.max(np.abs(left), axis=1) > MAX_SLOPE * rect.focal_px
    for depth in (near, rect.depth, far):
        xy = rect.shown_by(origins, dirs, depth)
        with np.errstate(invalid="ignore"):
            inside = np.all((xy >= 0.0) & (xy <= limits), axis=1) & ~steep
        offset = left[inside] - rect.rect_from_right_img(xy[inside])
        disparities.append(offset[:, 0])
        deviations.append(np.abs(offset[:, 1]))
        seen |= inside
    if np.count_nonzero(seen) < MIN_COMMON_VIEW * len(left):
        raise InputError("they have too little view in common")
    disparity = np.concatenate(disparities)
    low = np.floor(np.nanmin(left[seen], axis=0)) - 0.5 * _cell(rect)
    high = np.ceil(np.nanmax(left[seen], axis=0)) + 0.5 * _cell(rect)
    smallest = np.floor(np.nanmin(disparity)) - _MARGIN_PX
    count = num_disparities(np.nanmax(disparity) + _MARGIN_PX - smallest)
    low[0] -= count
    size = np.ceil(high - low).astype(int)
    return replace(
        rect,
        principal_points=np.stack([-low, -low + [smallest, 0.0]]),
        size=(int(size[0]), int(size[1])),
        num_disparities=count,
        deviation_px=float(np.nanmax(np.concatenate(deviations))),
    )


def _cell(rect: Rectification) -> Array:
    """Distance (2,) between the pixels of `_grid`."""
    return np.array([rect.pair.left.width, rect.pair.left.height]) / _STEPS

"""The depth map of one image from its neighbours by PatchMatch, coarse to fine."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from uwsfm.dense import patch, patchmatch
from uwsfm.dense.depth_map import DepthMap, Plane, pixel_rows
from uwsfm.dense.match import Gray
from uwsfm.dense.options import ASSUMED_NOISE_PX
from uwsfm.dense.planar_prior import is_plain, with_planes
from uwsfm.dense.reduced import for_scale
from uwsfm.dense.settle import rough, settle
from uwsfm.dense.warp import Placement, table_bytes, warp_table
from uwsfm.geometry.rigid3 import Array
from uwsfm.models.refractive import RefractiveCamera

Hypotheses = NDArray[Any]
"""(h, w, 3) float32: inverse depth and its growth per pixel to the right and down."""


@dataclass(frozen=True, kw_only=True)
class Rounds:
    """What is done at one scale."""

    scale: int
    """Pixels of the image per pixel."""
    reach_px: tuple[float, ...]
    """How far chance goes in each round, pixels in the neighbours."""
    any_share: float
    """Of the pixels that try any depth at all, each round."""


FIRST = (
    Rounds(scale=4, reach_px=(6.0, 4.0, 3.0, 2.0, 1.5, 1.0, 0.7, 0.5), any_share=0.5),
    Rounds(scale=2, reach_px=(2.0, 1.0, 0.7, 0.5), any_share=0.2),
)
"""By likeness alone."""
SECOND = (
    Rounds(scale=2, reach_px=(1.0, 0.7), any_share=0.2),
    Rounds(scale=1, reach_px=(0.5,), any_share=0.0),
)
"""With what the neighbours found."""
LEAST_NOISE_PX, SURE_NOISE_PX = 0.05, 0.5
"""Standard deviation of a disparity: what the warp, the slope and the light leave at
best, and up to which the images alone are believed."""
MIN_CORRELATION = 0.3
"""Of patches, likewise."""
MIN_AGREEING = 2
"""Neighbours that have the surface there, too: of plain areas, these decide."""
BYTES_PER_PIXEL, BYTES_PER_NEIGHBOUR = 500, 20
"""In all passes, about, beside the warp's table."""
SLOPE_PER_PX = 0.3
"""Tangent by which chance tilts a hypothesis, per pixel of `reach_px`."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Neighbour:
    """A neighbouring image, placed."""

    placement: Placement
    image: Gray
    planes: Hypotheses | None = None
    """That the first pass found there, of half the image's size; NaN where there are
    none."""


class PatchMatch:
    """Hypotheses of one image.

    Args:
        camera: of the image.
        image: grey, (H, W).
        neighbours: at least two.
        limits: nearest and farthest depth along the camera's axis, metres.
        seed: of chance.
    """

    def __init__(
        self,
        camera: RefractiveCamera,
        image: Gray,
        neighbours: list[Neighbour],
        limits: tuple[float, float],
        seed: int,
    ) -> None:
        near, far = limits
        self._image, self._neighbours = image, neighbours
        self._limits = 1.0 / far, 1.0 / near
        self._table = warp_table(camera, [n.placement for n in neighbours], near, far)
        self._focal = _focal(camera)
        self._seed, self._round = seed, 0

    def start(self, points: Array) -> Hypotheses:
        """From known points (N, 3): pixel x, y and inverse depth; and from chance."""
        scale = FIRST[0].scale
        height, width = (-(-n // scale) for n in self._image.shape)
        rng = np.random.default_rng(self._seed)
        low, high = self._limits
        planes = np.zeros((height, width, 3), dtype=np.float32)
        planes[..., 0] = rng.uniform(low, high, (height, width))
        slope = 0.7 * planes[..., :1] * scale / self._focal
        planes[..., 1:] = slope * rng.uniform(-1.0, 1.0, (height, width, 2))
        if len(points):
            known = _nearest(points[:, :2] / scale, points[:, 2], (height, width))
            taken = rng.random((height, width)) < 0.7
            planes[taken, 0] = np.clip(known[taken], low, high)
        return planes

    def search(self, points: Array) -> Hypotheses:
        """The first pass: from points as in `start`, to half the image's size."""
        planes = self.start(points)
        for rounds in FIRST:
            planes, costs, _ = self._run(planes, rounds)
        scale = FIRST[-1].scale
        image = for_scale(self._image, scale)
        return with_planes(planes, costs[..., -1], image, self._focal / scale)

    def settled(self, planes: Hypotheses) -> tuple[Hypotheses, Plane]:
        """The second pass, from the first's hypotheses, then Gauss-Newton.

        Returns:
            The hypotheses, and (H, W, 5) of `uwsfm.dense.settle`.
        """
        for rounds in SECOND:
            planes, costs, seen = self._run(planes, rounds, hold_plain=True)
        found = np.empty((*planes.shape[:2], 5), dtype=np.float32)
        offsets = patch.patch_offsets(stride=1)
        roughs = np.array([rough(n.image) for n in self._neighbours], dtype=np.float32)
        tables = offsets, patch.color_weights(), patchmatch.REACH, roughs
        image = self._image.astype(np.float32)
        num = costs.shape[2] - 1
        settle(
            image, seen, planes, costs, tables, _scratch(offsets.shape[1], num), found
        )
        return planes, found

    def _run(
        self, planes: Hypotheses, rounds: Rounds, *, hold_plain: bool = False
    ) -> tuple[Any, Any, Any]:
        scale = rounds.scale
        image = for_scale(self._image, scale)
        held = is_plain(image) if hold_plain else np.zeros(image.shape, dtype=bool)
        seen = self._seen(scale)
        planes = _resized(planes, image.shape)
        num = len(self._neighbours)
        costs = np.empty((*image.shape, num + 1), dtype=np.float32)
        offsets = patch.patch_offsets()
        tables = offsets, patch.color_weights()
        scratch = _scratch(offsets.shape[1], num)
        patchmatch.rate(image, seen, planes, costs, tables, scratch[0])
        for reach in rounds.reach_px:
            chance = np.array([self._seed, self._round], dtype=np.uint64)
            limits = (*self._limits, self._focal / scale, reach, SLOPE_PER_PX * reach)
            patchmatch.spread(
                (image, held),
                seen,
                planes,
                costs,
                (*tables, patchmatch.REACH),
                chance,
                np.array([*limits, rounds.any_share], dtype=np.float32),
                scratch,
            )
            self._round += 1
        return planes, costs, seen

    def _seen(self, scale: int) -> tuple[Any, ...]:
        """The neighbours as `uwsfm.dense.patch` wants them."""
        images = [for_scale(n.image, scale) for n in self._neighbours]
        shapes = np.array([image.shape for image in images], dtype=np.int64)
        begins = np.cumsum([0, *(image.size for image in images[:-1])])
        sizes = np.column_stack([shapes, begins])
        flat = np.concatenate([image.ravel() for image in images])
        known = [n.planes for n in self._neighbours if n.planes is not None]
        planes = np.zeros((len(images), 0, 0, 3), dtype=np.float32)
        if len(known) == len(images):
            largest = np.max([found.shape[:2] for found in known], axis=0)
            planes = np.full((len(images), *largest, 3), np.nan, dtype=np.float32)
            for room, found in zip(planes, known, strict=True):
                room[: found.shape[0], : found.shape[1]] = found
        scales = np.array([scale, scale / FIRST[-1].scale], dtype=np.float32)
        return flat, sizes, self._table.nodes, self._table.levels, planes, scales


def depth_map_of(
    camera: RefractiveCamera, planes: Hypotheses, found: NDArray[Any]
) -> DepthMap:
    """What PatchMatch settled upon; NaN where it is not known at all.

    Args:
        camera: of the image (H, W).
        planes: (H, W, 3), for the normals.
        found: (H, W, 5) of `uwsfm.dense.settle`.
    """
    shape = found.shape[:2]
    origins, dirs = camera.ray_from_img(pixel_rows(camera, 0, camera.height))
    slopes = (dirs / dirs[:, 2:]).reshape(*shape, 3)
    feet = origins.reshape(*shape, 3) - origins[:, 2].reshape(*shape, 1) * slopes
    inverse, moves, spread, likeness = (found[..., n].astype(float) for n in range(4))
    with np.errstate(invalid="ignore", divide="ignore"):
        depth = 1.0 / inverse
        steps = dirs[:, 2].reshape(shape)
        ranges = (depth - origins[:, 2].reshape(shape)) / steps
        spread = np.hypot(spread, LEAST_NOISE_PX)
        sure = (likeness > MIN_CORRELATION) & (spread < SURE_NOISE_PX)
        known = sure | (found[..., 4] >= MIN_AGREEING)
        known &= ranges > 0.0
        ranges[~known] = np.nan
        sensitivity = depth * depth / (steps * moves)
        sensitivity[~known] = np.nan
        # Along the surface: points are feet + slopes / w.
        right, down = (
            np.gradient(feet, axis=axis)
            + np.gradient(slopes, axis=axis) * depth[..., None]
            - slopes * (planes[..., part] * depth * depth)[..., None]
            for axis, part in ((1, 1), (0, 2))
        )
        normals = -np.cross(right, down)
        normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    normals[~known] = np.nan
    return DepthMap(
        ranges=ranges.astype(np.float32),
        sensitivity=sensitivity.astype(np.float32),
        spread=(spread / ASSUMED_NOISE_PX).astype(np.float32),
        normals=normals.astype(np.float32),
        plain=known & ~sure,
    )


def patchmatch_bytes(camera: RefractiveCamera, num_neighbours: int) -> float:
    """What an image needs, with its neighbours."""
    pixels = camera.width * camera.height
    each = BYTES_PER_PIXEL + BYTES_PER_NEIGHBOUR * num_neighbours
    return pixels * each + table_bytes(camera, num_neighbours)


def _resized(planes: Hypotheses, shape: tuple[int, ...]) -> Hypotheses:
    """Hypotheses of the nearest coarser pixel, followed to where a pixel is."""
    if planes.shape[:2] == shape:
        return planes.copy()
    y, x = np.mgrid[: shape[0], : shape[1]]
    i = np.minimum(y // 2, planes.shape[0] - 1)
    j = np.minimum(x // 2, planes.shape[1] - 1)
    found = planes[i, j]
    found[..., 1:] *= 0.5
    aside = ((x - 2 * j - 0.5), (y - 2 * i - 0.5))
    found[..., 0] += aside[0] * found[..., 1] + aside[1] * found[..., 2]
    return np.ascontiguousarray(found, dtype=np.float32)


def _nearest(xy: Array, values: Array, shape: tuple[int, int]) -> Array:
    """Of the nearest of points (N, 2) at each pixel."""
    from scipy.spatial import cKDTree

    y, x = np.mgrid[: shape[0], : shape[1]]
    at = np.column_stack([x.ravel() + 0.5, y.ravel() + 0.5])
    return values[cKDTree(xy).query(at)[1]].reshape(shape)


def _focal(camera: RefractiveCamera) -> float:
    """Pixels per tangent of the rays in water, in the middle of the image."""
    x, y = 0.5 * camera.width, 0.5 * camera.height
    _, dirs = camera.ray_from_img(np.array([[x - 0.5, y], [x + 0.5, y]]))
    slopes = dirs[:, :2] / dirs[:, 2:]
    return float(1.0 / np.linalg.norm(slopes[1] - slopes[0]))


def _scratch(num_samples: int, num: int) -> tuple[Any, ...]:
    return (
        np.empty((2, num_samples), dtype=np.float32),
        np.empty(num + 3 * patchmatch.NUM_CHOSEN, dtype=np.float32),
        np.empty(patchmatch.NUM_CHOSEN, dtype=np.int64),
        np.empty((4, 2), dtype=np.int64),
    )

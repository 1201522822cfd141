"""Depth maps against each other: what others confirm is kept, and averaged.

Every point of a depth map is projected exactly into the images of its neighbours and
compared with what their depth maps say there, in units of both standard deviations.
Those that agree move it along its own line of sight, by inverse variance.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from uwsfm.dense.depth_map import DepthMap, Plane, pixel_rows
from uwsfm.dense.lookup import looked_up
from uwsfm.dense.voxels import Fused
from uwsfm.geometry import rigid3
from uwsfm.geometry.rigid3 import Array
from uwsfm.models.refractive import RefractiveCamera

AGREE_STDDEVS = 3.0
HIDDEN_STDDEVS = 15.0
"""A surface that is nearer to another camera by more than this hides the point, and
says nothing about it."""
EDGE_PX, EDGE_STEP, EDGE_SHARE = 3, 0.05, 1e-3
"""A step in range by more than this share within so many pixels is an edge; colours
beside it count so much."""
_NORMAL_REACH = 2
"""Pixels on each side whose points give the normal."""
_MAX_SLANT = 0.15
"""Cosine between surface and line of sight; flatter than that means a step."""
LEAST_ALONE = 0.5
"""Errors of depth maps beside each other correlate by 0.45 to 0.65, on a rendered dive
whose surface is known; on easier ones by less."""
_SAMPLE_STEP = 4
_MIN_SAMPLES = 2000
_GATE_PX = 2.0


@dataclass(frozen=True, kw_only=True, eq=False)
class Placed:
    """A depth map in the world."""

    camera: RefractiveCamera
    cam_from_world: Array
    """(7,)"""
    points: NDArray[np.float32]
    """(H, W, 3) in the camera; NaN where there are none."""
    distance: Plane
    """(H, W) of the points from the projection centre."""
    sensitivity: Plane
    """(H, W) metres per pixel of disparity, of ordinary texture: more where a depth is
    known less well."""
    calibration: Plane
    """(H, W) standard deviation from the calibration, metres; zero if it has none."""
    normals: NDArray[np.float32]
    """(H, W, 3) in the camera, towards it; NaN at steps and borders."""
    plain: NDArray[np.bool_]
    """(H, W) where the image itself shows no depth."""
    images: frozenset[tuple[int, int]]
    """Camera and frame of all images that it was made of."""

    def alone(self, other: Placed) -> float:
        """Share of the variance of both that their difference shows.

        Errors come from images, and what two depth maps have in common cancels: so far
        as their images are the same, so are their errors. Even of the same images each
        pixel takes a few, and its own as the reference.
        """
        common = len(self.images & other.images)
        share = common / max(len(self.images | other.images), 1)
        return max(1.0 - share, LEAST_ALONE)


@dataclass(frozen=True, kw_only=True)
class Noise:
    """Standard deviations in pixels of disparity."""

    own: float
    """Of a depth map from the surface."""
    between: float
    """Of one depth map from another, per root of two: less, as they have images in
    common. By this they agree or not."""


@dataclass(frozen=True, kw_only=True)
class Rule:
    """Which points are kept."""

    min_views: int
    """Depth maps that have to agree, this one included."""
    keep_single: bool
    """Whether to keep what no other depth map sees at all."""


@dataclass(frozen=True, kw_only=True)
class FuseCounts:
    num_points: int
    """Measured by the depth map, in these rows."""
    num_confirmed: int
    num_contradicted: int
    """More depth maps see something else there than agree."""
    num_unchecked: int
    """Too few other depth maps see anything there."""


@dataclass(frozen=True, kw_only=True, eq=False)
class _Told:
    """What another depth map says of points (N,); NaN where nothing."""

    difference: Array
    """Its distance minus that of the point, metres."""
    sensitivity: Array
    sight: Array
    """(N, 3) unit, from the other camera to the point, in the world."""
    xy: Array
    """(N, 2) its pixels."""


def differences_px(view: Placed, others: list[Placed]) -> Array:
    """Differences between depth maps in pixels of disparity, of both together (n, 2).

    Where both see the same surface their spread is the noise of one disparity. In the
    second column, what depth maps of the same images have in common is made up for.
    """
    rows = np.arange(0, view.distance.shape[0], _SAMPLE_STEP)
    columns = np.arange(0, view.distance.shape[1], _SAMPLE_STEP)
    grid = np.ix_(rows, columns)
    points = view.points[grid].reshape(-1, 3).astype(np.float64)
    own = view.sensitivity[grid].ravel()
    keep = np.isfinite(points[:, 0])
    in_world = rigid3.transform(rigid3.inverse(view.cam_from_world), points[keep])
    found = []
    for other in others:
        told = _told(other, in_world)
        px = told.difference / np.hypot(own[keep], told.sensitivity)
        with np.errstate(invalid="ignore"):
            px = px[np.abs(px) < _GATE_PX]
        found.append(np.column_stack([px, px / np.sqrt(view.alone(other))]))
    return np.concatenate(found) if found else np.empty((0, 2))


def robust_stddev(values: Array) -> float | None:
    """Of a sample around zero, from its 90th percentile; None if it is too small.

    Matching errors have long tails: the median alone would promise too much.
    """
    if len(values) < _MIN_SAMPLES:
        return None
    spread = np.abs(values - np.median(values))
    return float(np.percentile(spread, 90.0) / 1.645)


def fuse(
    view: Placed,
    others: list[Placed],
    image: NDArray[np.uint8],
    noise: Noise,
    rule: Rule,
    rows: slice = slice(None),
) -> tuple[Fused, FuseCounts]:
    """The points of a depth map that others confirm, and what they agree upon.

    Args:
        view: the depth map.
        others: its neighbours.
        image: (H, W, 3) of the view, blue, green, red.
        noise: of their disparities.
        rule: what is kept.
        rows: of the depth map; memory grows with them.
    """
    top, bottom, _ = rows.indices(view.distance.shape[0])
    measured = np.isfinite(view.distance[top:bottom])
    block = np.flatnonzero(measured & np.isfinite(view.normals[top:bottom, :, 0]))
    block += top * view.distance.shape[1]
    world_from_cam = rigid3.inverse(view.cam_from_world)
    in_cam = view.points.reshape(-1, 3)[block].astype(np.float64)
    sensitivity = view.sensitivity.ravel()[block].astype(np.float64)
    points = rigid3.transform(world_from_cam, in_cam)
    normals = rigid3.rotate(
        world_from_cam, view.normals.reshape(-1, 3)[block].astype(np.float64)
    )
    sight = points - world_from_cam[4:]
    distance = np.linalg.norm(sight, axis=1)
    sight /= distance[:, None]
    slant = np.einsum("ni,ni->n", normals, sight)
    weight = sensitivity**-2.0
    plain = view.plain.ravel()[block]
    verdicts = _Verdicts(len(points))
    for other in others:
        told = _told(other, points)
        # A step along the other's sight moves the surface; along ours by this much.
        turn = np.einsum("ni,ni->n", normals, told.sight) / slant
        turn = np.clip(turn, 1.0 / 3.0, 3.0)
        agrees = verdicts.hear(
            *(noise.between, sensitivity),
            *(told.difference * turn, told.sensitivity * turn),
        )
        asked = np.flatnonzero(plain & agrees)
        mark = other.plain.view(np.uint8)
        plain[asked] = looked_up(mark, told.xy[asked], nearest=True) > 0
    weight = sensitivity**-2.0 + verdicts.weight
    points += (verdicts.moved / weight)[:, None] * sight
    contradicted = verdicts.num_against >= verdicts.num_views
    confirmed = (verdicts.num_views >= rule.min_views) & ~contradicted
    keep = confirmed | ~verdicts.seen if rule.keep_single else confirmed
    kept = block[keep]
    systematic = view.calibration.ravel()[kept]
    fused = Fused(
        points=points[keep],
        normals=normals[keep],
        colors=image.reshape(-1, 3)[kept][:, ::-1],
        stddev=np.sqrt(noise.own**2 / weight[keep] + systematic**2),
        num_views=verdicts.num_views[keep],
        view_range=distance[keep],
        plain=plain[keep],
        color_weight=(slant**2 * distance**-2.0)[keep]
        * _color_shares(view.distance, kept, top, bottom),
    )
    return fused, FuseCounts(
        num_points=int(np.count_nonzero(measured)),
        num_confirmed=int(np.count_nonzero(confirmed)),
        num_contradicted=int(np.count_nonzero(contradicted)),
        num_unchecked=int(np.count_nonzero(~confirmed & ~contradicted)),
    )


def _color_shares(
    distance: Plane, pixels: NDArray[np.int64], top: int, bottom: int
) -> Array:
    """How much the colours of pixels (n,) count: little beside a step, whose colour is
    often that of the other surface.

    Args:
        distance: (H, W)
        pixels: in rows top to bottom - 1.
        top, bottom: those rows.
    """
    first = max(top - EDGE_PX, 0)
    around = distance[first : bottom + EDGE_PX]
    box = np.ones((2 * EDGE_PX + 1, 2 * EDGE_PX + 1), dtype=np.uint8)
    nothing = ~np.isfinite(around)
    far = cv2.dilate(np.where(nothing, -np.inf, around), box)
    near = cv2.erode(np.where(nothing, np.inf, around), box)
    with np.errstate(invalid="ignore", over="ignore"):
        step = far - near > EDGE_STEP * near
    step |= cv2.dilate(nothing.astype(np.uint8), box) > 0
    return np.where(step.ravel()[pixels - first * distance.shape[1]], EDGE_SHARE, 1.0)


class _Verdicts:
    """What other depth maps say of points (N,)."""

    def __init__(self, count: int) -> None:
        self.moved, self.weight = np.zeros(count), np.zeros(count)
        self.num_views = np.ones(count, dtype=np.int64)
        self.num_against = np.zeros(count, dtype=np.int64)
        self.seen = np.zeros(count, dtype=bool)
        """By any other."""

    def hear(
        self, noise: float, own: Array, step: Array, spread: Array
    ) -> NDArray[np.bool_]:
        """One of them; with which points it agrees.

        Args:
            noise: `Noise.between`.
            own: (N,) metres per pixel of disparity.
            step: (N,) how much farther it has the surface; NaN where it has none.
            spread: (N,) its metres per pixel.
        """
        both = noise * np.hypot(own, spread)
        self.seen |= np.isfinite(step)
        with np.errstate(invalid="ignore"):
            agrees = np.abs(step) <= AGREE_STDDEVS * both
            self.num_against += ~agrees & (step > -HIDDEN_STDDEVS * both)
        w = spread[agrees] ** -2.0
        self.moved[agrees] += w * step[agrees]
        self.weight[agrees] += w
        self.num_views[agrees] += 1
        return agrees


def normals_of(points: NDArray[np.float32], distance: Plane) -> NDArray[np.float32]:
    """Normals (H, W, 3) in the camera, towards it; NaN at steps and borders.

    Args:
        points: (H, W, 3) in the camera.
        distance: (H, W) of them.
    """
    across, down = (_differences(points, axis) for axis in (1, 0))
    normals = np.cross(across, down)
    with np.errstate(invalid="ignore", divide="ignore"):
        normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
        slant = np.einsum("yxi,yxi->yx", normals, points) / distance
        normals *= -np.sign(slant)[..., None]
        normals[~(np.abs(slant) > _MAX_SLANT)] = np.nan
    return normals


def _differences(points: NDArray[np.float32], axis: int) -> NDArray[np.float32]:
    """Between the points on both sides of a pixel, or of one side and itself."""
    reach = _NORMAL_REACH
    ahead, behind = np.full_like(points, np.nan), np.full_like(points, np.nan)
    first, last = [slice(None)] * 2, [slice(None)] * 2
    first[axis], last[axis] = slice(None, -reach), slice(reach, None)
    step = points[tuple(last)] - points[tuple(first)]
    ahead[tuple(first)], behind[tuple(last)] = step, step
    both = ahead + behind
    return np.where(
        np.isfinite(both), both, np.where(np.isfinite(ahead), ahead, behind)
    )


def _told(other: Placed, points: Array) -> _Told:
    in_cam = rigid3.transform(other.cam_from_world, points)
    xy, valid = other.camera.img_from_point(in_cam)
    distance = np.linalg.norm(in_cam, axis=1)
    sensitivity = looked_up(other.sensitivity, xy, nearest=True).astype(np.float64)
    seen = looked_up(other.distance, xy).astype(np.float64)
    nearest = looked_up(other.distance, xy, nearest=True)
    with np.errstate(invalid="ignore"):
        # Between two surfaces there is none.
        seen[~(np.abs(seen - nearest) < sensitivity) | ~valid] = np.nan
    world_from_cam = rigid3.inverse(other.cam_from_world)
    sight = points - world_from_cam[4:]
    sight /= distance[:, None]
    return _Told(
        difference=seen - distance, sensitivity=sensitivity, sight=sight, xy=xy
    )


def placed(
    camera: RefractiveCamera,
    cam_from_world: Array,
    depth: DepthMap,
    calibration: Plane,
    images: frozenset[tuple[int, int]] = frozenset(),
) -> Placed:
    """A depth map with its points."""
    origins, dirs = camera.ray_from_img(pixel_rows(camera, 0, camera.height))
    shape = depth.ranges.shape
    exact = (origins + depth.ranges.reshape(-1, 1) * dirs).reshape(*shape, 3)
    points = exact.astype(np.float32)
    distance = np.linalg.norm(exact, axis=2).astype(np.float32)
    normals = depth.normals
    alike = depth.spread is None
    return Placed(
        camera=camera,
        cam_from_world=cam_from_world,
        points=points,
        distance=distance,
        sensitivity=depth.sensitivity if alike else depth.sensitivity * depth.spread,
        calibration=calibration,
        normals=normals_of(points, distance) if normals is None else normals,
        plain=np.zeros(shape, dtype=bool) if depth.plain is None else depth.plain,
        images=images,
    )

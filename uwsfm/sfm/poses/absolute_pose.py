"""Pose of a rig of refractive cameras from pixels and the points that they see.

Behind a port every pixel has its own viewpoint, so that a single camera already is a
generalised one: hypotheses come from three water rays, everything is decided and
adjusted on the exact reprojection error in true pixels. No pinhole and no scene
distance is assumed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from uwsfm.errors import InputError
from uwsfm.geometry import rigid3
from uwsfm.geometry.rays import finite_rows
from uwsfm.geometry.rigid3 import Array
from uwsfm.models.refractive import RefractiveCamera
from uwsfm.sfm.poses.absolute_pose_ransac import search_pose, trials_needed
from uwsfm.sfm.poses.kernel_rows import (
    IndexArray,
    RigRows,
    checked_views,
    near_rays,
    rays_in_rig,
    rig_rows,
)
from uwsfm.sfm.poses.rig_pose_kernel import (
    covariance_from_hessian,
    refine_pose,
    squared_errors,
)
from uwsfm.solver.losses import LOSS_CODES

Mask = NDArray[np.bool_]
Matches = tuple[Array, IndexArray, Array]

CHUNK = 64
"""Samples drawn at once: what is drawn does not depend on when the search ends."""
MEDIAN_ERROR = 1.1774
"""Median length of a 2-vector of unit normal noise: sqrt(2 log 2)."""
NOISE_FLOOR_PX = 1e-6
"""Noise below this is rounding, and would leave good matches out."""


@dataclass(frozen=True, kw_only=True)
class AbsolutePoseOptions:
    """How a pose is searched and adjusted."""

    max_error_px: float = 8.0
    """True reprojection error above which a match is an outlier. The final adjustment
    cuts at `cut_stddevs` of the noise that it finds, so this may be generous."""
    confidence: float = 0.9999
    """Of having drawn a sample without outliers."""
    min_trials: int = 64
    max_trials: int = 20000
    """Enough for 8 % of inliers."""
    min_num_inliers: int = 6
    """Fewer are no pose. Three always fit, a fourth tells the solutions apart."""
    cut_stddevs: float = 3.5
    """Matches with larger errors do not pull at the pose; 0.2 % of normal errors."""
    max_iterations: int = 30
    """Of each adjustment."""
    seed: int = 0

    def __post_init__(self) -> None:
        if not self.max_error_px > 0.0 or not self.cut_stddevs > 0.0:
            raise InputError("max_error_px and cut_stddevs must be positive")
        if not 0.0 < self.confidence < 1.0:
            raise InputError(f"confidence must be in (0, 1), got {self.confidence}")
        if self.min_num_inliers < 4 or not 0 < self.min_trials <= self.max_trials:
            raise InputError("a pose takes 4 inliers, and one trial, at least")


@dataclass(frozen=True, kw_only=True)
class RigPose:
    """Where a rig is, and what speaks for it."""

    rig_from_world: Array
    """(7,)"""
    inliers: Mask
    """(N,) true reprojection error below `AbsolutePoseOptions.max_error_px`."""
    num_inliers: int
    errors_px: Array
    """(N,) true reprojection errors; inf where the point does not project."""
    noise_px: float
    """Standard deviation of one coordinate, from the median error of the inliers."""
    covariance: Array
    """(6, 6) of the tangent [rotation, translation] as `rigid3.perturb`, of the noise
    in the image alone: the points are taken as exact. inf if not determined."""


def estimate_rig_pose(
    cameras: Sequence[RefractiveCamera],
    cam_from_rig: ArrayLike,
    camera_idx: ArrayLike,
    xy: ArrayLike,
    points: ArrayLike,
    options: AbsolutePoseOptions | None = None,
) -> RigPose | None:
    """Find the pose of a rig from matches, many of which may be wrong.

    Args:
        cameras: (C,) with their ports.
        cam_from_rig: (C, 7).
        camera_idx: (N,) the camera of each match.
        xy: (N, 2) pixels.
        points: (N, 3) world, metres. Rows that are not finite are outliers.
        options: Defaults suit maps in metres and errors of up to some pixels.

    Returns:
        The pose, the same for the same seed whatever else runs; None if no pose has
        ``min_num_inliers``.

    Raises:
        InputError: arrays of other shapes, or an index without a camera.
    """
    options = options or AbsolutePoseOptions()
    matches, rig = checked(cameras, cam_from_rig, camera_idx, xy, points)
    rays, _ = near_rays(cameras, matches[1], matches[2])
    rays = rays_in_rig(rays, matches[1], np.asarray(cam_from_rig, dtype=np.float64))
    usable = finite_rows(rays) & finite_rows(matches[0])
    rows = np.flatnonzero(usable)
    if len(rows) < options.min_num_inliers:
        return None
    rows = rows[np.argsort(matches[1][rows], kind="stable")]  # by camera
    world, index, pixels = matches
    usable_matches = (world[rows], index[rows], pixels[rows])
    pose = _search(rays[rows], usable_matches, rig, options)
    if pose is None:
        return None
    return _refined(pose, matches, rig, options)


def checked(
    cameras: Sequence[RefractiveCamera],
    cam_from_rig: ArrayLike,
    camera_idx: ArrayLike,
    xy: ArrayLike,
    points: ArrayLike,
) -> tuple[Matches, RigRows]:
    """Matches and rig as the kernels read them.

    Raises:
        InputError: as of `estimate_rig_pose`.
    """
    rig, _ = rig_rows(cameras, cam_from_rig)
    index, pixels = checked_views(len(cameras), camera_idx, xy)
    world = np.ascontiguousarray(points, dtype=np.float64)
    if world.shape != (len(index), 3):
        raise InputError(f"points.shape={world.shape}, expected ({len(index)}, 3)")
    return (world, index, pixels), rig


def _search(
    rays: Array, matches: Matches, rig: RigRows, options: AbsolutePoseOptions
) -> Array | None:
    """The best pose row (12,) of RANSAC."""
    rng = np.random.default_rng(options.seed)
    limit = options.max_error_px**2
    pose, best, inliers, trials = np.full(12, np.nan), np.inf, 0, 0
    needed: float = options.max_trials
    while trials < max(options.min_trials, min(needed, options.max_trials)):
        samples = _draw(rng, matches[1])
        best, found = search_pose(samples, rays, matches, rig, limit, best, pose)
        trials += len(samples)
        if found >= 0:
            inliers = found
        needed = trials_needed(inliers, len(rays), options.confidence)
    return pose if inliers >= options.min_num_inliers else None


def _draw(rng: np.random.Generator, camera_idx: IndexArray) -> IndexArray:
    """Samples (CHUNK, 3) of different matches, of one camera each where it has three.

    Args:
        camera_idx: (N,) ascending.
    """
    u = rng.random((CHUNK, 3))
    num = len(camera_idx)
    first = (u[:, 0] * num).astype(np.int64)
    low = np.searchsorted(camera_idx, camera_idx[first], side="left")
    count = np.searchsorted(camera_idx, camera_idx[first], side="right") - low
    few = count < 3
    low[few], count[few] = 0, num
    second = low + (u[:, 1] * (count - 1)).astype(np.int64)
    second += second >= first
    third = low + (u[:, 2] * (count - 2)).astype(np.int64)
    third += third >= np.minimum(first, second)
    third += third >= np.maximum(first, second)
    return np.stack([first, second, third], axis=1)


def _refined(
    pose: Array,
    matches: Matches,
    rig: RigRows,
    options: AbsolutePoseOptions,
) -> RigPose | None:
    """Robust adjustment, then least squares on what the noise explains."""
    squares = np.empty(len(matches[1]))
    pose = pose.copy()
    limit = options.max_error_px**2
    for loss in ("cauchy", "l2", "l2"):
        squared_errors(pose, matches, rig, squares)
        inliers = squares < limit
        if np.count_nonzero(inliers) < options.min_num_inliers:
            return None
        noise = _noise_px(squares, inliers)
        use = inliers
        if loss == "l2":
            use = inliers & (squares < (options.cut_stddevs * noise) ** 2)
        _, hessian = refine_pose(
            pose, matches, use, rig, LOSS_CODES[loss], noise, options.max_iterations
        )
    squared_errors(pose, matches, rig, squares)
    inliers = squares < limit
    num_inliers = int(np.count_nonzero(inliers))
    if num_inliers < options.min_num_inliers:
        return None
    noise = _noise_px(squares, inliers)
    rows = pose.reshape(3, 4)
    return RigPose(
        rig_from_world=rigid3.from_rotmat(rows[:, :3], rows[:, 3]),
        inliers=inliers,
        num_inliers=num_inliers,
        errors_px=np.sqrt(squares),
        noise_px=noise,
        covariance=covariance_from_hessian(hessian, noise),
    )


def _noise_px(squares: Array, inliers: Mask) -> float:
    median = float(np.sqrt(np.median(squares[inliers])))
    return max(median / MEDIAN_ERROR, NOISE_FLOOR_PX)

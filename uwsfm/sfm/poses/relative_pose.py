"""Relative pose of two refractive cameras, or of two frames of a rig, from matches.

Hypotheses come from central cameras: seen from where they nearly meet, the water rays
of an image are those of a scene far away, good to some pixels. Everything after that is
exact: the length of the motion, which says how near the scene is and so how much the
rays of a camera differ, is searched, and all six parameters are adjusted on the gaps of
the water rays in true pixels.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from uwsfm.errors import InputError
from uwsfm.geometry import rigid3
from uwsfm.geometry.rays import finite_rows
from uwsfm.geometry.rigid3 import Array
from uwsfm.models.refractive import RefractiveCamera
from uwsfm.sfm.poses.kernel_rows import (
    IndexArray,
    RigRows,
    checked_views,
    near_rays,
    rays_in_rig,
    rig_rows,
)
from uwsfm.sfm.poses.relative_pose_kernel import (
    gaps,
    leverages,
    midpoints,
    pair_equations,
    refine_pair,
)
from uwsfm.sfm.poses.relative_pose_options import RelativePoseOptions
from uwsfm.sfm.poses.relative_pose_start import (
    MotionLine,
    central_poses,
    distinct_ends,
    image_pairs,
    ransac_options,
)
from uwsfm.sfm.poses.rig_pose_kernel import covariance_from_hessian
from uwsfm.solver.losses import LOSS_CODES

Mask = NDArray[np.bool_]
PairRows = tuple[IndexArray, Array, Array, IndexArray, Array, Array]

MEDIAN_GAP = 0.6745
"""Median of |x| for unit normal x."""
NOISE_FLOOR_PX = 1e-6
"""Noise below this is rounding, and would leave good matches out."""
SCENE_DEPTHS = np.geomspace(0.1, 100.0, 31)
"""Median distances of the scene that are tried, metres: factors of 1.26."""
MAX_STARTS = 2
START_NOISE_PX = 0.1
"""Weighs what is known of the length, as long as the noise is not."""
MAX_ROUNDS = 12
MAX_LEVERAGE = 0.5
"""A match that alone says as much of a direction as all others together is not used:
no other one could show that it is wrong. Three times the average, for few matches."""
LIKELY_STDDEVS = np.linspace(-2.0, 2.0, 9)
HELD_WEIGHT = 1e10
"""Of a length that is held, pixels squared: any number of matches weighs less."""
MAX_LENGTH_STDDEV = 0.25
"""A length known less well than this, relative, is called not determined."""


@dataclass(frozen=True, kw_only=True)
class RelativePose:
    """The motion between two views, and what speaks for it."""

    b_from_a: Array
    """(7,) of the cameras, or rigs."""
    inliers: Mask
    """(N,) gap below `RelativePoseOptions.max_error_px`."""
    num_inliers: int
    gaps_px: Array
    """(N,) see `epipolar.ray_gaps_px`; inf where rays do not meet in front."""
    noise_px: float
    """Standard deviation of a coordinate, from the median gap of the inliers."""
    covariance: Array
    """(6, 6) of the tangent [rotation, translation] as `rigid3.perturb`, what is known
    of the length included; inf if not determined."""
    length_stddev: float
    """Relative standard deviation of the length from these matches alone; inf if they
    do not determine it at all."""
    length_determined: bool
    """By the matches alone. If not, lengths are only those of the options, and the
    motion must be scaled by other means."""
    median_angle: float
    """Median angle between the rays of the inliers, radians."""


def estimate_relative_pose(
    camera_a: RefractiveCamera,
    camera_b: RefractiveCamera,
    xy_a: ArrayLike,
    xy_b: ArrayLike,
    options: RelativePoseOptions | None = None,
) -> RelativePose | None:
    """Find the relative pose of two images from matches, many of which may be wrong.

    Args:
        camera_a: With its port.
        camera_b: With its port; may be the same.
        xy_a: (N, 2) pixels of the first image.
        xy_b: (N, 2) pixels of the second one.
        options: Defaults suit scenes within a few metres.

    Returns:
        The pose; None if no pose has ``min_num_inliers``.

    Raises:
        InputError: arrays of other shapes.
    """
    num = len(np.asarray(xy_a))
    index = np.zeros(num, dtype=np.int64)
    poses = np.stack([rigid3.IDENTITY, rigid3.IDENTITY])
    motions = estimate_rig_relative_poses(
        (camera_a, camera_b), poses, index, xy_a, index + 1, xy_b, options
    )
    return motions[0] if motions else None


def estimate_rig_relative_poses(
    cameras: Sequence[RefractiveCamera],
    cam_from_rig: ArrayLike,
    camera_a: ArrayLike,
    xy_a: ArrayLike,
    camera_b: ArrayLike,
    xy_b: ArrayLike,
    options: RelativePoseOptions | None = None,
) -> list[RelativePose]:
    """Find how a rig moved between two frames, from the matches of all image pairs.

    A scene that is nearly flat leaves two motions that explain its matches about
    equally well: both are returned, and only other frames can tell. Several cameras
    give the length of the motion too, from the rig's own lengths.

    Args:
        cameras: (C,) with their ports.
        cam_from_rig: (C, 7).
        camera_a: (N,) the camera of each match in the first frame.
        xy_a: (N, 2) pixels there.
        camera_b: (N,) the camera of each match in the second frame.
        xy_b: (N, 2) pixels there.
        options: Defaults suit scenes within a few metres.

    Returns:
        Poses, the best first, the same for the same seed; none if no pose has
        ``min_num_inliers``.

    Raises:
        InputError: arrays of other shapes, or an index without a camera.
    """
    options = options or RelativePoseOptions()
    rig, poses = rig_rows(cameras, cam_from_rig)
    index_a, pixels_a = checked_views(len(cameras), camera_a, xy_a)
    index_b, pixels_b = checked_views(len(cameras), camera_b, xy_b)
    if len(index_a) != len(index_b):
        raise InputError(f"{len(index_a)} and {len(index_b)} pixels are no matches")
    near_a, centres_a = near_rays(cameras, index_a, pixels_a)
    near_b, centres_b = near_rays(cameras, index_b, pixels_b)
    rays_a = rays_in_rig(near_a, index_a, poses)
    rays_b = rays_in_rig(near_b, index_b, poses)
    matches = (index_a, pixels_a, rays_a, index_b, pixels_b, rays_b)
    usable = finite_rows(rays_a) & finite_rows(rays_b)
    ends: list[tuple[float, Array]] = []
    for rows, a, b in image_pairs(index_a, index_b, usable):
        ransac = ransac_options(options, (cameras[a], cameras[b]))
        for moved in central_poses(near_a[rows], near_b[rows], ransac):
            line = MotionLine.through(
                moved, poses[a], poses[b], centres_a[a], centres_b[b]
            )
            for start in _lengths(line, matches, usable, rig, options):
                pose = line.at(start)
                ends.append((_adjusted(pose, matches, usable, rig, options), pose))
    motions = (
        _refined(pose, matches, usable, rig, options) for pose in distinct_ends(ends)
    )
    return [motion for motion in motions if motion is not None]


def _lengths(
    line: MotionLine,
    matches: PairRows,
    usable: Mask,
    rig: RigRows,
    options: RelativePoseOptions,
) -> list[float]:
    """The lengths of motion, at most MAX_STARTS, whose gaps are locally the least."""
    distance = _scene_distance(line.at(1e3), matches, usable) / 1e3
    if not distance > 0.0:
        return []
    lengths = SCENE_DEPTHS / distance
    if options.length_m is not None:
        spread = options.length_stddev * LIKELY_STDDEVS
        lengths = options.length_m * np.unique(np.exp(spread))
    errors = []
    for length in lengths:
        error = _truncated(line.at(length), matches, rig, options.max_central_error_px)
        errors.append(float(np.sum(error[usable])))
    padded = np.array([np.inf, *errors, np.inf])
    lowest = np.flatnonzero((padded[1:-1] <= padded[:-2]) & (padded[1:-1] < padded[2:]))
    order = lowest[np.argsort(np.array(errors)[lowest], kind="stable")]
    return [float(lengths[k]) for k in order[:MAX_STARTS]]


def _scene_distance(pose: Array, matches: PairRows, use: Mask) -> float:
    """Median distance of where the rays meet from the first rig; NaN if nowhere."""
    points = np.empty((len(use), 3))
    midpoints(pose, matches, points)
    distances = np.linalg.norm(points[use] - pose[3::4], axis=1)
    distances = distances[np.isfinite(distances)]
    return float(np.median(distances)) if len(distances) else math.nan


def _truncated(pose: Array, matches: PairRows, rig: RigRows, limit_px: float) -> Array:
    """Squared gaps (N,), at most ``limit_px`` squared."""
    found = np.empty(len(matches[0]))
    gaps(pose, matches, rig, found)
    return np.minimum(found**2, limit_px**2)


def _length_prior(
    pose: Array,
    matches: PairRows,
    use: Mask,
    noise_px: float,
    options: RelativePoseOptions,
) -> tuple[float, float]:
    """What is known of the length: its logarithm, and the weight of that."""
    if options.length_m is not None:
        if options.length_stddev == 0.0:
            return math.log(options.length_m), HELD_WEIGHT
        weight = (noise_px / options.length_stddev) ** 2
        return math.log(options.length_m), weight
    length = float(np.linalg.norm(pose[3::4]))
    distance = _scene_distance(pose, matches, use)
    if not (length > 0.0 and distance > 0.0):
        return 0.0, 0.0
    likely = options.scene_distance_m * length / distance
    weight = (noise_px / math.log(options.scene_distance_factor)) ** 2
    return math.log(likely), weight


def _adjusted(
    pose: Array,
    matches: PairRows,
    usable: Mask,
    rig: RigRows,
    options: RelativePoseOptions,
) -> float:
    """Adjust a start, in place, to all matches robustly; its truncated error."""
    cauchy = LOSS_CODES["cauchy"]
    for scale in (options.max_central_error_px / 3.0, options.max_error_px / 3.0):
        prior = _length_prior(pose, matches, usable, START_NOISE_PX, options)
        refine_pair(
            pose, matches, usable, rig, (cauchy, scale), prior, options.max_iterations
        )
    return float(np.sum(_truncated(pose, matches, rig, options.max_error_px)[usable]))


def _refined(
    pose: Array,
    matches: PairRows,
    usable: Mask,
    rig: RigRows,
    options: RelativePoseOptions,
) -> RelativePose | None:
    """Robust adjustment, then least squares on what the noise explains."""
    found = np.empty(len(usable))
    hessian: Array | None = None
    use, before = usable, np.inf
    for _ in range(MAX_ROUNDS):
        gaps(pose, matches, rig, found)
        inliers = usable & (np.abs(found) < options.max_error_px)
        if np.count_nonzero(inliers) < options.min_num_inliers:
            return None
        noise = _noise_px(found, inliers)
        loss, chosen = LOSS_CODES["cauchy"], inliers
        if hessian is not None:
            cut = options.cut_stddevs * noise
            loss = LOSS_CODES["l2"]
            chosen = inliers & _explained(pose, matches, rig, hessian, found, use, cut)
            if np.array_equal(chosen, use) and abs(noise - before) < 0.01 * noise:
                break
            before = noise
        use = chosen
        prior = _length_prior(pose, matches, use, noise, options)
        _, hessian = refine_pair(
            pose, matches, use, rig, (loss, noise), prior, options.max_iterations
        )
    assert hessian is not None  # of the first round
    return _result(pose, matches, use, rig, hessian, options)


def _explained(
    pose: Array,
    matches: PairRows,
    rig: RigRows,
    hessian: Array,
    found: Array,
    use: Mask,
    cut_px: float,
) -> Mask:
    """Mask (N,) of the gaps that the noise explains, and that others confirm.

    A wrong match whose rays meet just before a port pulls the pose until it fits, and
    is then the only one to tell how well: see MAX_LEVERAGE. The gaps of those that the
    pose was fitted to are smaller than the noise, by their leverage; those of others
    are larger.

    Args:
        hessian: Of the adjustment that ``pose`` comes from.
        found: (N,) gaps.
        use: (N,) the matches it was adjusted to.
        cut_px: The largest gap if the pose were exact.
    """
    covariance = covariance_from_hessian(hessian, 1.0)
    leverage = np.empty(len(found))
    if not np.isfinite(covariance).all():
        return np.abs(found) < cut_px
    leverages(pose, matches, rig, covariance, leverage)
    others = ~use  # what it would be if they were in use
    leverage[others] = 1.0 - 1.0 / (1.0 + leverage[others])
    most = max(MAX_LEVERAGE, 3.0 * 6 / np.count_nonzero(use))
    with np.errstate(invalid="ignore", divide="ignore"):
        variance = np.where(use, 1.0 - leverage, 1.0 / (1.0 - leverage))
        return (np.abs(found) < cut_px * np.sqrt(variance)) & (leverage < most)


def _result(
    pose: Array,
    matches: PairRows,
    use: Mask,
    rig: RigRows,
    hessian: Array,
    options: RelativePoseOptions,
) -> RelativePose | None:
    """What was found, with the gaps and their noise at the final pose."""
    found = np.empty(len(use))
    gaps(pose, matches, rig, found)
    inliers = np.abs(found) < options.max_error_px
    if np.count_nonzero(inliers) < options.min_num_inliers:
        return None
    noise = _noise_px(found, inliers)
    stddev = _length_stddev(pose, matches, use, rig, noise)
    rows = pose.reshape(3, 4)
    return RelativePose(
        b_from_a=rigid3.from_rotmat(rows[:, :3], rows[:, 3]),
        inliers=inliers,
        num_inliers=int(np.count_nonzero(inliers)),
        gaps_px=np.abs(found),
        noise_px=noise,
        covariance=covariance_from_hessian(hessian, noise),
        length_stddev=stddev,
        length_determined=stddev < MAX_LENGTH_STDDEV,
        median_angle=_median_angle(pose, matches, inliers),
    )


def _noise_px(found: Array, inliers: Mask) -> float:
    return max(float(np.median(np.abs(found[inliers]))) / MEDIAN_GAP, NOISE_FLOOR_PX)


def _length_stddev(
    pose: Array, matches: PairRows, use: Mask, rig: RigRows, noise_px: float
) -> float:
    """Relative, of the length of the motion, by the gaps alone."""
    hessian, grad = np.empty((6, 6)), np.empty(6)
    robust = (LOSS_CODES["l2"], 1.0)
    pair_equations(pose, matches, use, rig, robust, (0.0, 0.0), hessian, grad)
    shift = covariance_from_hessian(hessian, noise_px)[3:, 3:]
    if not np.isfinite(shift).all():
        return math.inf
    motion = pose[3::4]
    square = float(motion @ motion)
    variance = max(float(motion @ shift @ motion), 0.0)
    return math.sqrt(variance) / square if square else math.inf


def _median_angle(pose: Array, matches: PairRows, inliers: Mask) -> float:
    dirs_a = matches[2][inliers, 3:] @ pose.reshape(3, 4)[:, :3].T
    dirs_b = matches[5][inliers, 3:]
    sine = np.linalg.norm(np.cross(dirs_a, dirs_b), axis=1)
    cosine = np.einsum("ni,ni->n", dirs_a, dirs_b)
    return float(np.median(np.arctan2(sine, cosine)))

"""Points of a scene's tracks, and which observations agree with them.

Tracks may hold keypoints of other points. The intersection in least squares is exact
and cheap where all rays of a track agree; one wrong ray spoils it for all, so where an
observation misses it by more than the tolerance, the point is searched that most
images see, as the mapper does.
"""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from uwsfm._base.indices import renumbered
from uwsfm.geometry import rigid3
from uwsfm.geometry.rays import finite_rows, max_ray_angles, triangulate_tracks
from uwsfm.geometry.rigid3 import Array
from uwsfm.scene import IndexArray, Scene
from uwsfm.sfm.mapping.tracks import triangulate
from uwsfm.sfm.mapping.triangulation import Views

MIN_ANGLE_DEG = 1.5
"""A point nearer to a camera than this many degrees of parallax has no depth."""
MOST = 0.6
"""Share of a track that agrees on its point if the rest is wrong: two of three. Where a
camera is late, or turned, each half of a track agrees with itself: to take the better
half would hide what is wrong with the model."""
WIDER, LEAST_RANGE = 2.0, 1.25
"""Distances of points that three images agree on reach from some share of their image's
median to some multiple of it. Points of two may be so much farther from it, in
logarithms, and 25 % at least."""
MIN_TESTED, MIN_TESTED_IN_IMAGE = 200, 10
"""Observations of such points: fewer show no range."""


def views_of(scene: Scene) -> Views:
    """The observations of a scene as keypoints of its images; its points are not
    used."""
    num_cameras = len(scene.cameras)
    frame, camera = np.divmod(
        np.arange(scene.num_frames * num_cameras, dtype=np.int64), num_cameras
    )
    poses = rigid3.compose(scene.cam_from_rig[camera], scene.rig_from_world[frame])
    origins, dirs = scene.water_rays()
    return Views(
        cam_from_world=rigid3.matrix_rows(poses),
        camera=camera,
        lenses=np.array([c.lens for c in scene.cameras]),
        ports=np.array([c.port.row for c in scene.cameras]),
        image=scene.frame_idx * num_cameras + scene.camera_idx,
        xy=scene.xy,
        origins=origins,
        dirs=dirs,
    )


def retriangulated(scene: Scene, trusted: NDArray[np.bool_]) -> Scene:
    """The scene with its points intersected from the water rays.

    Args:
        scene: its points are not used.
        trusted: (N,) mask of the observations that shape the points.
    """
    origins, dirs = scene.water_rays()
    dirs = np.where(trusted[:, None], dirs, np.nan)
    points = triangulate_tracks(origins, dirs, scene.point_idx, scene.num_points)
    return replace(scene, points=points)


def agreeing_points(
    scene: Scene, trusted: NDArray[np.bool_], max_error_px: float
) -> Scene:
    """The scene with each point where most of its images see it.

    Args:
        scene: its points are not used.
        trusted: (N,) mask of the observations that may shape the points.
        max_error_px: by which an observation may miss its point, true pixels.

    Returns:
        As of `retriangulated` for tracks whose observations all agree, and for those
        in which `MOST` of them do not.
    """
    scene = retriangulated(scene, trusted)
    error = np.linalg.norm(scene.residuals(), axis=1)
    spoiled = np.zeros(scene.num_points, dtype=bool)
    spoiled[scene.point_idx[trusted & ~(error <= max_error_px)]] = True
    views = views_of(scene)
    rows = np.flatnonzero(trusted & spoiled[scene.point_idx] & finite_rows(views.dirs))
    if not len(rows):
        return scene
    rows = rows[np.lexsort((views.image[rows], scene.point_idx[rows]))]
    tracks, of_track = renumbered(scene.point_idx[rows], scene.num_points)
    start = np.searchsorted(of_track, np.arange(len(tracks) + 1))
    found = triangulate(views, start, rows, max_error_px, np.radians(MIN_ANGLE_DEG))
    first = np.full(len(tracks), len(found.points))  # the best of a track comes first
    seen = found.point_of >= 0
    sizes = np.bincount(found.point_of[seen], minlength=len(found.points))
    np.minimum.at(first, of_track[seen], found.point_of[seen])
    agree = np.append(sizes, 0)[first] >= MOST * np.bincount(of_track)
    points = scene.points.copy()
    points[tracks[agree]] = found.points[first[agree]]
    return replace(scene, points=points)


def good_observations(scene: Scene, max_error_px: float) -> NDArray[np.bool_]:
    """Mask (N,) of observations near their points, whose points have depth."""
    error = np.linalg.norm(scene.residuals(), axis=1)
    near = finite_rows(scene.points)[scene.point_idx] & (error <= max_error_px)
    _, dirs = scene.water_rays()
    near &= finite_rows(dirs)
    angles = np.zeros(scene.num_points)
    angles[:] = max_ray_angles(dirs[near], scene.point_idx[near], scene.num_points)
    near &= angles[scene.point_idx] >= np.radians(MIN_ANGLE_DEG)
    near &= ~_out_of_range(scene, near)[scene.point_idx]
    counts = np.bincount(scene.point_idx[near], minlength=scene.num_points)
    return near & (counts[scene.point_idx] >= 2)


def _out_of_range(scene: Scene, near: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Mask (P,) of points of two images that are nearer or farther than any others.

    Two images agree on a wrong match wherever it falls on its epipolar line. Some per
    cent do, and put a point at half the distance of the sea floor, or at three times:
    from there it pulls at port distances more than hundreds of right ones. What three
    images agree on shows which distances there are.

    Args:
        scene: with points.
        near: (N,) mask of the observations that agree with them.
    """
    counts = np.bincount(scene.point_idx[near], minlength=scene.num_points)
    tested = near & (counts[scene.point_idx] >= 3)
    image = scene.frame_idx * len(scene.cameras) + scene.camera_idx
    distance = np.linalg.norm(scene.points_in_cam(), axis=1)
    typical = _medians(distance[tested], image[tested], int(image.max()) + 1)
    with np.errstate(invalid="ignore", divide="ignore"):
        share = np.log(distance / typical[image])
    known = tested & np.isfinite(share)
    out = np.zeros(scene.num_points, dtype=bool)
    if np.count_nonzero(known) < MIN_TESTED:
        return out
    low, high = WIDER * np.percentile(share[known], (1.0, 99.0))
    low, high = min(low, -np.log(LEAST_RANGE)), max(high, np.log(LEAST_RANGE))
    beyond = near & ((share < low) | (share > high))  # NaN compares false
    out[scene.point_idx[beyond]] = True
    return out & (counts == 2)


def _medians(values: Array, groups: IndexArray, num_groups: int) -> Array:
    """Median (G,) of each group; NaN where there are fewer than `MIN_TESTED_IN_IMAGE`.

    Args:
        values: (n,)
        groups: (n,) from 0 to below ``num_groups``.
    """
    order = np.lexsort((values, groups))
    counts = np.bincount(groups, minlength=num_groups)
    medians = np.full(num_groups, np.nan)
    enough = np.flatnonzero(counts >= MIN_TESTED_IN_IMAGE)
    middle = np.cumsum(counts)[enough] - counts[enough] + counts[enough] // 2
    medians[enough] = values[order[middle]]
    return medians

"""The pose of the next frame, from the points it sees."""

from __future__ import annotations

import numpy as np

from uwsfm.geometry.rigid3 import Array
from uwsfm.scene import IndexArray
from uwsfm.sfm.absolute_pose import AbsolutePoseOptions, estimate_rig_pose
from uwsfm.sfm.mapping.growing_map import GrowingMap

GRID_LEVELS = (2, 4, 8, 16)
"""Cells along each side of an image in which visible points are counted."""
MIN_INLIERS = 20
MIN_INLIER_SHARE = 0.15
MAX_TRIALS = 2000
"""Of a search: enough for one match in six to be right."""


def ranked_frames(
    growing: GrowingMap,
    keypoints: IndexArray,
    points: IndexArray,
    min_inliers: int = MIN_INLIERS,
) -> IndexArray:
    """Frames that see at least ``min_inliers`` points, the best spread ones first.

    As in COLMAP, a frame scores the cells of its images that points occupy, on grids
    that become finer; each level weighs its number of cells.

    Args:
        growing: The map.
        keypoints: (n,) of frames that are not registered.
        points: (n,) that they match.
        min_inliers: What a pose will need.
    """
    of = growing.correspondences
    sizes = np.array([(c.width, c.height) for c in growing.cameras], dtype=np.float64)
    place = of.xy[keypoints] / sizes[of.camera[keypoints]]
    score = np.zeros(of.num_frames)
    for cells in GRID_LEVELS:
        column, row = np.clip((place * cells).astype(np.int64), 0, cells - 1).T
        occupied = np.unique(of.image[keypoints] * cells**2 + row * cells + column)
        frame = occupied // cells**2 // of.num_cameras
        score += cells**2 * np.bincount(frame, minlength=of.num_frames)
    pairs = np.unique(np.column_stack([of.frame[keypoints], points]), axis=0)
    score[np.bincount(pairs[:, 0], minlength=of.num_frames) < min_inliers] = 0.0
    order = np.argsort(-score, kind="stable")
    return order[score[order] > 0.0]


def find_pose(
    growing: GrowingMap,
    keypoints: IndexArray,
    points: IndexArray,
    max_error_px: float,
    seed: int,
    min_inliers: int = MIN_INLIERS,
) -> Array | None:
    """Pose (7,) rig_from_world of a frame, or None if no pose fits enough points.

    Args:
        growing: The map.
        keypoints: (n,) of the frame.
        points: (n,) that they may see.
        max_error_px: Of an inlier, true pixels.
        seed: Of the samples.
        min_inliers: Different points that have to agree.
    """
    of = growing.correspondences
    found = estimate_rig_pose(
        growing.cameras,
        growing.cam_from_rig,
        of.camera[keypoints],
        of.xy[keypoints],
        growing.points[points],
        AbsolutePoseOptions(
            max_error_px=max_error_px, max_trials=MAX_TRIALS, seed=seed
        ),
    )
    if found is None:
        return None
    seen = len(np.unique(points[found.inliers]))
    if seen < max(min_inliers, MIN_INLIER_SHARE * len(np.unique(points))):
        return None
    return found.rig_from_world


def register_next(
    growing: GrowingMap,
    max_error_px: float,
    seed: int,
    min_inliers: int = MIN_INLIERS,
) -> int | None:
    """Add the best frame that fits, and its points: by what pinholes verified, or else
    by any match.

    Args:
        growing: The map.
        max_error_px: Of an inlier, true pixels.
        seed: Of the samples.
        min_inliers: As of `find_pose`.

    Returns:
        The frame; None if no other one fits.
    """
    for verified in (True, False):
        keypoints, points = growing.visible(verified)
        frame_of = growing.correspondences.frame[keypoints]
        for frame in ranked_frames(growing, keypoints, points, min_inliers).tolist():
            rows = frame_of == frame
            seen = keypoints[rows], points[rows]
            pose = find_pose(growing, *seen, max_error_px, seed, min_inliers)
            if pose is not None:
                poses = growing.rig_from_world.copy()
                poses[frame] = pose
                growing.place(np.array([frame]), poses)
                growing.extend(frame, max_error_px)
                return frame
    return None

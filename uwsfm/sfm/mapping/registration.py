"""The pose of the next frame, from the points it sees."""

from __future__ import annotations

import numpy as np

from uwsfm._base.indices import distinct
from uwsfm.geometry.rigid3 import Array
from uwsfm.scene import IndexArray
from uwsfm.sfm.mapping.growing_map import GrowingMap
from uwsfm.sfm.poses.absolute_pose import AbsolutePoseOptions, estimate_rig_pose

GRID_LEVELS = (2, 4, 8, 16)
"""Cells along each side of an image in which visible points are counted."""
MIN_INLIERS = 20
MIN_INLIER_SHARE = 0.15
MAX_TRIALS = 2000
"""Of a search: enough for one match in six to be right."""


class Ranking:
    """Which frame to register next: scores that follow the map as it changes.

    As in COLMAP, a frame scores the cells of its images that points occupy, on grids
    that become finer; each level weighs its number of cells. A score is computed again
    when the map has changed near its frame, and not before.

    Args:
        growing: The map.
        min_inliers: Points that a frame has to see: what a pose will need.
    """

    def __init__(self, growing: GrowingMap, min_inliers: int = MIN_INLIERS) -> None:
        self.map = growing
        self.min_inliers = min_inliers
        num_frames = growing.correspondences.num_frames
        self._scores = {verified: np.zeros(num_frames) for verified in (True, False)}
        self._changes = {
            verified: np.full(num_frames, -1) for verified in (True, False)
        }

    def frames(self, verified: bool) -> IndexArray:
        """Frames that see enough points, the best spread ones first.

        Args:
            verified: By verified matches only, or by any.
        """
        growing, scores = self.map, self._scores[verified]
        stale = growing.changes != self._changes[verified]
        self._changes[verified] = growing.changes.copy()
        scores[growing.registered] = 0.0
        frames = np.flatnonzero(stale & ~growing.registered)
        scores[frames] = self._score(*growing.visible(frames, verified))[frames]
        order = np.argsort(-scores, kind="stable")
        return order[scores[order] > 0.0]

    def _score(self, keypoints: IndexArray, points: IndexArray) -> Array:
        """Of all frames (F,), zero where too few of the keypoints (n,) are."""
        growing = self.map
        of = growing.correspondences
        sizes = np.array([(c.width, c.height) for c in growing.cameras])
        place = of.xy[keypoints] / sizes[of.camera[keypoints]]
        score = np.zeros(of.num_frames)
        for cells in GRID_LEVELS:
            column, row = np.clip((place * cells).astype(np.int64), 0, cells - 1).T
            occupied = np.zeros((len(of.first) - 1, cells, cells), dtype=bool)
            occupied[of.image[keypoints], row, column] = True
            counts = np.count_nonzero(occupied.reshape(of.num_frames, -1), axis=1)
            score += cells**2 * counts
        pairs = distinct(of.frame[keypoints] * len(growing.points) + points)
        counts = np.bincount(
            pairs // max(len(growing.points), 1), minlength=of.num_frames
        )
        score[counts < self.min_inliers] = 0.0
        return score


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
    growing: GrowingMap, ranking: Ranking, max_error_px: float, seed: int
) -> int | None:
    """Add the best frame that fits, and its points: by what pinholes verified, or else
    by any match.

    Args:
        growing: The map.
        ranking: Of its frames.
        max_error_px: Of an inlier, true pixels.
        seed: Of the samples.

    Returns:
        The frame; None if no other one fits.
    """
    for verified in (True, False):
        for frame in ranking.frames(verified).tolist():
            seen = growing.visible(np.array([frame]), verified)
            pose = find_pose(growing, *seen, max_error_px, seed, ranking.min_inliers)
            if pose is not None:
                growing.rig_from_world[frame] = pose
                growing.place(np.array([frame]), growing.rig_from_world)
                growing.extend(frame, max_error_px)
                return frame
    return None

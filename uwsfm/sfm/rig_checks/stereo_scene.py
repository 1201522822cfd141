"""Scenes of single stereo pairs: they show the ports' normals without any motion.

Sedlazeck & Koch (BMVC 2011, sec. 3.2.1): where the rig is known, the points that its
cameras share in one frame determine the normals of the ports, but no distance.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations
from pathlib import Path

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from uwsfm.errors import InputError
from uwsfm.geometry import rigid3
from uwsfm.geometry.rays import triangulate_tracks
from uwsfm.geometry.rigid3 import Array
from uwsfm.rig.rig import Rig
from uwsfm.scene import IndexArray, Scene
from uwsfm.sfm.frontend.images import Frames
from uwsfm.sfm.poses.epipolar import ray_gaps_px, relative_pose
from uwsfm.sfm.rig_checks.rig_check import check_rig, check_rotation
from uwsfm.sfm.rig_checks.rig_rotation import MIN_RIG_MATCHES, correct_rotations
from uwsfm.sfm.rig_checks.stereo_matches import (
    PairMatches,
    read_same_frame_matches,
    read_successive_matches,
)

START_GAPS = 8.0
"""Times the median gap, while the ports are guesses. With straight ports for ports
tilted by 1 to 8 degrees, the largest gap of a right match is 5 to 7 times the median,
once the cameras have been turned to make up for most of it."""
MAX_GAPS = 5.0
"""Times the median gap, once the ports are estimated: of right matches, with normal
errors, one in 1300 is beyond."""
MIN_GAP_PX = 1.0
"""Features are not so good that a smaller gap would tell a wrong match."""


def same_frame_scene(rig: Rig, frames: Frames, database_path: Path) -> Scene:
    """The points that cameras share in single frames, for `uwsfm.calibrate`.

    With ``refine_distances=False, refine_cam_from_rig=False`` they determine the
    normals. No point is seen in two frames, so that a frame could move with its points
    and no image would change: all observations are put into one frame, which is held.

    Matches have to agree with one epipolar geometry per frame, and then with that of
    the rig: water rays that miss each other by more than `START_GAPS` times the median
    are no match. For this test alone the cameras are turned as in the perspective
    start, because a turn is most of what a tilted port does to its rays; without it,
    ports tilted by 8 degrees would need a tolerance of 45 px instead of 10.

    Args:
        rig: Lenses, initial ports, and poses.
        frames: Which frames, one or more; only their names are used.
        database_path: Keypoints and raw matches of these frames.

    Returns:
        One frame, its pose the identity; the rig as given; points intersected from the
        water rays of its ports.

    Raises:
        InputError: the poses of the rig are not known or contradict the matches, or
            there are too few matches.
    """
    if rig.cam_from_rig is None:
        raise InputError(
            "cam_from_rig: single stereo pairs cannot tell it from the ports; give it "
            "in the rig file, a baseline length is not enough"
        )
    pairs = read_same_frame_matches(database_path, frames, rig)

    def shifted(shift: int) -> list[PairMatches]:
        return read_same_frame_matches(database_path, frames, rig, shift)

    def successive() -> list[PairMatches]:
        return read_successive_matches(database_path, frames, rig)

    check_rig(rig, rig.cam_from_rig, pairs, shifted, successive)
    cameras = rig.refractive_cameras()
    rotation = correct_rotations(cameras, rig.cam_from_rig, pairs)
    check_rotation(rig, rig.cam_from_rig, rotation, pairs, shifted)
    good = []
    for pair in pairs:
        if len(pair) < MIN_RIG_MATCHES:
            continue
        a, b = pair.camera_a, pair.camera_b
        b_from_a = relative_pose(rotation.cam_from_rig, a, b)
        gaps = ray_gaps_px(cameras[a], cameras[b], b_from_a, pair.xy_a, pair.xy_b)
        good.append(pair.selected(gaps <= _limit(gaps, START_GAPS)))
    camera_idx, point_idx, xy = _tracks(good)
    return _triangulated(
        Scene.from_arrays(
            cameras=cameras,
            cam_from_rig=rig.cam_from_rig,
            rig_from_world=rigid3.IDENTITY[None],
            points=np.full((point_idx.max(initial=-1) + 1, 3), np.nan),
            camera_idx=camera_idx,
            frame_idx=np.zeros_like(camera_idx),
            point_idx=point_idx,
            xy=xy,
        )
    )


def without_wrong_matches(scene: Scene, max_gaps: float = MAX_GAPS) -> Scene:
    """Keep what the cameras of each frame agree on, now that the ports are known.

    Args:
        scene: With estimated ports; its points are not used.
        max_gaps: Times the median gap.

    Returns:
        The observations whose water rays nearly meet that of another camera in the same
        frame, with their points intersected anew.
    """
    gaps = same_frame_gaps_px(scene)
    smaller, _ = scene.select(gaps <= _limit(gaps, max_gaps))
    return _triangulated(smaller)


def same_frame_gaps_px(scene: Scene) -> Array:
    """By how much each observation misses that of another camera of its frame (N,).

    The smallest of its `ray_gaps_px`, NaN where no other camera saw the point.
    """
    gaps = np.full(scene.num_observations, np.nan)
    keys = scene.frame_idx * scene.num_points + scene.point_idx
    rows = [np.flatnonzero(scene.camera_idx == c) for c in range(len(scene.cameras))]
    for a, b in combinations(range(len(scene.cameras)), 2):
        _, in_a, in_b = np.intersect1d(
            keys[rows[a]], keys[rows[b]], return_indices=True
        )
        row_a, row_b = rows[a][in_a], rows[b][in_b]
        found = ray_gaps_px(
            scene.cameras[a],
            scene.cameras[b],
            relative_pose(scene.cam_from_rig, a, b),
            scene.xy[row_a],
            scene.xy[row_b],
        )
        gaps[row_a] = np.fmin(gaps[row_a], found)
        gaps[row_b] = np.fmin(gaps[row_b], found)
    return gaps


def _limit(gaps_px: Array, max_gaps: float) -> float:
    """The largest gap (px) that a right match may have, from the matches themselves."""
    known = gaps_px[np.isfinite(gaps_px)]
    median = float(np.median(known)) if len(known) else 0.0
    return max(max_gaps * median, MIN_GAP_PX)


def _tracks(pairs: Sequence[PairMatches]) -> tuple[IndexArray, IndexArray, Array]:
    """Camera and point (N,) and pixel (N, 2) of observations, from their matches.

    A feature that several cameras matched is one observation of one point. Points that
    one camera saw twice are left out.
    """
    first = [_ends(pair.camera_a, pair.frame_idx, pair.xy_a) for pair in pairs]
    second = [_ends(pair.camera_b, pair.frame_idx, pair.xy_b) for pair in pairs]
    features, node = np.unique(
        np.concatenate(first + second), axis=0, return_inverse=True
    )
    ends = node.reshape(2, -1)  # each match joins two features
    graph = coo_array(
        (np.ones(ends.shape[1]), (ends[0], ends[1])), shape=2 * (len(features),)
    )
    _, point_idx = connected_components(graph, directed=False)
    camera_idx = features[:, 0].astype(np.int64)
    views, times = np.unique(
        np.column_stack([point_idx, camera_idx]), axis=0, return_counts=True
    )
    keep = ~np.isin(point_idx, views[times > 1, 0])
    _, point_idx = np.unique(point_idx[keep], return_inverse=True)
    return camera_idx[keep], point_idx.astype(np.int64), features[keep, 2:]


def _ends(camera: int, frame_idx: IndexArray, xy: Array) -> Array:
    """Rows (N, 4) that name a feature: camera, frame, pixel."""
    return np.column_stack([np.full(len(xy), camera), frame_idx, xy])


def _triangulated(scene: Scene) -> Scene:
    """The scene with points from the water rays, without those that have none."""
    origins, dirs = scene.water_rays()
    points = triangulate_tracks(origins, dirs, scene.point_idx, scene.num_points)
    scene = replace(scene, points=points)
    _, valid = scene.projections()
    counts = np.bincount(scene.point_idx[valid], minlength=scene.num_points)
    smaller, _ = scene.select(valid & (counts[scene.point_idx] >= 2))
    return smaller

"""Where a map begins: one frame of a rig, or two frames and their relative pose."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from uwsfm.geometry import rigid3
from uwsfm.geometry.rigid3 import Array
from uwsfm.scene import IndexArray
from uwsfm.sfm.epipolar import ray_pairs
from uwsfm.sfm.mapping.growing_map import GrowingMap, Mask
from uwsfm.sfm.relative_pose import estimate_rig_relative_pose
from uwsfm.sfm.relative_pose_options import RelativePoseOptions

MIN_POINTS = 30
"""That the cameras of a first frame see together, or two first frames."""
START_GAPS = 5.0
"""Times the median gap of the matches of single frames: the tolerance at the start."""
MIN_ERROR_PX = 4.0
MAX_ERROR_PX = 30.0
ALONE_ERROR_PX = 8.0
"""The tolerance at the start for one camera: no rig tells how wrong its port is."""
PAIR_ANGLES_DEG = (8.0, 4.0, 2.0)
"""Median angles between the rays of a first pair: the first one that a pair reaches."""
MAX_PAIRS = 40
"""With the most matches, that are looked at."""


@dataclass(frozen=True, kw_only=True)
class Beginning:
    """Frames to begin with."""

    frames: IndexArray
    """(n,)"""
    rig_from_world: Array
    """(n, 7)"""


def start_tolerance_px(empty: GrowingMap) -> float:
    """How far right matches may be off while the ports are guesses, true pixels."""
    of = empty.correspondences
    same_frame = _same_frame(empty)
    same_frame = same_frame[of.verified[same_frame]]
    if len(same_frame) == 0:
        return ALONE_ERROR_PX
    typical = START_GAPS * float(np.median(_rig_gaps_px(empty, same_frame)))
    return min(max(typical, MIN_ERROR_PX), MAX_ERROR_PX)


def beginnings(
    empty: GrowingMap,
    left: Mask,
    max_error_px: float,
    scene_distance_m: float,
    seed: int,
) -> Iterator[Beginning]:
    """Ways to begin, the best first.

    Frames by the number of points that their own cameras and other frames see; if none
    is left, pairs by their number of matches.

    Args:
        empty: A map without frames.
        left: (F,) frames that no map has yet; read before each beginning.
        max_error_px: Tolerance.
        scene_distance_m: How far away the scene is, about, where nothing tells.
        seed: Of the random samples.
    """
    for frame in _ranked_frames(empty, max_error_px):
        if left[frame]:
            yield Beginning(
                frames=np.array([frame]), rig_from_world=rigid3.IDENTITY[None]
            )
    motions: dict[tuple[int, int], tuple[Array, float] | None] = {}
    pairs = _ranked_pairs(empty)[:MAX_PAIRS]
    for min_angle in np.radians(PAIR_ANGLES_DEG):
        for a, b in pairs:
            if not (left[a] and left[b]):
                continue
            if (a, b) not in motions:
                motions[a, b] = _motion(
                    empty, a, b, max_error_px, scene_distance_m, seed
                )
            motion = motions[a, b]
            if motion is not None and motion[1] >= min_angle:
                yield Beginning(
                    frames=np.array([a, b]),
                    rig_from_world=np.stack([rigid3.IDENTITY, motion[0]]),
                )


def _same_frame(empty: GrowingMap) -> IndexArray:
    """Matches between the cameras of one frame."""
    of = empty.correspondences
    frames = of.frame[of.matches]
    return np.flatnonzero(frames[:, 0] == frames[:, 1])


def _rig_gaps_px(empty: GrowingMap, same_frame: IndexArray) -> Array:
    """Gaps of matches of single frames: whatever the poses are."""
    elsewhere = empty.emptied()
    everywhere = np.arange(empty.correspondences.num_frames)
    elsewhere.place(everywhere, elsewhere.rig_from_world)
    return elsewhere.gaps_px(same_frame)


def _ranked_frames(empty: GrowingMap, max_error_px: float) -> list[int]:
    of = empty.correspondences
    frames = of.frame[of.matches]
    same_frame = _same_frame(empty)
    linked = np.zeros(len(of.xy), dtype=bool)
    linked[of.matches[of.verified & (frames[:, 0] != frames[:, 1])]] = True
    useful = linked[of.matches[same_frame]].any(axis=1)
    useful &= _rig_gaps_px(empty, same_frame) <= max_error_px
    counts = np.bincount(frames[same_frame[useful], 0], minlength=of.num_frames)
    order = np.argsort(-counts, kind="stable")
    return order[counts[order] >= MIN_POINTS].tolist()


def _ranked_pairs(empty: GrowingMap) -> list[tuple[int, int]]:
    of = empty.correspondences
    frames = of.frame[of.matches[of.verified]]
    keys = frames[:, 0] * np.int64(of.num_frames) + frames[:, 1]
    pairs, counts = np.unique(keys[frames[:, 0] != frames[:, 1]], return_counts=True)
    order = np.argsort(-counts, kind="stable")
    order = order[counts[order] >= MIN_POINTS]
    return [divmod(int(pair), of.num_frames) for pair in pairs[order]]


def _motion(
    empty: GrowingMap,
    a: int,
    b: int,
    max_error_px: float,
    scene_distance_m: float,
    seed: int,
) -> tuple[Array, float] | None:
    """Pose b_from_a (7,) of two frames, and the median angle of their rays."""
    of = empty.correspondences
    ends = of.matches[of.verified]
    ends = ends[(of.frame[ends] == [a, b]).all(axis=1)]
    found = estimate_rig_relative_pose(
        empty.cameras,
        empty.cam_from_rig,
        of.camera[ends[:, 0]],
        of.xy[ends[:, 0]],
        of.camera[ends[:, 1]],
        of.xy[ends[:, 1]],
        RelativePoseOptions(
            max_error_px=max_error_px,
            min_num_inliers=MIN_POINTS,
            scene_distance_m=scene_distance_m,
            seed=seed,
        ),
    )
    if found is None:
        return None
    motion = found.b_from_a.copy()
    if len(empty.cameras) == 1 and not found.length_determined:
        motion[4:] *= scene_distance_m / _scene_distance(empty, motion, ends)
    return motion, found.median_angle


def _scene_distance(empty: GrowingMap, b_from_a: Array, ends: IndexArray) -> float:
    """Median distance of the points of two frames from the first one."""
    of, camera = empty.correspondences, empty.cameras[0]
    points, in_front = ray_pairs(
        camera, camera, b_from_a, of.xy[ends[:, 0]], of.xy[ends[:, 1]]
    ).triangulate()
    return float(np.median(np.linalg.norm(points[in_front], axis=1)))

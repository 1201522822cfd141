"""Where a map begins: one frame of a rig, or two frames and their relative pose."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from uwsfm.geometry import rigid3
from uwsfm.geometry.rigid3 import Array
from uwsfm.scene import IndexArray
from uwsfm.sfm.mapping.growing_map import GrowingMap, Mask
from uwsfm.sfm.poses.epipolar import ray_pairs
from uwsfm.sfm.poses.relative_pose import estimate_rig_relative_poses
from uwsfm.sfm.poses.relative_pose_options import RelativePoseOptions

MIN_POINTS = 30
"""That the cameras of a first frame see together, or two first frames."""
START_GAPS = 5.0
"""Times the median gap of the matches of single frames: the tolerance at the start."""
MIN_ERROR_PX = 4.0
MAX_ERROR_PX = 30.0
ALONE_ERROR_PX = 8.0
"""The tolerance at the start for one camera: no rig tells how wrong its port is."""
MIN_PAIR_ANGLE_DEG = 1.0
"""Median, between the rays of a first pair: of some, points have a depth then."""
WIDE_ANGLE_DEG = 8.0
"""Beyond it a larger angle tells no more of the depth, and matches are rare."""
PAIRS_OF_A_SEARCH = 20
MAX_SEARCHES = 3
MAX_START_MATCHES = 400
"""Of a pair, which a motion is sought for."""


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


def frame_beginnings(
    empty: GrowingMap, left: Mask, max_error_px: float
) -> Iterator[Beginning]:
    """Single frames of a rig, by the number of points that their own cameras and other
    frames see.

    Args:
        empty: A map without frames.
        left: (F,) frames that no map has yet; read before each beginning.
        max_error_px: Tolerance.
    """
    for frame in _ranked_frames(empty, max_error_px):
        if left[frame]:
            yield Beginning(
                frames=np.array([frame]), rig_from_world=rigid3.IDENTITY[None]
            )


class PairSearch:
    """Pairs of frames to begin with.

    The pairs with the most matches have hardly moved, those that moved most have hardly
    any matches: pairs of all sorts are tried, and ranked by what they would tell of the
    depth of their points.

    Args:
        empty: A map without frames.
        left: (F,) frames that no map has yet; read at each search.
        max_error_px: Tolerance.
        scene_distance_m: How far away the scene is, about, where nothing tells.
        seed: Of the random samples.
    """

    def __init__(
        self,
        empty: GrowingMap,
        left: Mask,
        max_error_px: float,
        scene_distance_m: float,
        seed: int,
    ) -> None:
        self.empty = empty
        self.left = left
        self.max_error_px = max_error_px
        self.scene_distance_m = scene_distance_m
        self.seed = seed
        self.num_matched = 0
        """Pairs that had enough matches."""
        self.widest_angle = 0.0
        """The largest median angle between the rays of one of them, radians."""

    def beginnings(self) -> Iterator[Beginning]:
        """Pairs, and both motions of a nearly flat one; the best of each search first,
        then those of pairs that were not tried yet."""
        ranked = _ranked_pairs(self.empty)
        self.num_matched = len(ranked)
        for _ in range(MAX_SEARCHES):
            ranked = [pair for pair in ranked if self.left[list(pair[:2])].all()]
            some = _spread(ranked)
            ranked = [pair for pair in ranked if pair not in some]
            found = [(s, w) for a, b, _ in some for s, w in self._motions(a, b)]
            for _, beginning in sorted(found, key=lambda way: -way[0]):
                if self.left[beginning.frames].all():
                    yield beginning

    def _motions(self, a: int, b: int) -> list[tuple[float, Beginning]]:
        """Ways to begin with two frames, and how much each promises."""
        empty, of = self.empty, self.empty.correspondences
        matches = np.intersect1d(of.matches_of(a), of.matches_of(b))
        ends = of.matches[matches[of.verified[matches]]]
        ends = ends[(of.frame[ends] == [a, b]).all(axis=1)]
        num_matches = len(ends)
        if num_matches > MAX_START_MATCHES:
            random = np.random.default_rng([self.seed, a, b])
            ends = random.choice(ends, MAX_START_MATCHES, replace=False)
        motions = estimate_rig_relative_poses(
            empty.cameras,
            empty.cam_from_rig,
            of.camera[ends[:, 0]],
            of.xy[ends[:, 0]],
            of.camera[ends[:, 1]],
            of.xy[ends[:, 1]],
            RelativePoseOptions(
                max_error_px=self.max_error_px,
                min_num_inliers=MIN_POINTS,
                scene_distance_m=self.scene_distance_m,
                seed=self.seed,
            ),
        )
        ways = []
        for motion in motions:
            angle, pose = motion.median_angle, motion.b_from_a.copy()
            self.widest_angle = max(self.widest_angle, angle)
            if angle < np.radians(MIN_PAIR_ANGLE_DEG):
                continue
            if len(empty.cameras) == 1 and not motion.length_determined:
                distance = _scene_distance(empty, pose, ends)
                pose[4:] *= self.scene_distance_m / distance
            share = motion.num_inliers / len(ends)
            told = min(angle, np.radians(WIDE_ANGLE_DEG)) ** 2
            poses = np.stack([rigid3.IDENTITY, pose])
            way = Beginning(frames=np.array([a, b]), rig_from_world=poses)
            ways.append((share * num_matches * told, way))
        return ways


def _spread(ranked: list[tuple[int, int, int]]) -> list[tuple[int, int, int]]:
    """Some pairs, from the most matches to the fewest, in equal steps of a factor."""
    if len(ranked) <= PAIRS_OF_A_SEARCH:
        return ranked
    counts = np.log([count for _, _, count in ranked])
    wanted = np.linspace(counts[0], counts[-1], PAIRS_OF_A_SEARCH)
    rows = np.unique([int(np.argmin(np.abs(counts - value))) for value in wanted])
    return [ranked[row] for row in rows]


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


def _ranked_pairs(empty: GrowingMap) -> list[tuple[int, int, int]]:
    """Two frames and the number of their verified matches, the most first.

    Of a rig, both have images of two cameras: one alone gives the motion no length.
    """
    of = empty.correspondences
    frames = of.frame[of.matches[of.verified]]
    keys = frames[:, 0] * np.int64(of.num_frames) + frames[:, 1]
    images = (np.diff(of.first) > 0).reshape(of.num_frames, of.num_cameras)
    whole = images.sum(axis=1) >= min(2, of.num_cameras)
    useful = (frames[:, 0] != frames[:, 1]) & whole[frames].all(axis=1)
    pairs, counts = np.unique(keys[useful], return_counts=True)
    order = np.argsort(-counts, kind="stable")
    order = order[counts[order] >= MIN_POINTS]
    return [(*divmod(int(pairs[k]), of.num_frames), int(counts[k])) for k in order]


def _scene_distance(empty: GrowingMap, b_from_a: Array, ends: IndexArray) -> float:
    """Median distance of the points of two frames from the first one."""
    of, camera = empty.correspondences, empty.cameras[0]
    points, in_front = ray_pairs(
        camera, camera, b_from_a, of.xy[ends[:, 0]], of.xy[ends[:, 1]]
    ).triangulate()
    return float(np.median(np.linalg.norm(points[in_front], axis=1)))

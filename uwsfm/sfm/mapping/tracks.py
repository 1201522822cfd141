"""Points of tracks, and gaps of matches, on all cores."""

import math
from typing import NamedTuple

import numpy as np

from uwsfm.geometry.rigid3 import Array
from uwsfm.scene import IndexArray
from uwsfm.sfm.mapping.triangulation import (
    Views,
    match_gaps_batch,
    triangulate_batch,
)
from uwsfm.solver.threads import chunk_bounds, num_threads, run_chunks

MIN_CHUNK = 10_000
"""Keypoints or matches: some ten milliseconds."""


class Found(NamedTuple):
    """Points of tracks."""

    points: Array
    """(P, 3) in the world."""
    point_of: IndexArray
    """For each keypoint of the tracks, its point; -1: none."""


def triangulate(
    views: Views,
    track_start: IndexArray,
    keypoints: IndexArray,
    max_error_px: float,
    min_angle: float,
    min_images: int = 2,
) -> Found:
    """Find the points of tracks.

    Args:
        views: Poses and rays.
        track_start: (T + 1,) where each track begins in ``keypoints``.
        keypoints: (K,) track after track, rising within a track, which puts those of
            one image beside each other.
        max_error_px: Tolerance, true pixels.
        min_angle: Between the two rays of a point that diverge most, radians.
        min_images: That see a point. Two always agree on their epipolar line; a third
            tells wrong matches.

    Returns:
        Points in the order of the tracks.
    """
    point_of = np.full(len(keypoints), -1, dtype=np.int64)
    bounds = chunk_bounds(track_start, _num_chunks(len(keypoints)))
    found = [np.empty((0, 3))] * (len(bounds) - 1)

    def find(chunk: int) -> None:
        first, last = bounds[chunk : chunk + 2]
        start = track_start[first : last + 1]
        mine = slice(start[0], start[-1])
        points = np.empty(((start[-1] - start[0]) // 2 + 1, 3))
        count = triangulate_batch(
            views,
            start - start[0],
            keypoints[mine],
            max_error_px * max_error_px,
            math.cos(min_angle),
            min_images,
            points,
            point_of[mine],
        )
        found[chunk] = points[:count].copy()

    run_chunks(find, len(found))
    # Each chunk has numbered its own points: they follow each other.
    before = np.concatenate([[0], np.cumsum([len(points) for points in found])])
    for chunk, offset in enumerate(before[:-1].tolist()):
        mine = point_of[track_start[bounds[chunk]] : track_start[bounds[chunk + 1]]]
        mine[mine >= 0] += offset
    return Found(points=np.concatenate(found), point_of=point_of)


def match_gaps_px(views: Views, ends: IndexArray) -> Array:
    """How many pixels the keypoints of matches miss a common point by.

    As `epipolar.ray_gaps_px`, for many images at once. Rays whose angle is a matter of
    noise may as well meet behind the cameras: they miss by no more than that angle.

    Args:
        views: Poses and rays.
        ends: (n, 2) keypoints of each match.

    Returns:
        (n,); inf where a pixel has no ray or the rays clearly meet behind a port.
    """
    gaps = np.empty(len(ends))
    bounds = np.linspace(0, len(ends), _num_chunks(len(ends)) + 1).astype(np.int64)

    def measure(chunk: int) -> None:
        mine = slice(*bounds[chunk : chunk + 2])
        match_gaps_batch(views, ends[mine], gaps[mine])

    run_chunks(measure, len(bounds) - 1)
    return gaps


def _num_chunks(size: int) -> int:
    """Worth a thread each; the result does not depend on it."""
    return max(1, min(num_threads(), size // MIN_CHUNK))

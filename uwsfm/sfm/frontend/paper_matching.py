"""Matching as Sedlazeck & Koch (BMVC 2011, sec. 3): SIFT, ANN, RANSAC.

Approximate nearest neighbours of SIFT descriptors in kd-trees, then a fundamental
matrix by RANSAC on the raw pixels. Refraction has no fundamental matrix, so that the
threshold has to be tolerant.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np
import pycolmap
from numpy.typing import NDArray

from uwsfm._base.progress import Progress, silent
from uwsfm.geometry.rigid3 import Array
from uwsfm.sfm.frontend.background import opened

Matches = NDArray[np.uint32]

FLANN_KDTREE = 1  # OpenCV's cvflann::FLANN_INDEX_KDTREE, which has no Python name
NUM_TREES = 4
NUM_CHECKS = 64
"""Leaves looked at. On rendered images this finds 98 % of what 256 find, at 30 % of
the time."""
MAX_RATIO = 0.8
"""Of the distances to the nearest and the second nearest neighbour (Lowe 2004)."""
TOLERANCE = 0.01
"""Of the fundamental matrix, as a share of the image's longer side: what lenses and
ports add to it grows with the focal length. On rendered and simulated dives, with ports
tilted by up to 8 degrees and up to 6 cm away, it keeps 99.97 % of the right matches or
more. Half of it loses up to 8 % of a pair's, several times as many near the image's
borders as in its centre, and the borders show the ports best."""
MIN_MATCHES = 15
"""Fewer tell nothing about a pair of images."""
MAX_TRIALS = 5000  # finds a model among 60 % wrong matches
CACHE_SIZE = 128  # images whose trees are kept, about 5 MB each
PAIRS_PER_THREAD = 4  # between two writes: Ctrl-C waits for no more


@dataclass(frozen=True, kw_only=True)
class _Features:
    """What is known of one image."""

    xy: Array
    """(N, 2)"""
    descriptors: NDArray[np.float32]
    """(N, 128)"""
    trees: cv2.flann.Index | None
    """None: too few features to match."""
    size_px: int
    """Longer side of the image."""


def match_pairs(
    pairs: Sequence[tuple[str, str]],
    database_path: Path,
    *,
    max_error_px: float | None,
    seed: int = 0,
    num_threads: int = 1,
    progress: Progress = silent,
) -> None:
    """Match pairs of images; those in the database already are skipped.

    The result depends on the seed, but not on threads, interruptions or the
    identifiers of images.

    Args:
        pairs: Names of the images.
        database_path: With features; receives the matches.
        max_error_px: Of the fundamental matrix; None: `TOLERANCE`.
        seed: Of the trees and of RANSAC.
        num_threads: How many pairs are matched at a time.
        progress: Called with the step "matching".
    """
    with opened(database_path) as database, ThreadPoolExecutor(num_threads) as pool:
        ids = {image.name: image.image_id for image in database.read_all_images()}
        todo = [
            pair
            for pair in pairs
            if not database.exists_matches(ids[pair[0]], ids[pair[1]])
        ]

        @lru_cache(maxsize=CACHE_SIZE)
        def features(name: str) -> _Features:
            return _read(database, ids[name], seed)

        def matched(images: tuple[_Features, _Features]) -> Matches:
            return _verified(*images, _nearest(*images), max_error_px, seed)

        size = PAIRS_PER_THREAD * num_threads
        done = len(pairs) - len(todo)
        for begin in range(0, len(todo), size):
            progress("matching", done + begin, len(pairs))
            block = todo[begin : begin + size]
            images = [(features(a), features(b)) for a, b in block]
            for (a, b), matches in zip(block, pool.map(matched, images), strict=True):
                # Without matches too: the pair is done.
                database.write_matches(ids[a], ids[b], matches)


def _read(database: pycolmap.Database, image_id: int, seed: int) -> _Features:
    descriptors = np.ascontiguousarray(
        database.read_descriptors(image_id).data, dtype=np.float32
    )
    trees = None
    if len(descriptors) >= MIN_MATCHES:  # an empty index would crash the process
        # Once per image: its trees must not depend on those built before.
        cv2.setRNGSeed(seed)
        trees = cv2.flann.Index(
            descriptors, {"algorithm": FLANN_KDTREE, "trees": NUM_TREES}
        )
    camera = database.read_camera(database.read_image(image_id).camera_id)
    return _Features(
        xy=database.read_keypoints(image_id)[:, :2].astype(np.float64),
        descriptors=descriptors,
        trees=trees,
        size_px=max(camera.width, camera.height),
    )


def _nearest(a: _Features, b: _Features) -> Matches:
    """Features (n, 2) that are each other's nearest neighbours, and clearly so.

    Mutual, because a feature that matches two of another image would put both into one
    point; with the ratio test in both directions, neither image is preferred.
    """
    if a.trees is None or b.trees is None:
        return np.empty((0, 2), dtype=np.uint32)
    from_a, clear_a = _search(b.trees, a.descriptors)
    from_b, clear_b = _search(a.trees, b.descriptors)
    rows = np.arange(len(from_a))
    mutual = clear_a & (from_b[from_a] == rows) & clear_b[from_a]
    return np.column_stack([rows, from_a])[mutual].astype(np.uint32)


def _search(
    trees: cv2.flann.Index, descriptors: NDArray[np.float32]
) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """The nearest neighbour of each descriptor, and whether the second is far off."""
    neighbours, squares = trees.knnSearch(descriptors, 2, params={"checks": NUM_CHECKS})
    nearest = neighbours[:, 0].astype(np.int64)
    return nearest, squares[:, 0] < MAX_RATIO**2 * squares[:, 1]


def _verified(
    a: _Features,
    b: _Features,
    matches: Matches,
    max_error_px: float | None,
    seed: int,
) -> Matches:
    """The matches (n, 2) that one fundamental matrix explains; all or none."""
    none = np.empty((0, 2), dtype=np.uint32)
    if len(matches) < MIN_MATCHES:
        return none
    options = pycolmap.RANSACOptions()
    options.max_error = max_error_px or TOLERANCE * max(a.size_px, b.size_px)
    options.min_num_trials = 100
    options.max_num_trials = MAX_TRIALS
    options.random_seed = seed
    estimate = pycolmap.estimate_fundamental_matrix(
        a.xy[matches[:, 0]], b.xy[matches[:, 1]], options
    )
    if estimate is None or estimate["num_inliers"] < MIN_MATCHES:
        return none
    return np.ascontiguousarray(matches[estimate["inlier_mask"]])

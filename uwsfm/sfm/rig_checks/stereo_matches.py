"""Matches between the cameras of one frame: what ties a rig to its images."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path

import numpy as np
import pycolmap
from numpy.typing import NDArray

from uwsfm.geometry.rays import finite_rows
from uwsfm.geometry.rigid3 import Array
from uwsfm.models.refractive import RefractiveCamera
from uwsfm.rig.rig import Rig
from uwsfm.scene import IndexArray
from uwsfm.sfm.frontend.background import opened
from uwsfm.sfm.frontend.images import Frames

MAX_FRAMES = 100
"""Frames looked at, evenly spread: the rig is the same in all of them."""
MAX_EPIPOLAR_ANGLE = 8e-3
"""Radians. Tolerant: rays of a flat port do not meet in one point, and a wrong port
bends the epipolar lines by several pixels; yet few outliers come so near."""
MIN_MATCHES = 15
SEED = 0


@dataclass(frozen=True, kw_only=True)
class PairMatches:
    """Pixels of points that two cameras of the rig saw in the same frame."""

    camera_a: int
    camera_b: int
    frame_idx: IndexArray
    """(N,)"""
    xy_a: Array
    """(N, 2)"""
    xy_b: Array
    """(N, 2)"""

    def __len__(self) -> int:
        return len(self.frame_idx)

    def thinned(self, count: int) -> PairMatches:
        """At most ``count`` of the matches, evenly taken."""
        return self.selected(slice(None, None, max(-(-len(self) // count), 1)))

    def selected(self, rows: slice | NDArray[np.bool_]) -> PairMatches:
        """Some of the matches: a slice, or a mask (N,)."""
        return replace(
            self,
            frame_idx=self.frame_idx[rows],
            xy_a=self.xy_a[rows],
            xy_b=self.xy_b[rows],
        )


def read_same_frame_matches(
    database_path: Path, frames: Frames, rig: Rig, shift: int = 0
) -> list[PairMatches]:
    """Matches of the same frame that agree with one epipolar geometry per frame.

    Neither the rig's poses nor the distance of a port is used. The essential matrix is
    robustly fitted to the directions of the water rays, in which the lens distortion
    and nearly all of the refraction are undone. Pixels beyond a camera's
    ``valid_radius_px`` take no part: their rays would be wrong.

    Args:
        database_path: Keypoints and raw matches.
        frames: The images.
        rig: Lenses and ports.
        shift: Frame f of the first camera is matched with frame f + shift of the
            second: what fits where the second is so many frames late.

    Returns:
        One entry per pair of cameras, those without a match included.
    """
    num_frames = len(frames.names)
    chosen = np.unique(
        np.linspace(0, num_frames - 1, min(num_frames, MAX_FRAMES)).astype(np.int64)
    )
    found: list[PairMatches] = []
    with opened(database_path) as database:
        ids = {image.name: image.image_id for image in database.read_all_images()}
        for a, b in combinations(range(len(rig.cameras)), 2):
            inside = (chosen >= -shift) & (chosen < num_frames - shift)
            steps = [(f, f + shift) for f in chosen[inside].tolist()]
            found.append(_agreeing(database, ids, frames, rig, (a, b), steps))
    return found


def read_successive_matches(
    database_path: Path, frames: Frames, rig: Rig
) -> list[PairMatches]:
    """Matches of each camera's images with its next ones, as `read_same_frame_matches`.

    Returns:
        One entry per camera, both of whose sides are that camera.
    """
    steps = [(f, f + 1) for f in range(min(len(frames.names) - 1, MAX_FRAMES))]
    with opened(database_path) as database:
        ids = {image.name: image.image_id for image in database.read_all_images()}
        return [
            _agreeing(database, ids, frames, rig, (c, c), steps)
            for c in range(len(rig.cameras))
        ]


def _agreeing(
    database: pycolmap.Database,
    ids: dict[str, int],
    frames: Frames,
    rig: Rig,
    pair: tuple[int, int],
    steps: list[tuple[int, int]],
) -> PairMatches:
    """Matches of two cameras, or of one with itself, in pairs of frames, that agree
    with one epipolar geometry each; numbered by the first frame."""
    (a, b), cameras = pair, rig.refractive_cameras()
    rows = []
    for first, second in steps:
        if not (frames.has_image(a, first) and frames.has_image(b, second)):
            continue
        id_a, id_b = (
            ids[frames.image_name(a, first)],
            ids[frames.image_name(b, second)],
        )
        matches = database.read_matches(id_a, id_b)
        if len(matches) < MIN_MATCHES:
            continue
        xy_a = _keypoints(database, id_a)[matches[:, 0]]
        xy_b = _keypoints(database, id_b)[matches[:, 1]]
        covered = rig.cameras[a].covers(xy_a) & rig.cameras[b].covers(xy_b)
        xy_a, xy_b = xy_a[covered], xy_b[covered]
        good = _epipolar_inliers(cameras[a], cameras[b], xy_a, xy_b)
        frame = np.full((int(good.sum()), 1), float(first))
        rows.append(np.hstack([frame, xy_a[good], xy_b[good]]))
    table = np.concatenate(rows) if rows else np.empty((0, 5))
    return PairMatches(
        camera_a=a,
        camera_b=b,
        frame_idx=table[:, 0].astype(np.int64),
        xy_a=table[:, 1:3].copy(),
        xy_b=table[:, 3:5].copy(),
    )


def _keypoints(database: pycolmap.Database, image_id: int) -> Array:
    return database.read_keypoints(image_id)[:, :2].astype(np.float64)


def _epipolar_inliers(
    camera_a: RefractiveCamera, camera_b: RefractiveCamera, xy_a: Array, xy_b: Array
) -> NDArray[np.bool_]:
    """Mask (N,) of the matches that one essential matrix explains."""
    image_a, image_b = (
        _direction_image(camera_a, xy_a),
        _direction_image(camera_b, xy_b),
    )
    inlier = finite_rows(image_a) & finite_rows(image_b)
    if inlier.sum() < MIN_MATCHES:
        return np.zeros(len(xy_a), dtype=np.bool_)
    # Unit focal length: pixels are tangents, thresholds are angles.
    unit = pycolmap.Camera(
        model="SIMPLE_PINHOLE", width=1, height=1, params=[1.0, 0.0, 0.0]
    )
    options = pycolmap.RANSACOptions()
    options.max_error = MAX_EPIPOLAR_ANGLE
    options.min_num_trials = 50
    options.max_num_trials = 2000
    options.random_seed = SEED
    estimate = pycolmap.estimate_essential_matrix(
        image_a[inlier], image_b[inlier], unit, unit, options
    )
    if estimate is None or estimate["num_inliers"] < MIN_MATCHES:
        return np.zeros(len(xy_a), dtype=np.bool_)
    inlier[inlier] = estimate["inlier_mask"]
    return inlier


def _direction_image(camera: RefractiveCamera, xy: Array) -> Array:
    """Where the water rays of pixels point: x/z, y/z (N, 2); NaN without a ray."""
    _, dirs = camera.ray_from_img(xy)
    return dirs[:, :2] / dirs[:, 2:]

"""Are the images of one camera mirrored? Nothing matches between two cameras then.

Each alone still shows how it moved, and a mirrored one moves the wrong way: it is the
rig as given that ties the two motions together, without any match between them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from uwsfm.geometry.rigid3 import Array
from uwsfm.rig.rig import Rig
from uwsfm.sfm.correction import Correction
from uwsfm.sfm.poses.relative_pose import estimate_rig_relative_poses
from uwsfm.sfm.poses.relative_pose_options import RelativePoseOptions
from uwsfm.sfm.rig_checks.rig_mistakes import MIRRORED, UNMIRROR
from uwsfm.sfm.rig_checks.stereo_matches import PairMatches

MAX_STEPS = 5
"""Steps from frame to frame that are looked at, evenly spread: one may be without a
turn, and along a mirror's axis, which shows nothing."""
MAX_MATCHES = 150
"""Of each camera and step."""
OPTIONS = RelativePoseOptions(max_error_px=12.0, max_trials=2000)
"""Ports that nobody has measured bend rays by some pixels."""
AGREE = 0.6
"""Share of the matches that one motion of the rig explains, once an image is put right;
what matches from frame to frame has few outliers."""
CLEARLY = 1.4
"""By how many times that share must grow: one motion always explains one camera."""


def mirrored_camera(
    rig: Rig, cam_from_rig: Array, successive: Sequence[PairMatches]
) -> Correction | None:
    """Two cameras whose motions fit each other once the images of one are flipped.

    Args:
        rig: As given.
        cam_from_rig: Poses (C, 7) of its cameras.
        successive: Matches of each camera's images with its next ones.
    """
    found: list[tuple[float, Correction]] = []
    sizes = [(item.camera.width, item.camera.height) for item in rig.cameras]
    for first, second in combinations(successive, 2):
        a, b = first.camera_a, second.camera_a
        given = _agreement(rig, cam_from_rig, (first, second))
        for axis, way in enumerate(MIRRORED):
            flipped = _flipped(second, axis, sizes[b][axis])
            share = _agreement(rig, cam_from_rig, (first, flipped))
            if share < max(AGREE, CLEARLY * given):
                continue
            names = f"{rig.cameras[a].name!r} or of {rig.cameras[b].name!r}"
            what = f"the images of {names} are mirrored, {way}"
            correction = Correction(
                code="mirrored", rig=rig, what=what, remedy=UNMIRROR
            )
            found.append((share, correction))
    return max(found, key=lambda item: item[0])[1] if found else None


def _flipped(matches: PairMatches, axis: int, size: float) -> PairMatches:
    sides = matches.xy_a.copy(), matches.xy_b.copy()
    for xy in sides:
        xy[:, axis] = size - xy[:, axis]
    return replace(matches, xy_a=sides[0], xy_b=sides[1])


def _agreement(
    rig: Rig, cam_from_rig: Array, both: tuple[PairMatches, PairMatches]
) -> float:
    """Share of the matches of two cameras that motions of the rig explain."""
    frames = np.intersect1d(both[0].frame_idx, both[1].frame_idx)
    steps = frames[:: -(-len(frames) // MAX_STEPS)] if len(frames) else frames
    explained, count = 0, 0
    for frame in steps.tolist():
        rows = [_of_step(matches, frame) for matches in both]
        camera = np.repeat([m.camera_a for m in both], [len(r) for r in rows])
        xy_a = np.concatenate([m.xy_a[r] for m, r in zip(both, rows, strict=True)])
        xy_b = np.concatenate([m.xy_b[r] for m, r in zip(both, rows, strict=True)])
        motions = estimate_rig_relative_poses(
            rig.refractive_cameras(), cam_from_rig, camera, xy_a, camera, xy_b, OPTIONS
        )
        explained += max((motion.num_inliers for motion in motions), default=0)
        count += len(camera)
    return explained / count if count else 0.0


def _of_step(matches: PairMatches, frame: int) -> NDArray[np.int64]:
    """As many matches of each camera: the fuller one must not decide alone."""
    rows = np.flatnonzero(matches.frame_idx == frame)
    return rows[:: -(-len(rows) // MAX_MATCHES)]

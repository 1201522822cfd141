"""Where the search for a relative pose starts: central cameras, any length."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import pycolmap
from numpy.typing import NDArray

from uwsfm.geometry import rigid3
from uwsfm.geometry.rigid3 import Array
from uwsfm.models.lens_row import FOCAL
from uwsfm.models.refractive import RefractiveCamera
from uwsfm.sfm.poses.kernel_rows import IndexArray
from uwsfm.sfm.poses.relative_pose_options import RelativePoseOptions

Mask = NDArray[np.bool_]

MIN_PAIR = 8
"""Matches of an image pair that is worth a hypothesis; five always fit."""
MAX_PAIRS = 3
MIN_AHEAD = 0.2
"""Of a ray's direction along the axis: 78 degrees, where a plane has no pixels left."""
PLANAR_SHARE = 0.5
"""Of the inliers of an essential matrix, in one plane: its second solution counts."""
SAME_TURN = np.radians(0.5)
"""Adjusted, two starts that differ by less have one end."""
RIVAL = 2.0
"""A second end may be right if its truncated error is within this factor of the
least."""


def image_pairs(
    camera_a: IndexArray, camera_b: IndexArray, usable: Mask
) -> list[tuple[IndexArray, int, int]]:
    """Matches of the image pairs that have the most: (rows, camera, camera)."""
    pairs = np.unique(np.stack([camera_a, camera_b])[:, usable], axis=1).T
    found = [
        (np.flatnonzero(usable & (camera_a == a) & (camera_b == b)), int(a), int(b))
        for a, b in pairs
    ]
    found = [pair for pair in found if len(pair[0]) >= MIN_PAIR]
    return sorted(found, key=lambda pair: -len(pair[0]))[:MAX_PAIRS]


def central_poses(
    rays_a: Array, rays_b: Array, ransac: pycolmap.RANSACOptions
) -> list[Array]:
    """Poses (7,) between the points where rays nearly meet, their lengths unknown.

    The one of the essential matrix; and those of the plane that most matches lie in,
    if there is one. A flat scene has two, and RANSAC on the essential matrix returns
    either (Hartley & Zisserman, 13.1; Malis & Vargas 2007).

    Args:
        rays_a, rays_b: (N, 6) water rays in their cameras.
        ransac: its error is in radians.
    """
    dirs_a, dirs_b = rays_a[:, 3:], rays_b[:, 3:]
    answer = pycolmap.estimate_relative_pose(dirs_a, dirs_b, ransac)
    if answer is None:
        return []
    poses = [np.array(answer["cam2_from_cam1"].params)]
    for pose in _planar_poses(dirs_a, dirs_b, answer["num_inliers"], ransac):
        turns = rigid3.compose(np.array(poses), rigid3.inverse(pose))
        angles = [_angle(rigid3.rotmat_from_quat(turn[:4])) for turn in turns]
        if min(angles) > SAME_TURN:
            poses.append(pose)
    return poses


def _planar_poses(
    dirs_a: Array, dirs_b: Array, num_inliers: int, ransac: pycolmap.RANSACOptions
) -> list[Array]:
    """Poses (7,) that a plane leaves open; none if most of the scene is in no plane."""
    ahead = (dirs_a[:, 2] > MIN_AHEAD) & (dirs_b[:, 2] > MIN_AHEAD)
    if np.count_nonzero(ahead) < MIN_PAIR:
        return []
    flat_a, flat_b = (d[ahead, :2] / d[ahead, 2:] for d in (dirs_a, dirs_b))
    found = pycolmap.estimate_homography_matrix(flat_a, flat_b, ransac)
    if found is None or found["num_inliers"] < PLANAR_SHARE * num_inliers:
        return []
    inside = np.flatnonzero(found["inlier_mask"])
    _, turns, shifts, normals = cv2.decomposeHomographyMat(found["H"], np.eye(3))
    # Points are in front of both cameras where the plane is: n . x > 0.
    rays = np.column_stack([flat_a[inside], np.ones(len(inside))])
    return [
        rigid3.from_rotmat(turn, shift[:, 0])
        for turn, shift, normal in zip(turns, shifts, normals, strict=True)
        if np.median(rays @ normal[:, 0]) > 0.0 and np.linalg.norm(shift) > 0.0
    ]


def distinct_ends(ends: Sequence[tuple[float, Array]]) -> list[Array]:
    """Poses (12,) whose errors are near the least, different ones, the best first.

    Args:
        ends: truncated squared errors, and [R | t] as rows.
    """
    chosen: list[Array] = []
    if not ends:
        return chosen
    least = min(error for error, _ in ends)
    for error, pose in sorted(ends, key=lambda end: end[0]):
        rotations = [row.reshape(3, 4)[:, :3] for row in (pose, *chosen)]
        turns = [_angle(rotations[0].T @ rotation) for rotation in rotations[1:]]
        if error <= RIVAL * least and min(turns, default=np.inf) > SAME_TURN:
            chosen.append(pose)
    return chosen


def _angle(rotation: Array) -> float:
    """Of a rotation matrix, radians."""
    cosine = 0.5 * (np.trace(rotation) - 1.0)
    return float(np.arccos(np.clip(cosine, -1.0, 1.0)))


@dataclass(frozen=True)
class MotionLine:
    """Relative poses of a rig, of one direction of motion and any length."""

    quat: Array
    offset: Array
    direction: Array

    @classmethod
    def through(
        cls,
        moved: Array,
        a_from_rig: Array,
        b_from_rig: Array,
        at_a: Array,
        at_b: Array,
    ) -> MotionLine:
        """Of a motion (7,) between points at_a, at_b (3,) of two cameras."""
        unit = moved[4:] / np.linalg.norm(moved[4:])
        ends = []
        for length in (0.0, 1.0):
            shift = length * unit + at_b - rigid3.rotate(moved, at_a)
            b_from_a = np.concatenate([moved[:4], shift])
            ends.append(
                rigid3.compose(
                    rigid3.inverse(b_from_rig), rigid3.compose(b_from_a, a_from_rig)
                )
            )
        return cls(ends[0][:4], ends[0][4:], ends[1][4:] - ends[0][4:])

    def at(self, length: float) -> Array:
        """A row (12,) of [R | t]."""
        shift = self.offset + length * self.direction
        return rigid3.matrix_rows(np.concatenate([self.quat, shift]))


def ransac_options(
    options: RelativePoseOptions, pair: tuple[RefractiveCamera, RefractiveCamera]
) -> pycolmap.RANSACOptions:
    """For directions in the water, whose pixels are smaller than in air."""
    focals = [camera.port.n_water * np.mean(camera.lens[FOCAL]) for camera in pair]
    return pycolmap.RANSACOptions(
        max_error=options.max_central_error_px / float(np.mean(focals)),
        confidence=options.confidence,
        min_num_trials=options.min_trials,
        max_num_trials=options.max_trials,
        random_seed=options.seed,
    )

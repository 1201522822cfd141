"""Where the search for a relative pose starts: central cameras, any length."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pycolmap
from numpy.typing import NDArray

from uwsfm.geometry import rigid3
from uwsfm.geometry.rigid3 import Array
from uwsfm.sfm.kernel_rows import IndexArray

Mask = NDArray[np.bool_]

MIN_PAIR = 8
"""Matches of an image pair that is worth a hypothesis; five always fit."""
MAX_PAIRS = 3


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


def central_pose(
    rays_a: Array, rays_b: Array, ransac: pycolmap.RANSACOptions
) -> Array | None:
    """Pose (7,) between the points where rays nearly meet, its length unknown.

    Args:
        rays_a, rays_b: (N, 6) water rays in their cameras.
        ransac: its error is in radians.
    """
    answer = pycolmap.estimate_relative_pose(rays_a[:, 3:], rays_b[:, 3:], ransac)
    if answer is None:
        return None
    return np.array(answer["cam2_from_cam1"].params)


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

"""Rig motions over a sea floor near ``z = 0``; the world's z axis points down.

Each function returns ``rig_from_world`` (F, 7). A level rig at altitude ``a`` above the
world origin looks along +z from (0, 0, -a), with its x and y axes along the world's.
"""

import numpy as np
from numpy.typing import ArrayLike

from uwsfm.geometry import rigid3
from uwsfm.geometry.rigid3 import Array


def rig_from_world_looking_at(
    centers: ArrayLike, targets: ArrayLike, roll_deg: ArrayLike
) -> Array:
    """Poses (F, 7) at ``centers`` whose optical axes pass through ``targets``.

    Args:
        centers: Rig origins (F, 3) in the world.
        targets: Points (F, 3) below them.
        roll_deg: Turn of the rig about its optical axis (F,), degrees.
    """
    centers = np.asarray(centers, dtype=np.float64)
    axis = np.asarray(targets, dtype=np.float64) - centers
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    # The shortest rotation from the axis to (0, 0, 1), then the roll about it.
    angle = np.arccos(np.clip(axis[:, 2:], -1.0, 1.0))
    turn = np.cross(axis, [0.0, 0.0, 1.0])
    turn /= np.maximum(np.linalg.norm(turn, axis=1, keepdims=True), 1e-15)
    roll = np.zeros_like(centers)
    roll[:, 2] = np.radians(np.broadcast_to(roll_deg, len(centers)))
    quat = rigid3.multiply_quats(
        rigid3.quat_from_rotvec(roll), rigid3.quat_from_rotvec(angle * turn)
    )
    return np.concatenate([quat, -rigid3.rotate(quat, centers)], axis=1)


def level_poses(centers: ArrayLike, roll_deg: ArrayLike = 0.0) -> Array:
    """Poses (F, 7) at ``centers`` (F, 3), looking straight down."""
    centers = np.asarray(centers, dtype=np.float64)
    return rig_from_world_looking_at(centers, centers + [0.0, 0.0, 1.0], roll_deg)


def straight_strip(
    num_frames: int = 15, *, spacing: float = 0.2, altitude: float = 2.0
) -> Array:
    """A straight, level track along y, across the baseline: the weakest geometry."""
    y = spacing * (np.arange(num_frames) - 0.5 * (num_frames - 1))
    return level_poses(np.column_stack([0.0 * y, y, np.full(num_frames, -altitude)]))


def lawn_mower(
    num_lines: int = 3,
    frames_per_line: int = 5,
    *,
    spacing: float = 0.3,
    line_spacing: float = 0.6,
    altitude: float = 2.0,
) -> Array:
    """Level parallel tracks along y; the vehicle turns round after each line."""
    poses = []
    for line in range(num_lines):
        y = spacing * (np.arange(frames_per_line) - 0.5 * (frames_per_line - 1))
        forth = line % 2 == 0
        x = np.full(frames_per_line, line_spacing * (line - 0.5 * (num_lines - 1)))
        centers = np.column_stack([x, y if forth else -y, np.full(len(y), -altitude)])
        poses.append(level_poses(centers, 0.0 if forth else 180.0))
    return np.concatenate(poses)


def rich_motion(
    num_frames: int = 15, *, altitude: float = 2.0, extent: float = 0.7
) -> Array:
    """A motion that determines the housings: turned, tilted and at many altitudes.

    Positions spiral over a disc of radius ``extent``; the rig looks back at varying
    points near the centre, rolls through the full circle, and its altitude varies by a
    factor of two around ``altitude``. Low-discrepancy sequences spread every quantity
    evenly whatever the number of frames.
    """
    index = np.arange(num_frames)
    golden = np.pi * (3.0 - np.sqrt(5.0))
    radius = extent * np.sqrt((index + 0.5) / max(num_frames, 1))
    height = altitude * 2.0 ** (van_der_corput(index, 2) - 0.5)
    centers = np.column_stack(
        [radius * np.cos(golden * index), radius * np.sin(golden * index), -height]
    )
    aim = np.column_stack([van_der_corput(index, 5), van_der_corput(index, 7)]) - 0.5
    targets = np.column_stack([0.6 * extent * aim, np.zeros(num_frames)])
    return rig_from_world_looking_at(centers, targets, 360 * van_der_corput(index, 3))


def van_der_corput(index: ArrayLike, base: int) -> Array:
    """Low-discrepancy numbers in [0, 1): the digits of ``index`` (N,) mirrored."""
    remaining = np.asarray(index, dtype=np.int64).copy()
    value, scale = np.zeros(len(remaining)), 1.0
    while np.any(remaining > 0):
        scale /= base
        value += scale * (remaining % base)
        remaining //= base
    return value

"""Checks on a chequerboard in the water that took no part in the reconstruction."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from uwsfm.geometry import rays, rigid3

Rays = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]


@dataclass(frozen=True, kw_only=True)
class BoardChecks:
    """All in millimetres; smaller is better, except for the mean."""

    square_mean: float
    """Over the boards; 25.4 nominal. Absolute scale comes from the in-air baseline."""
    square_stddev: float
    """Of the mean square of a board, between the boards."""
    planarity: float
    """Median over the boards of the RMS distance from their plane."""
    gap: float
    """Median shortest distance between the left and the right ray of a corner."""


def check_boards(
    corners_path: Path, left: Rays, right: Rays, right_from_left: np.ndarray
) -> BoardChecks:
    """Triangulate the board's corners with two camera models.

    Args:
        corners_path: tank_corners.npz, with OpenCV's pixel origin.
        left, right: pixels (N, 2; COLMAP's origin) -> origins and directions in the
            camera's frame.
        right_from_left: pose (7,), metres.
    """
    data = np.load(corners_path)
    columns, lines = data["board_inner"]
    left_from_right = rigid3.inverse(right_from_left)
    squares, planes, gaps = [], [], []
    for corners_left, corners_right in zip(data["L"], data["R"], strict=True):
        origin_l, dir_l = left(corners_left + 0.5)  # OpenCV -> COLMAP pixel origin
        origin_r, dir_r = right(corners_right + 0.5)
        points, _, gap = rays.closest_points(
            origin_l,
            dir_l,
            rigid3.transform(left_from_right, origin_r),
            rigid3.rotate(left_from_right, dir_r),
        )
        grid = 1e3 * points.reshape(lines, columns, 3)
        sides = [np.linalg.norm(np.diff(grid, axis=a), axis=2).ravel() for a in (0, 1)]
        squares.append(np.mean(np.concatenate(sides)))
        centred = grid.reshape(-1, 3) - grid.reshape(-1, 3).mean(axis=0)
        planes.append(np.linalg.svd(centred)[1][2] / np.sqrt(len(centred)))
        gaps.append(1e3 * gap)
    return BoardChecks(
        square_mean=float(np.mean(squares)),
        square_stddev=float(np.std(squares)),
        planarity=float(np.median(planes)),
        gap=float(np.median(np.concatenate(gaps))),
    )


def pinhole_rays(camera) -> Rays:
    """Rays of a central `pycolmap.Camera`."""

    def rays_of(xy: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        directions = np.asarray(camera.cam_ray_from_img(xy))
        return np.zeros_like(directions), directions

    return rays_of

"""Places that are not among the unknowns, set by the cameras as they are.

What people click, or a dense cloud holds, does not enter the adjustment: it is placed
by the rays of the finished model.
"""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from uwsfm.calibration.clicks import pixels_by_point
from uwsfm.geometry.rays import finite_rows, triangulate_tracks
from uwsfm.geometry.rigid3 import Array
from uwsfm.scene import Scene

MAX_STEPS = 20
CONVERGED = 1e-12
"""Of a step, relative to the distance from the cameras."""
NO_PARALLAX = 1e-12
"""Smallest eigenvalue of a place's normal matrix over the largest, below which rounding
decides where it is: a parallax of some microradians."""


def placed(scene: Scene) -> Array:
    """The places (P, 3) that fit their observations best, in pixels.

    Args:
        scene: its points are not used; cameras and poses stay.

    Returns:
        NaN where the rays do not meet in front of their cameras, or are parallel.
    """
    origins, dirs = scene.water_rays()
    points = triangulate_tracks(origins, dirs, scene.point_idx, scene.num_points)
    found = _refined(scene, points)
    _, good = _normal_matrices(replace(scene, points=found))
    found[~good] = np.nan
    return found


def misses(scene: Scene) -> Array:
    """How far each observation is from its place (N,), px."""
    return np.linalg.norm(scene.residuals(), axis=1)


def _refined(scene: Scene, points: Array) -> Array:
    """Gauss-Newton on the reprojection errors, every place by itself."""
    for _ in range(MAX_STEPS):
        here = replace(scene, points=points)
        jac, residuals = pixels_by_point(here), here.residuals()
        right = np.zeros_like(points)
        np.add.at(right, scene.point_idx, np.einsum("nij,ni->nj", jac, residuals))
        normal, good = _normal_matrices(here)
        step = np.zeros_like(points)
        step[good] = np.linalg.solve(normal[good], right[good][..., None])[..., 0]
        points = np.where(good[:, None], points - step, np.nan)
        reach = np.linalg.norm(here.points_in_cam(), axis=1)
        size = np.linalg.norm(step, axis=1)[scene.point_idx]
        if not np.any(size > CONVERGED * reach):  # NaN compares false
            break
    return points


def _normal_matrices(scene: Scene) -> tuple[Array, NDArray[np.bool_]]:
    """J^T J (P, 3, 3), and which of them are far from singular (P,)."""
    jac = pixels_by_point(scene)
    normal = np.zeros((scene.num_points, 3, 3))
    np.add.at(normal, scene.point_idx, np.swapaxes(jac, 1, 2) @ jac)
    finite = finite_rows(normal.reshape(-1, 9))
    values = np.linalg.eigvalsh(np.where(finite[:, None, None], normal, 0.0))
    good = np.asarray(finite & (values[:, 0] > NO_PARALLAX * values[:, 2]))
    return normal, good

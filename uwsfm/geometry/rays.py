"""Points from rays: triangulation, gaps and angles between rays."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from uwsfm.geometry.rigid3 import Array


def triangulate_tracks(
    origins: ArrayLike, dirs: ArrayLike, point_idx: ArrayLike, num_points: int
) -> Array:
    """Least-squares intersection of the rays of each point.

    Minimises the sum of squared distances to the rays: sum (I - d d^T)(X - o) = 0.

    Args:
        origins, dirs: (N, 3), dirs unit; rows with NaN are left out.
        point_idx: (N,) the point each ray belongs to.
        num_points: P.

    Returns:
        Points (P, 3); NaN where fewer than two rays, or parallel ones, meet.
    """
    origin, direction = np.asarray(origins, float), np.asarray(dirs, float)
    index = np.asarray(point_idx)
    use = np.isfinite(origin).all(axis=1) & np.isfinite(direction).all(axis=1)
    origin, direction, index = origin[use], direction[use], index[use]
    # Relative to the first ray's origin, so that far worlds lose no digits.
    anchor = np.zeros((num_points, 3))
    anchor[index[::-1]] = origin[::-1]
    shift = origin - anchor[index]
    projector = np.eye(3) - direction[:, :, None] * direction[:, None, :]  # (N, 3, 3)
    normal = np.zeros((num_points, 3, 3))
    right = np.zeros((num_points, 3))
    np.add.at(normal, index, projector)
    np.add.at(right, index, np.einsum("nij,nj->ni", projector, shift))
    points = np.full((num_points, 3), np.nan)
    solvable = np.linalg.det(normal) > 1e-14
    points[solvable] = np.linalg.solve(normal[solvable], right[solvable][..., None])[
        ..., 0
    ]
    return points + anchor


def max_ray_angles(dirs: ArrayLike, point_idx: ArrayLike, num_points: int) -> Array:
    """The widest angle between a point's first ray and its others (P,), radians.

    At least half of the widest angle between any two of them, at linear cost.
    """
    direction, index = np.asarray(dirs, float), np.asarray(point_idx)
    first = np.full((num_points, 3), np.nan)
    first[index[::-1]] = direction[::-1]
    sine = np.linalg.norm(np.cross(first[index], direction), axis=1)
    cosine = np.einsum("ni,ni->n", first[index], direction)
    angles = np.zeros(num_points)
    np.fmax.at(angles, index, np.arctan2(sine, cosine))
    return angles


def closest_points(
    origins_a: ArrayLike, dirs_a: ArrayLike, origins_b: ArrayLike, dirs_b: ArrayLike
) -> tuple[Array, Array, Array]:
    """Midpoint, ranges and gap of pairs of rays.

    Args:
        origins_a, dirs_a, origins_b, dirs_b: (N, 3) each, directions unit.

    Returns:
        Midpoints (N, 3), ranges along both rays (N, 2; negative = behind the origin)
        and the shortest distances (N,). NaN for parallel rays.
    """
    oa, da = np.asarray(origins_a, float), np.asarray(dirs_a, float)
    ob, db = np.asarray(origins_b, float), np.asarray(dirs_b, float)
    between = ob - oa
    cosine = np.einsum("ni,ni->n", da, db)
    along_a = np.einsum("ni,ni->n", da, between)
    along_b = np.einsum("ni,ni->n", db, between)
    det = 1.0 - cosine**2
    det = np.where(det > 1e-14, det, np.nan)
    range_a = (along_a - cosine * along_b) / det
    range_b = (cosine * along_a - along_b) / det
    pa, pb = oa + range_a[:, None] * da, ob + range_b[:, None] * db
    gap = np.linalg.norm(pa - pb, axis=1)
    return 0.5 * (pa + pb), np.stack([range_a, range_b], axis=1), gap


def finite_rows(array: ArrayLike) -> NDArray[np.bool_]:
    """Mask (N,) of the rows without NaN or infinity."""
    return np.isfinite(np.asarray(array, float)).all(axis=1)

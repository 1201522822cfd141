"""The unit sphere as a two-parameter manifold: port normals and baseline directions."""

import math

import numpy as np
from numpy.typing import ArrayLike

from uwsfm._base.jit import kernel
from uwsfm.geometry.rigid3 import Array


@kernel
def tangents(nx: float, ny: float, nz: float):
    """Two unit vectors spanning the plane normal to a unit vector, as 6 scalars.

    Duff et al., "Building an orthonormal basis, revisited", JCGT 2017: no branch and
    no singularity except the sign change at nz = 0.
    """
    sign = math.copysign(1.0, nz)
    a = -1.0 / (sign + nz)
    b = nx * ny * a
    return (
        1.0 + sign * nx * nx * a,
        sign * b,
        -sign * nx,
        b,
        sign + ny * ny * a,
        -ny,
    )


def tangent_basis(direction: ArrayLike) -> Array:
    """Orthonormal basis (3, 2) of the plane normal to a unit vector (3,)."""
    x, y, z = (float(value) for value in np.asarray(direction, dtype=np.float64))
    return np.array(tangents(x, y, z)).reshape(2, 3).T


def plus(direction: ArrayLike, delta: ArrayLike) -> Array:
    """Move a unit vector (3,) along its tangent plane by ``delta`` (2,), radians.

    The exponential map, so the step length is the angle turned.
    """
    direction = np.asarray(direction, dtype=np.float64)
    step = tangent_basis(direction) @ np.asarray(delta, dtype=np.float64)
    angle = float(np.linalg.norm(step))
    moved = np.cos(angle) * direction + np.sinc(angle / np.pi) * step
    return moved / np.linalg.norm(moved)


def minus(target: ArrayLike, direction: ArrayLike) -> Array:
    """The step (2,) in the tangent plane of ``direction`` that `plus` takes to
    ``target`` (both (3,), unit)."""
    direction = np.asarray(direction, dtype=np.float64)
    across = tangent_basis(direction).T @ np.asarray(target, dtype=np.float64)
    sine = float(np.linalg.norm(across))
    angle = angle_between(target, direction)
    return across * (angle / sine if sine > 0.0 else 1.0)


def angle_between(a: ArrayLike, b: ArrayLike) -> float:
    """Angle between two vectors (3,), radians, accurate at small angles."""
    a, b = np.asarray(a, dtype=np.float64), np.asarray(b, dtype=np.float64)
    return float(np.arctan2(np.linalg.norm(np.cross(a, b)), a @ b))

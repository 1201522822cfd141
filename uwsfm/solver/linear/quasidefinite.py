"""Dense systems of unknowns, and of lengths that are known beforehand.

A known length l(x) with miss r, gradient J and variance v adds J^T J / v to the normal
equations, and ties points together that the Schur complement wants apart. With its
force f = (r + J dx) / v as one more unknown it is a column of the border instead:

    [ H   J^T ] [dx]     [g]
    [ J   -v  ] [f ] = - [r]

The points are eliminated as ever. What is left, lengths last, is quasi-definite
(Vanderbei 1995): positive without the lengths, negative without the rest. Taking the
forces out leaves a positive definite matrix again.
"""

import numpy as np
import scipy.linalg
from scipy.linalg import lapack

from uwsfm.geometry.rigid3 import Array

# A system, scaled to a unit diagonal, whose smallest eigenvalue is below this has a
# direction that the data leave to rounding errors.
SINGULAR = 1e-13


def solve_lower(matrix: Array, right: Array, num_lengths: int = 0) -> Array | None:
    """Solution (n,) or (n, r) of a reduced system; None if it is singular.

    Args:
        matrix: (n, n), its lower triangle; lost.
        right: (n,) or (n, r)
        num_lengths: how many of the last columns are lengths.
    """
    unknowns, reach, stiff = without_forces(matrix, num_lengths)
    split = len(unknowns)
    if split == 0:
        return scipy.linalg.solve(stiff, -right, assume_a="pos")
    try:
        factor = scipy.linalg.cho_factor(
            unknowns, lower=True, overwrite_a=True, check_finite=True
        )
    except (scipy.linalg.LinAlgError, ValueError):
        return None
    if not num_lengths:
        return scipy.linalg.cho_solve(factor, right)
    step = scipy.linalg.cho_solve(factor, right[:split] + reach @ right[split:])
    forces = reach.T @ step - np.linalg.solve(stiff, right[split:])
    return np.concatenate([step, forces])


def inverse_of_lower(matrix: Array, num_lengths: int = 0) -> Array | None:
    """Inverse of a reduced system; None if it is singular.

    Args:
        matrix: (n, n), its lower triangle; lost.
        num_lengths: how many of the last columns are lengths.
    """
    unknowns, reach, stiff = without_forces(matrix, num_lengths)
    inverse = _inverse_of_positive(unknowns)
    if inverse is None or not num_lengths:
        return inverse
    forces = inverse @ reach
    return np.block(
        [[inverse, forces], [forces.T, reach.T @ forces - np.linalg.inv(stiff)]]
    )


def without_forces(matrix: Array, num_lengths: int) -> tuple[Array, Array, Array]:
    """The positive definite part (lower triangle), C D^-1 (p, m), and D (m, m).

    For a matrix [[A, C], [C^T, -D]]: A + C D^-1 C^T.
    """
    split = len(matrix) - num_lengths
    if not num_lengths:
        return matrix, np.empty((split, 0)), np.empty((0, 0))
    stiff = symmetric(-matrix[split:, split:])
    coupling = matrix[split:, :split].T
    reach = np.linalg.solve(stiff, coupling.T).T
    return matrix[:split, :split] + reach @ coupling.T, reach, stiff


def symmetric(lower: Array) -> Array:
    """A matrix (n, n) from its lower triangle."""
    return np.tril(lower) + np.tril(lower, -1).T


def _inverse_of_positive(matrix: Array) -> Array | None:
    """Inverse by Cholesky of a matrix (n, n) of which the lower triangle is read."""
    if not len(matrix):
        return matrix
    scale = 1.0 / np.sqrt(np.maximum(np.diag(matrix), 1e-300))
    matrix *= scale
    matrix *= scale[:, None]
    # Fortran reads rows as columns: our lower triangle is its upper one.
    upper = matrix.T
    factor, info = lapack.dpotrf(upper, lower=0, clean=1, overwrite_a=1)
    if info != 0:
        return None
    # 1 / |A^-1|, which is at most the smallest eigenvalue.
    if not lapack.dpocon(factor, 1.0)[0] > SINGULAR:
        return None
    inverse, _ = lapack.dpotri(factor, lower=0, overwrite_c=1)
    lower = inverse.T
    inverse = lower + np.tril(lower, -1).T
    inverse *= scale
    inverse *= scale[:, None]
    return inverse

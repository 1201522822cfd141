"""The scale: the factor by which all lengths of a model err together.

For points X with weights w about their mean M, the factor that fits all distances
between them best changes by

    ds = sum w (X - M) . dX / sum w |X - M|^2
       = sum over pairs of w w' |X - X'| d|X - X'| / sum over pairs of w w' |X - X'|^2

so it is the mean relative error of all point-to-point distances, long ones first: a
property of lengths, which neither a frame of reference nor a rig at rest can disturb.
"""

import numpy as np

from uwsfm.geometry.rays import finite_rows
from uwsfm.geometry.rigid3 import Array
from uwsfm.solver.layout import HELD, Layout
from uwsfm.solver.normal_equations import NormalEquations


def scale_slope(points: Array, inverses: Array) -> Array:
    """Derivative (P, 3) of the scale by the points; zero for points without a place.

    Args:
        points: (P, 3).
        inverses: (P, 3, 3) covariances of each alone, in any unit: uncertain points,
            far away most of all, count less.
    """
    variance = np.einsum("pii->p", inverses)
    good = finite_rows(points) & np.isfinite(variance) & (variance > 0.0)
    slope = np.zeros_like(points)
    if np.count_nonzero(good) < 2:
        return np.full_like(points, np.nan)
    weights = 1.0 / (1.0 + variance[good] / np.median(variance[good]))
    middle = weights @ points[good] / weights.sum()
    arms = points[good] - middle
    spread = float(weights @ np.sum(arms**2, axis=1))
    slope[good] = weights[:, None] * arms / spread
    return slope


def by_unknowns(
    layout: Layout, eqs: NormalEquations, inverses: Array, slope: Array
) -> Array:
    """Derivative (n,) by frames and border of what depends on the points.

    Args:
        layout, eqs: the linearised problem.
        inverses: (P, 3, 3) of the points' blocks.
        slope: (P, 3) derivative by the points.
    """
    pull = np.einsum("pij,pj->pi", inverses, slope)
    point = np.repeat(np.arange(len(slope)), np.diff(layout.point_start))
    force = np.einsum("kij,kj->ki", eqs.cells[:, :3], pull[point])
    both = np.concatenate([np.cross(eqs.cells[:, 3], force), force], axis=1)
    num_frames = len(layout.frame_col)
    by_frame = np.stack(
        [np.bincount(layout.cell_frame, column, num_frames) for column in both.T],
        axis=1,
    )
    free = np.flatnonzero(layout.frame_col != HELD)
    ordered = free[np.argsort(layout.frame_col[free])]
    border = np.einsum("pib,pi->b", eqs.points_border, pull)
    return -np.concatenate([by_frame[ordered].ravel(), border])

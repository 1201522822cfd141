"""Posterior covariance of frames, border and points at an optimum."""

import math
from dataclasses import dataclass

import numpy as np

from uwsfm._jit import kernel
from uwsfm.geometry.rigid3 import Array
from uwsfm.solver import schur
from uwsfm.solver.layout import HELD, Layout
from uwsfm.solver.normal_equations import NormalEquations
from uwsfm.solver.quasidefinite import inverse_of_lower


@dataclass(frozen=True, kw_only=True)
class ReducedCovariance:
    """Inverse of the reduced system (n, n), for unit noise."""

    matrix: Array
    """(n, n) frames, then border; NaN everywhere if singular."""
    determined: bool
    inverses: Array
    """(P, 3, 3) inverses of the point blocks that the elimination used."""

    def border(self, layout: Layout) -> Array:
        """(B, B) block of rig and ports, marginal over poses and points."""
        inside = slice(layout.num_frame_cols, None)
        return self.matrix[inside, inside][: layout.num_camera_cols][
            :, : layout.num_camera_cols
        ]

    def navigation(self, layout: Layout) -> Array:
        """(6, 6) block of nav_from_world [rotation, translation], left tangent."""
        end = layout.num_unknowns
        inside = slice(end - layout.num_nav_cols, end)
        return self.matrix[inside, inside]

    def frames(self, layout: Layout) -> Array:
        """(F, 6, 6) blocks of the poses [rotation, translation]; zero if held."""
        blocks = np.zeros((len(layout.frame_col), 6, 6))
        for f, col in enumerate(layout.frame_col):
            if col != HELD:
                blocks[f] = self.matrix[col : col + 6, col : col + 6]
        return blocks


def reduced_covariance(layout: Layout, eqs: NormalEquations) -> ReducedCovariance:
    """Invert the undamped reduced system.

    The observations' noise is taken as 1 px: multiply by the noise variance.
    """
    matrix, _, inverses = schur.reduced_system(layout, eqs, 0.0)
    inverse = inverse_of_lower(matrix, layout.num_lengths)
    if inverse is None:
        return ReducedCovariance(
            matrix=np.full_like(matrix, np.nan), determined=False, inverses=inverses
        )
    return ReducedCovariance(matrix=inverse, determined=True, inverses=inverses)


@kernel
def _coupling_of_point(layout, eqs, p, offset, cols, coupling):
    """Rows of a point's coupling C = [W of the free frames; E^T]; their number."""
    rows = 0
    for c in range(layout.point_start[p], layout.point_start[p + 1]):
        col = layout.frame_col[layout.cell_frame[c]]
        if col == HELD:
            continue
        for a in range(6):
            cols[rows] = col + a
            coupling[rows] = eqs.cells[c, a]
            rows += 1
    for k in range(len(eqs.border_grad)):
        cols[rows] = offset + k
        coupling[rows] = eqs.points_border[p, :, k]
        rows += 1
    return rows


@kernel
def _point_covariances(layout, eqs, matrix, offset, out):
    """V^-1 + (C V^-1)^T S^-1 (C V^-1) of each point; NaN where V is singular."""
    num_border = len(eqs.border_grad)
    inverse = np.empty((3, 3))
    for p in range(len(layout.point_start) - 1):
        if not schur.invert_damped(eqs.points[p], 0.0, inverse):
            out[p] = math.nan
            continue
        cells = layout.point_start[p + 1] - layout.point_start[p]
        cols = np.empty(6 * cells + num_border, dtype=np.int64)
        coupling = np.empty((6 * cells + num_border, 3))
        rows = _coupling_of_point(layout, eqs, p, offset, cols, coupling)
        reach = coupling[:rows] @ inverse
        out[p] = inverse
        for i in range(rows):
            s0, s1, s2 = 0.0, 0.0, 0.0
            for j in range(rows):
                m = matrix[cols[i], cols[j]]
                s0 += m * reach[j, 0]
                s1 += m * reach[j, 1]
                s2 += m * reach[j, 2]
            for a in range(3):
                out[p, a, 0] += reach[i, a] * s0
                out[p, a, 1] += reach[i, a] * s1
                out[p, a, 2] += reach[i, a] * s2


def point_covariances(
    layout: Layout, eqs: NormalEquations, reduced: ReducedCovariance
) -> Array:
    """Marginal covariances of the points in the world (P, 3, 3), unit noise.

    NaN for points that the observations do not determine.
    """
    out = np.empty_like(eqs.points)
    _point_covariances(layout, eqs, reduced.matrix, layout.num_frame_cols, out)
    return out

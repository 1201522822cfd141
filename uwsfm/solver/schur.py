"""Schur complement: eliminate the points, solve frames and border, substitute back."""

import numpy as np

from uwsfm._jit import kernel
from uwsfm.geometry.rigid3 import Array
from uwsfm.solver.layout import HELD, Layout
from uwsfm.solver.normal_equations import MIN_DIAGONAL, NormalEquations

# Damping of a point that its rays do not fix (seen twice in one image, or at infinity).
# Held instead of free it would be a landmark, and promise what the data do not.
LOOSE = 1e-8


@kernel
def invert_damped(block, damping, inverse):
    """Inverse of a symmetric 3x3 with Marquardt damping; False if it is singular."""
    a = block[0, 0] + damping * max(block[0, 0], MIN_DIAGONAL)
    d = block[1, 1] + damping * max(block[1, 1], MIN_DIAGONAL)
    f = block[2, 2] + damping * max(block[2, 2], MIN_DIAGONAL)
    b, c, e = block[0, 1], block[0, 2], block[1, 2]
    c00, c01, c02 = d * f - e * e, c * e - b * f, b * e - c * d
    det = a * c00 + b * c01 + c * c02
    # Rays 1e-7 rad apart; below, rounding decides (a point seen twice in one image).
    if not det > 1e-14 * a * d * f:
        return False
    inverse[0, 0], inverse[1, 1] = c00 / det, (a * f - c * c) / det
    inverse[2, 2] = (a * d - b * b) / det
    inverse[0, 1] = inverse[1, 0] = c01 / det
    inverse[0, 2] = inverse[2, 0] = c02 / det
    inverse[1, 2] = inverse[2, 1] = (b * c - a * e) / det
    return True


@kernel
def fill_frames_and_border(layout, eqs, damping, matrix, right, offset):
    """Copy the damped diagonal blocks and the border, before any elimination."""
    num_border = len(eqs.border_grad)
    for f in range(len(layout.frame_col)):
        col = layout.frame_col[f]
        if col == HELD:
            continue
        for a in range(6):
            right[col + a] = -eqs.frames_grad[f, a]
            for b in range(6):
                matrix[col + a, col + b] = eqs.frames[f, a, b]
            matrix[col + a, col + a] += damping * max(eqs.frames[f, a, a], MIN_DIAGONAL)
            for k in range(num_border):
                matrix[offset + k, col + a] = eqs.frames_border[f, a, k]
    for k in range(num_border):
        right[offset + k] = -eqs.border_grad[k]
        for m in range(num_border):
            matrix[offset + k, offset + m] = eqs.border[k, m]
        if k < num_border - layout.num_lengths:
            stiff = max(eqs.border[k, k], MIN_DIAGONAL)
            matrix[offset + k, offset + k] += damping * stiff


@kernel
def _sweep_border(eqs, p, inverse, offset, swept, matrix, right):
    """Take one point out of the border: swept = E^T V^-1, border -= swept E."""
    g, e = eqs.points_grad[p], eqs.points_border[p]
    for k in range(len(swept)):
        row = offset + k
        for b in range(3):
            swept[k, b] = (
                e[0, k] * inverse[0, b]
                + e[1, k] * inverse[1, b]
                + e[2, k] * inverse[2, b]
            )
        s0, s1, s2 = swept[k, 0], swept[k, 1], swept[k, 2]
        right[row] += s0 * g[0] + s1 * g[1] + s2 * g[2]
        for m in range(k + 1):
            matrix[row, offset + m] -= s0 * e[0, m] + s1 * e[1, m] + s2 * e[2, m]


@kernel
def _fold_cell(cell, inverse, grad, col, folded, right):
    """folded = W V^-1 of one cell, and its part of the right side."""
    for a in range(6):
        for b in range(3):
            folded[a, b] = (
                cell[a, 0] * inverse[0, b]
                + cell[a, 1] * inverse[1, b]
                + cell[a, 2] * inverse[2, b]
            )
        right[col + a] += (
            folded[a, 0] * grad[0] + folded[a, 1] * grad[1] + folded[a, 2] * grad[2]
        )


@kernel
def _subtract_product(left, right, row, col, matrix):
    """matrix[row:, col:] -= left right^T, for left (n, 3) and right (m, 3)."""
    for a in range(len(left)):
        l0, l1, l2 = left[a, 0], left[a, 1], left[a, 2]
        for b in range(len(right)):
            matrix[row + a, col + b] -= (
                l0 * right[b, 0] + l1 * right[b, 1] + l2 * right[b, 2]
            )


@kernel
def eliminate_points(layout, eqs, damping, offset, inverses, matrix, right):
    """Build the reduced system (lower triangle) of frames, then border.

    Args:
        layout, eqs: the linearised problem.
        damping: Marquardt's lambda.
        offset: number of frame columns.
        inverses: (P, 3, 3), written: inverses of the damped point blocks.
        matrix, right: (n, n) and (n,), written.
    """
    matrix[:], right[:], inverses[:] = 0.0, 0.0, 0.0
    fill_frames_and_border(layout, eqs, damping, matrix, right, offset)
    folded = np.empty((6, 3))
    swept = np.empty((len(eqs.border_grad), 3))
    for p in range(len(layout.point_start) - 1):
        inverse = inverses[p]
        if not invert_damped(eqs.points[p], damping, inverse):
            invert_damped(eqs.points[p], LOOSE, inverse)
        _sweep_border(eqs, p, inverse, offset, swept, matrix, right)
        first, last = layout.point_start[p], layout.point_start[p + 1]
        for c in range(first, last):
            col = layout.frame_col[layout.cell_frame[c]]
            if col == HELD:
                continue
            _fold_cell(eqs.cells[c], inverse, eqs.points_grad[p], col, folded, right)
            _subtract_product(swept, eqs.cells[c], offset, col, matrix)
            for other in range(first, c + 1):
                col2 = layout.frame_col[layout.cell_frame[other]]
                if col2 != HELD:
                    _subtract_product(folded, eqs.cells[other], col, col2, matrix)


@kernel
def substitute_back(layout, eqs, inverses, step, offset, points_step):
    """Steps of the points (P, 3) from the step of frames and border (n,)."""
    num_border = len(eqs.border_grad)
    for p in range(len(layout.point_start) - 1):
        g = eqs.points_grad[p]
        b0, b1, b2 = -g[0], -g[1], -g[2]
        for k in range(num_border):
            s = step[offset + k]
            b0 -= eqs.points_border[p, 0, k] * s
            b1 -= eqs.points_border[p, 1, k] * s
            b2 -= eqs.points_border[p, 2, k] * s
        for c in range(layout.point_start[p], layout.point_start[p + 1]):
            col = layout.frame_col[layout.cell_frame[c]]
            if col == HELD:
                continue
            for a in range(6):
                s = step[col + a]
                b0 -= eqs.cells[c, a, 0] * s
                b1 -= eqs.cells[c, a, 1] * s
                b2 -= eqs.cells[c, a, 2] * s
        v = inverses[p]
        points_step[p, 0] = v[0, 0] * b0 + v[0, 1] * b1 + v[0, 2] * b2
        points_step[p, 1] = v[1, 0] * b0 + v[1, 1] * b1 + v[1, 2] * b2
        points_step[p, 2] = v[2, 0] * b0 + v[2, 1] * b1 + v[2, 2] * b2


def reduced_system(
    layout: Layout, eqs: NormalEquations, damping: float
) -> tuple[Array, Array, Array]:
    """The reduced matrix (n, n; lower triangle), right side (n,), point inverses."""
    offset = layout.num_frame_cols
    size = offset + layout.num_border_cols
    matrix, right = np.empty((size, size)), np.empty(size)
    inverses = np.empty_like(eqs.points)
    eliminate_points(layout, eqs, damping, offset, inverses, matrix, right)
    return matrix, right, inverses

"""Schur complement: eliminate the points, and substitute them back.

What is left are frames and border. Frames meet only where they share points: their part
is kept as 6x6 blocks in the pattern of a `BlockGraph`. A thread sums whole rows of it,
and every sum runs over the points in their order: the digits do not depend on how many
threads there are.
"""

from typing import NamedTuple

import numpy as np

from uwsfm._base.jit import inner_fused, lane, straight
from uwsfm.geometry.rigid3 import Array
from uwsfm.solver.layout import HELD, Layout
from uwsfm.solver.linear.block_graph import BlockGraph, find_block
from uwsfm.solver.normal_equations import MIN_DIAGONAL, NormalEquations
from uwsfm.solver.threads import chunk_bounds, num_threads, run_chunks

# Damping of a point that its rays do not fix (seen twice in one image, or at infinity).
# Held instead of free it would be a landmark, and promise what the data do not.
LOOSE = 1e-8

POINTS_AT_ONCE = 8192
"""Whose part of the border is summed apart: the same for any number of threads."""

CELLS_PER_THREAD = 10_000
"""Fewer cost less than a thread's start, 50 us."""


class ReducedSystem(NamedTuple):
    """Frames (F free ones) and border (B columns), symmetric, after the points."""

    blocks: Array
    """(number of blocks, 6, 6): of row i and frame j <= i, rows of j, columns of i."""
    coupling: Array
    """(F, B, 6) of border and frames."""
    border: Array
    """(B, B), lower triangle."""
    right_frames: Array
    """(F, 6)"""
    right_border: Array
    """(B,)"""
    inverses: Array
    """(P, 3, 3): inverses of the damped point blocks."""


@inner_fused
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


@straight
def invert_points(eqs, damping, first, last, inverses, border, right):
    """Invert the damped blocks of some points, and take them out of the border.

    Args:
        eqs, damping: the linearised problem, Marquardt's lambda.
        first, last: the points.
        inverses: (P, 3, 3), written.
        border, right: (B, B; lower triangle) and (B,), where the sums are subtracted.
    """
    swept = np.empty((len(right), 3))
    points, points_grad, e = eqs.points, eqs.points_grad, eqs.points_border
    for p in range(first, last):
        inverse = inverses[p]
        inverse[:] = 0.0
        if not invert_damped(points[p], damping, inverse):
            invert_damped(points[p], LOOSE, inverse)
        g0, g1, g2 = points_grad[p, 0], points_grad[p, 1], points_grad[p, 2]
        for k in range(len(right)):
            for b in range(3):
                swept[k, b] = (
                    e[p, 0, k] * inverse[0, b]
                    + e[p, 1, k] * inverse[1, b]
                    + e[p, 2, k] * inverse[2, b]
                )
            s0, s1, s2 = swept[k, 0], swept[k, 1], swept[k, 2]
            right[k] += s0 * g0 + s1 * g1 + s2 * g2
            for m in range(k + 1):
                border[k, m] -= s0 * e[p, 0, m] + s1 * e[p, 1, m] + s2 * e[p, 2, m]


@lane
def _rows(cells, c):
    """W (6, 3) of a cell by rows, see `NormalEquations.cells`."""
    x, y, z = cells[c, 3, 0], cells[c, 3, 1], cells[c, 3, 2]
    a0, a1, a2 = cells[c, 0, 0], cells[c, 0, 1], cells[c, 0, 2]
    b0, b1, b2 = cells[c, 1, 0], cells[c, 1, 1], cells[c, 1, 2]
    d0, d1, d2 = cells[c, 2, 0], cells[c, 2, 1], cells[c, 2, 2]
    return (
        (y * d0 - z * b0, y * d1 - z * b1, y * d2 - z * b2),
        (z * a0 - x * d0, z * a1 - x * d1, z * a2 - x * d2),
        (x * b0 - y * a0, x * b1 - y * a1, x * b2 - y * a2),
        (a0, a1, a2),
        (b0, b1, b2),
        (d0, d1, d2),
    )


@lane
def _fold_cell(cells, inverses, grads, c, p, i, folded, right):
    """W V^-1 (6, 3) of one cell, and its part of the right side of row i."""
    v00, v01, v02 = inverses[p, 0, 0], inverses[p, 0, 1], inverses[p, 0, 2]
    v11, v12, v22 = inverses[p, 1, 1], inverses[p, 1, 2], inverses[p, 2, 2]
    g0, g1, g2 = grads[p, 0], grads[p, 1], grads[p, 2]
    rows = _rows(cells, c)
    for a in range(6):
        w0, w1, w2 = rows[a]
        f0 = w0 * v00 + w1 * v01 + w2 * v02
        f1 = w0 * v01 + w1 * v11 + w2 * v12
        f2 = w0 * v02 + w1 * v12 + w2 * v22
        folded[a, 0], folded[a, 1], folded[a, 2] = f0, f1, f2
        right[i, a] += f0 * g0 + f1 * g1 + f2 * g2


@lane
def _columns(folded):
    """The three columns of W V^-1, six numbers each."""
    return (
        (folded[0, 0], folded[1, 0], folded[2, 0]),
        (folded[3, 0], folded[4, 0], folded[5, 0]),
        (folded[0, 1], folded[1, 1], folded[2, 1]),
        (folded[3, 1], folded[4, 1], folded[5, 1]),
        (folded[0, 2], folded[1, 2], folded[2, 2]),
        (folded[3, 2], folded[4, 2], folded[5, 2]),
    )


@lane
def _line(columns, w0, w1, w2):
    """W V^-1 (w0, w1, w2), six numbers."""
    (f00, f10, f20), (f30, f40, f50) = columns[0], columns[1]
    (f01, f11, f21), (f31, f41, f51) = columns[2], columns[3]
    (f02, f12, f22), (f32, f42, f52) = columns[4], columns[5]
    return (
        f00 * w0 + f01 * w1 + f02 * w2,
        f10 * w0 + f11 * w1 + f12 * w2,
        f20 * w0 + f21 * w1 + f22 * w2,
        f30 * w0 + f31 * w1 + f32 * w2,
        f40 * w0 + f41 * w1 + f42 * w2,
        f50 * w0 + f51 * w1 + f52 * w2,
    )


@lane
def _subtract(values, i, k, line):
    """values[i, k] (6) -= a line: all is loaded before it is stored."""
    b0, b1 = values[i, k, 0] - line[0], values[i, k, 1] - line[1]
    b2, b3 = values[i, k, 2] - line[2], values[i, k, 3] - line[3]
    b4, b5 = values[i, k, 4] - line[4], values[i, k, 5] - line[5]
    values[i, k, 0], values[i, k, 1], values[i, k, 2] = b0, b1, b2
    values[i, k, 3], values[i, k, 4], values[i, k, 5] = b3, b4, b5


@lane
def _subtract_cross(values, i, k, y, c, z, b):
    """values[i, k] (6) -= y c - z b of two lines, one row of q x M."""
    b0 = values[i, k, 0] - y * c[0] + z * b[0]
    b1 = values[i, k, 1] - y * c[1] + z * b[1]
    b2 = values[i, k, 2] - y * c[2] + z * b[2]
    b3 = values[i, k, 3] - y * c[3] + z * b[3]
    b4 = values[i, k, 4] - y * c[4] + z * b[4]
    b5 = values[i, k, 5] - y * c[5] + z * b[5]
    values[i, k, 0], values[i, k, 1], values[i, k, 2] = b0, b1, b2
    values[i, k, 3], values[i, k, 4], values[i, k, 5] = b3, b4, b5


@lane
def _subtract_border(borders, p, i, folded, coupling):
    """Coupling (B, 6) of row i -= E^T (W V^-1)^T."""
    columns = _columns(folded)
    for k in range(coupling.shape[1]):
        w0, w1, w2 = borders[p, 0, k], borders[p, 1, k], borders[p, 2, k]
        _subtract(coupling, i, k, _line(columns, w0, w1, w2))


@lane
def _subtract_products(
    row_start, row_other, cell_row, first, last, i, cells, folded, blocks
):
    """Blocks of row i -= W' (W V^-1)^T for the cells W' of a point up to its own."""
    columns = _columns(folded)
    # Literals would compile the functions once for each of them.
    row0, row1, row2 = np.int64(0), np.int64(1), np.int64(2)
    row3, row4, row5 = np.int64(3), np.int64(4), np.int64(5)
    s = row_start[i]
    for c in range(first, last):
        j = cell_row[c]
        if j == HELD:
            continue
        s = find_block(row_start, row_other, i, j, s)
        x, y, z = cells[c, 3, 0], cells[c, 3, 1], cells[c, 3, 2]
        # The lower rows, of H R; the upper ones are q x these.
        l0 = _line(columns, cells[c, 0, 0], cells[c, 0, 1], cells[c, 0, 2])
        l1 = _line(columns, cells[c, 1, 0], cells[c, 1, 1], cells[c, 1, 2])
        l2 = _line(columns, cells[c, 2, 0], cells[c, 2, 1], cells[c, 2, 2])
        _subtract_cross(blocks, s, row0, y, l2, z, l1)
        _subtract_cross(blocks, s, row1, z, l0, x, l2)
        _subtract_cross(blocks, s, row2, x, l1, y, l0)
        _subtract(blocks, s, row3, l0)
        _subtract(blocks, s, row4, l1)
        _subtract(blocks, s, row5, l2)


@inner_fused
def _fill_rows(graph, eqs, damping, first, last, system):
    """Rows as they are before any elimination."""
    blocks, coupling, right = system.blocks, system.coupling, system.right_frames
    blocks[graph.row_start[first] : graph.row_start[last]] = 0.0
    for i in range(first, last):
        f, own = graph.frame[i], graph.row_start[i + 1] - 1
        for a in range(6):
            right[i, a] = -eqs.frames_grad[f, a]
            for b in range(6):
                blocks[own, a, b] = eqs.frames[f, a, b]
            blocks[own, a, a] += damping * max(eqs.frames[f, a, a], MIN_DIAGONAL)
            for k in range(coupling.shape[1]):
                coupling[i, k, a] = eqs.frames_border[f, a, k]


@straight
def eliminate_rows(point_start, graph, eqs, damping, first, last, system):
    """Sum the rows of some frames.

    Args:
        point_start, graph, eqs: the linearised problem.
        damping: Marquardt's lambda.
        first, last: the rows.
        system: its inverses given; blocks, coupling and right side of the rows written.
    """
    blocks, coupling, right = system.blocks, system.coupling, system.right_frames
    _fill_rows(graph, eqs, damping, first, last, system)
    # Named once, out of the loop: each look into a tuple of arrays counts references.
    row_start, row_other, cell_row = graph.row_start, graph.row_other, graph.cell_row
    cells, grads, borders = eqs.cells, eqs.points_grad, eqs.points_border
    inverses, folded = system.inverses, np.empty((6, 3))
    for p in graph.point_order:
        start = point_start[p]
        for c in range(start, point_start[p + 1]):
            i = cell_row[c]
            if first <= i < last:
                _fold_cell(cells, inverses, grads, c, p, i, folded, right)
                _subtract_border(borders, p, i, folded, coupling)
                _subtract_products(
                    row_start,
                    row_other,
                    cell_row,
                    start,
                    c + 1,
                    i,
                    cells,
                    folded,
                    blocks,
                )


@straight
def substitute_points(
    point_start, graph, eqs, inverses, frames_step, border_step, first, last, out
):
    """Steps (P, 3) of some points from those of the frames (F, 6) and border (B,)."""
    grads, borders, cells = eqs.points_grad, eqs.points_border, eqs.cells
    cell_row = graph.cell_row
    for p in range(first, last):
        b0, b1, b2 = -grads[p, 0], -grads[p, 1], -grads[p, 2]
        for k in range(len(border_step)):
            s = border_step[k]
            b0 -= borders[p, 0, k] * s
            b1 -= borders[p, 1, k] * s
            b2 -= borders[p, 2, k] * s
        for c in range(point_start[p], point_start[p + 1]):
            i = cell_row[c]
            if i == HELD:
                continue
            # W^T s = (H R)^T (s1 + s0 x q)
            x, y, z = cells[c, 3, 0], cells[c, 3, 1], cells[c, 3, 2]
            t0, t1, t2 = frames_step[i, 0], frames_step[i, 1], frames_step[i, 2]
            m0 = frames_step[i, 3] + t1 * z - t2 * y
            m1 = frames_step[i, 4] + t2 * x - t0 * z
            m2 = frames_step[i, 5] + t0 * y - t1 * x
            b0 -= cells[c, 0, 0] * m0 + cells[c, 1, 0] * m1 + cells[c, 2, 0] * m2
            b1 -= cells[c, 0, 1] * m0 + cells[c, 1, 1] * m1 + cells[c, 2, 1] * m2
            b2 -= cells[c, 0, 2] * m0 + cells[c, 1, 2] * m1 + cells[c, 2, 2] * m2
        for a in range(3):
            out[p, a] = (
                inverses[p, a, 0] * b0 + inverses[p, a, 1] * b1 + inverses[p, a, 2] * b2
            )


def damped_border(layout: Layout, eqs: NormalEquations, damping: float) -> Array:
    """The border's own block (B, B); what is known of lengths is not damped."""
    border = eqs.border.copy()
    free = np.arange(layout.num_border_cols - layout.num_lengths)
    stiff = np.maximum(np.diagonal(border)[free], MIN_DIAGONAL)
    border[free, free] += damping * stiff
    return border


def reduced_system(
    layout: Layout,
    graph: BlockGraph,
    eqs: NormalEquations,
    damping: float,
    storage: ReducedSystem | None = None,
) -> ReducedSystem:
    """Eliminate the points.

    Args:
        layout, graph, eqs: the linearised problem.
        damping: Marquardt's lambda.
        storage: an earlier result, whose arrays are used again.
    """
    system = storage or empty_system(layout, graph)
    num_points, num_border = len(eqs.points), layout.num_border_cols
    num_chunks = max(1, -(-num_points // POINTS_AT_ONCE))
    borders = np.zeros((num_chunks, num_border, num_border))
    rights = np.zeros((num_chunks, num_border))
    borders[0], rights[0] = damped_border(layout, eqs, damping), -eqs.border_grad

    def invert(chunk: int) -> None:
        first = chunk * POINTS_AT_ONCE
        last = min(first + POINTS_AT_ONCE, num_points)
        invert_points(
            eqs, damping, first, last, system.inverses, borders[chunk], rights[chunk]
        )

    run_chunks(invert, num_chunks)
    system.border[...], system.right_border[...] = borders.sum(0), rights.sum(0)
    rows = chunk_bounds(graph.work_start, _num_chunks(layout))

    def eliminate(chunk: int) -> None:
        first, last = rows[chunk], rows[chunk + 1]
        eliminate_rows(layout.point_start, graph, eqs, damping, first, last, system)

    run_chunks(eliminate, len(rows) - 1)
    return system


def empty_system(layout: Layout, graph: BlockGraph) -> ReducedSystem:
    num_border = layout.num_border_cols
    return ReducedSystem(
        blocks=np.empty((graph.num_blocks, 6, 6)),
        coupling=np.empty((graph.num_frames, num_border, 6)),
        border=np.empty((num_border, num_border)),
        right_frames=np.empty((graph.num_frames, 6)),
        right_border=np.empty(num_border),
        inverses=np.empty((len(layout.point_start) - 1, 3, 3)),
    )


def substitute_back(
    layout: Layout,
    graph: BlockGraph,
    eqs: NormalEquations,
    inverses: Array,
    step: Array,
) -> Array:
    """Steps of the points (P, 3) from the step of frames and border (n,)."""
    offset = layout.num_frame_cols
    frames_step, border_step = step[:offset].reshape(-1, 6), step[offset:]
    points_step = np.empty_like(eqs.points_grad)
    points = chunk_bounds(layout.point_start, _num_chunks(layout))

    def substitute(chunk: int) -> None:
        substitute_points(
            layout.point_start,
            graph,
            eqs,
            inverses,
            frames_step,
            border_step,
            points[chunk],
            points[chunk + 1],
            points_step,
        )

    run_chunks(substitute, len(points) - 1)
    return points_step


def _num_chunks(layout: Layout) -> int:
    return max(1, min(num_threads(), len(layout.cell_frame) // CELLS_PER_THREAD))

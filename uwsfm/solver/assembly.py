"""From rows of Jacobians to normal equations, cell by cell."""

from typing import Final, NamedTuple

import numpy as np

from uwsfm._base.jit import inner_straight, lane
from uwsfm.geometry.rigid3 import Array
from uwsfm.scene import IndexArray
from uwsfm.solver.chunks import GRAD, width
from uwsfm.solver.lane_products import num_fours
from uwsfm.solver.layout import HELD, Layout

NOTHING: Final = (0.0,) * 9
"""Of the nine scalars of a cell or a point."""


class Sums(NamedTuple):
    """What points share, summed over some of them, which R frames see; W columns for
    each of C cameras, in S slots, of which fours are summed at once."""

    seen: IndexArray
    """(R,) the frames, rising."""
    row: IndexArray
    """(F,) where they are in ``seen``."""
    turns: Array
    """(R, 3, 6): first three rows of U."""
    moves: Array
    """(R, 12): H of the others, see `sum_rows`, and the gradient, its turn last."""
    slots: Array
    """(6 R, S / 4, 4) of frames and cameras."""
    blocks: Array
    """(C, W, W + 1) of each camera against the residual, then itself."""
    four_start: IndexArray
    """(C + 1,) first four of each camera."""
    column: IndexArray
    """(S / 4, 4) of the border; HELD where a four is not full."""
    of_point: Array
    """(3, S / 4, 4) scratch: one point against the cameras."""


def new_sums(layout: Layout, seen: IndexArray) -> Sums:
    """Sums over points that some frames (R,), rising, see."""
    num_cameras = len(layout.free_start) - 1
    w, count = width(layout), len(seen)
    row = np.full(len(layout.frame_col), -1, dtype=np.int64)
    row[seen] = np.arange(count)
    counts = [num_fours(num_free) for num_free in np.diff(layout.free_start)]
    four_start = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
    column = np.full((four_start[-1], 4), HELD)
    for k in range(num_cameras):
        cols = layout.free_col[layout.free_start[k] : layout.free_start[k + 1]]
        column[four_start[k] :].reshape(-1)[: len(cols)] = cols
    return Sums(
        seen=seen,
        row=row,
        turns=np.zeros((count, 3, 6)),
        moves=np.zeros((count, 12)),
        slots=np.zeros((6 * count, *column.shape)),
        blocks=np.zeros((num_cameras, w, w + 1)),
        four_start=four_start,
        column=column,
        of_point=np.zeros((3, *column.shape)),
    )


def clear(sums: Sums) -> None:
    """Zero, for other points."""
    for block in (sums.turns, sums.moves, sums.slots, sums.blocks):
        block[...] = 0.0


def add_frames(
    seen: IndexArray, turns: Array, moves: Array, frames: Array, frames_grad: Array
) -> None:
    """Add sums of some frames to their U (F, 6, 6) and gradients (F, 6)."""
    frames[seen, :3] += turns
    frames[seen, 3:, :3] += np.swapaxes(turns[:, :, 3:], 1, 2)
    frames[seen, 3:, 3:] += moves[:, [[0, 1, 3], [1, 2, 4], [3, 4, 5]]]
    frames_grad[seen, :3] += moves[:, 9:]
    frames_grad[seen, 3:] += moves[:, 6:9]


@lane
def _torque(x, y, z, a, b, c):
    """q x m."""
    return y * c - z * b, z * a - x * c, x * b - y * a


@lane
def _four(values, i, k):
    return values[i, k, 0], values[i, k, 1], values[i, k, 2], values[i, k, 3]


@lane
def _add_four(values, i, k, w):
    """values[i, k] (4) += w: all is loaded before it is stored."""
    w0, w1 = values[i, k, 0] + w[0], values[i, k, 1] + w[1]
    w2, w3 = values[i, k, 2] + w[2], values[i, k, 3] + w[3]
    values[i, k, 0], values[i, k, 1], values[i, k, 2], values[i, k, 3] = w0, w1, w2, w3


@lane
def _cross(y, c, z, b):
    """y c - z b, of fours."""
    return (
        y * c[0] - z * b[0],
        y * c[1] - z * b[1],
        y * c[2] - z * b[2],
        y * c[3] - z * b[3],
    )


@lane
def _turned(p, a, q, b, r, c):
    """p a + q b + r c, of fours."""
    return (
        p * a[0] + q * b[0] + r * c[0],
        p * a[1] + q * b[1] + r * c[1],
        p * a[2] + q * b[2] + r * c[2],
        p * a[3] + q * b[3] + r * c[3],
    )


@lane
def _add_couplings(fours, j, count, x, y, z, frame, f, at, slots, of_point):
    """What observation j couples to slots of its camera: its frame and its point.

    Args:
        fours, count: of a chunk, and how many of the camera's there are.
        x, y, z, frame: point in the rig, `rotation`.
        f, at: row of the frame in the sums, first four of the camera.
        slots, of_point: of `Sums`, added to.
    """
    r11, r12, r13, r21, r22, r23, r31, r32, r33 = frame
    # Literals would compile the functions once for each of them.
    row0, row1, row2, i = np.int64(0), np.int64(1), np.int64(2), 6 * f
    for s in range(count):
        a, b, c = (
            _four(fours, j, s),
            _four(fours, j, count + s),
            _four(fours, j, 2 * count + s),
        )
        k = at + s
        _add_four(slots, i, k, _cross(y, c, z, b))
        _add_four(slots, i + 1, k, _cross(z, a, x, c))
        _add_four(slots, i + 2, k, _cross(x, b, y, a))
        _add_four(slots, i + 3, k, a)
        _add_four(slots, i + 4, k, b)
        _add_four(slots, i + 5, k, c)
        _add_four(of_point, row0, k, _turned(r11, a, r21, b, r31, c))
        _add_four(of_point, row1, k, _turned(r12, a, r22, b, r32, c))
        _add_four(of_point, row2, k, _turned(r13, a, r23, b, r33, c))


@lane
def rotation(frames, f):
    """Nine numbers of the rotation in a row of [R | t]."""
    return (
        frames[f, 0],
        frames[f, 1],
        frames[f, 2],
        frames[f, 4],
        frames[f, 5],
        frames[f, 6],
        frames[f, 8],
        frames[f, 9],
        frames[f, 10],
    )


@lane
def _add_turn_row(turns, f, a, x, y, z, m0, m1, m2):
    """Row a of M^T H, times M."""
    q0, q1, q2 = _torque(x, y, z, m0, m1, m2)
    u0, u1, u2 = turns[f, a, 0] + q0, turns[f, a, 1] + q1, turns[f, a, 2] + q2
    u3, u4, u5 = turns[f, a, 3] + m0, turns[f, a, 4] + m1, turns[f, a, 5] + m2
    turns[f, a, 0], turns[f, a, 1], turns[f, a, 2] = u0, u1, u2
    turns[f, a, 3], turns[f, a, 4], turns[f, a, 5] = u3, u4, u5


@lane
def times_rotation(m0, m1, m2, frame):
    """Row of H R."""
    r11, r12, r13, r21, r22, r23, r31, r32, r33 = frame
    return (
        m0 * r11 + m1 * r21 + m2 * r31,
        m0 * r12 + m1 * r22 + m2 * r32,
        m0 * r13 + m1 * r23 + m2 * r33,
    )


@lane
def point_sums(frame, a, b, d, g0, g1, g2):
    """R^T H R (lower triangle) and R^T g of a cell, 9 scalars; H R by rows."""
    r11, r12, r13, r21, r22, r23, r31, r32, r33 = frame
    return (
        r11 * a[0] + r21 * b[0] + r31 * d[0],
        r12 * a[0] + r22 * b[0] + r32 * d[0],
        r12 * a[1] + r22 * b[1] + r32 * d[1],
        r13 * a[0] + r23 * b[0] + r33 * d[0],
        r13 * a[1] + r23 * b[1] + r33 * d[1],
        r13 * a[2] + r23 * b[2] + r33 * d[2],
        r11 * g0 + r21 * g1 + r31 * g2,
        r12 * g0 + r22 * g1 + r32 * g2,
        r13 * g0 + r23 * g1 + r33 * g2,
    )


@lane
def plus(s, t):
    """Sum of nine scalars each."""
    return (
        s[0] + t[0],
        s[1] + t[1],
        s[2] + t[2],
        s[3] + t[3],
        s[4] + t[4],
        s[5] + t[5],
        s[6] + t[6],
        s[7] + t[7],
        s[8] + t[8],
    )


@lane
def write_point(p, total, v, grad):
    """V (3, 3) and gradient (3,) of a point from its nine scalars."""
    v00, v10, v11, v20, v21, v22, g0, g1, g2 = total
    v[p, 0, 0], v[p, 0, 1], v[p, 0, 2] = v00, v10, v20
    v[p, 1, 0], v[p, 1, 1], v[p, 1, 2] = v10, v11, v21
    v[p, 2, 0], v[p, 2, 1], v[p, 2, 2] = v20, v21, v22
    grad[p, 0], grad[p, 1], grad[p, 2] = g0, g1, g2


@inner_straight
def expand_cells(cells, first, last, w):
    """W = M^T H R (6, 3) of some cells, from H R and q, into the first of ``w``."""
    for c in range(first, last):
        at = c - first
        x, y, z = cells[c, 3, 0], cells[c, 3, 1], cells[c, 3, 2]
        for b in range(3):
            n0, n1, n2 = cells[c, 0, b], cells[c, 1, b], cells[c, 2, b]
            w[at, 0, b] = y * n2 - z * n1
            w[at, 1, b] = z * n0 - x * n2
            w[at, 2, b] = x * n1 - y * n0
            w[at, 3, b], w[at, 4, b], w[at, 5, b] = n0, n1, n2


@lane
def _add_moves(moves, f, h, q0, q1, q2):
    m0, m1, m2, m3 = moves[f, 0], moves[f, 1], moves[f, 2], moves[f, 3]
    m4, m5, m6, m7 = moves[f, 4], moves[f, 5], moves[f, 6], moves[f, 7]
    m8, m9, m10, m11 = moves[f, 8], moves[f, 9], moves[f, 10], moves[f, 11]
    m0, m1, m2, m3 = m0 + h[0], m1 + h[1], m2 + h[2], m3 + h[3]
    m4, m5, m6, m7 = m4 + h[4], m5 + h[5], m6 + h[6], m7 + h[7]
    m8, m9, m10, m11 = m8 + h[8], m9 + q0, m10 + q1, m11 + q2
    moves[f, 0], moves[f, 1], moves[f, 2], moves[f, 3] = m0, m1, m2, m3
    moves[f, 4], moves[f, 5], moves[f, 6], moves[f, 7] = m4, m5, m6, m7
    moves[f, 8], moves[f, 9], moves[f, 10], moves[f, 11] = m8, m9, m10, m11


@lane
def add_cell(x, y, z, frame, c, f, sums_of_cell, turns, moves, cells):
    """Expand a cell's sums to its frame and to its coupling (H R, and q).

    Args:
        x, y, z: the point in the rig.
        frame: from `rotation`.
        c, f: cell, and row of the frame in the sums.
        sums_of_cell: H (lower triangle) and g by the point in the rig, 9 scalars.
        turns, moves: of `Sums`, added to.
        cells: of `NormalEquations`; the cell is written.

    Returns:
        What its point is given, see `point_sums`.
    """
    h00, h10, h11, h20, h21, h22, g0, g1, g2 = sums_of_cell
    t00, t10, t20 = _torque(x, y, z, h00, h10, h20)
    t01, t11, t21 = _torque(x, y, z, h10, h11, h21)
    t02, t12, t22 = _torque(x, y, z, h20, h21, h22)
    # Literals would compile the function once for each of them.
    row0, row1, row2 = np.int64(0), np.int64(1), np.int64(2)
    _add_turn_row(turns, f, row0, x, y, z, t00, t01, t02)
    _add_turn_row(turns, f, row1, x, y, z, t10, t11, t12)
    _add_turn_row(turns, f, row2, x, y, z, t20, t21, t22)
    q0, q1, q2 = _torque(x, y, z, g0, g1, g2)
    _add_moves(moves, f, sums_of_cell, q0, q1, q2)
    a = times_rotation(h00, h10, h20, frame)
    b = times_rotation(h10, h11, h21, frame)
    d = times_rotation(h20, h21, h22, frame)
    cells[c, 3, 0], cells[c, 3, 1], cells[c, 3, 2] = x, y, z
    for k in range(3):
        cells[c, 0, k], cells[c, 1, k], cells[c, 2, k] = a[k], b[k], d[k]
    return point_sums(frame, a, b, d, g0, g1, g2)


@lane
def sum_rows(rows, first, last):
    """J^T W J by the point in the rig (lower triangle), J^T W r: 9 scalars."""
    h00, h10, h11, h20, h21, h22 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    g0, g1, g2 = 0.0, 0.0, 0.0
    for j in range(first, last):
        h00 += rows[j, 0]
        h10 += rows[j, 1]
        h11 += rows[j, 2]
        h20 += rows[j, 3]
        h21 += rows[j, 4]
        h22 += rows[j, 5]
        g0 += rows[j, GRAD]
        g1 += rows[j, GRAD + 1]
        g2 += rows[j, GRAD + 2]
    return h00, h10, h11, h20, h21, h22, g0, g1, g2


@inner_straight
def assemble(layout, state, first_point, last_point, first, chunk, sums, out):
    """Write the blocks of an evaluated chunk's points, and add its rows to the sums."""
    rows, fours, in_rig, row_of = chunk.rows, chunk.fours, chunk.in_rig, sums.row
    # Named once, out of the loops: each look into a tuple of arrays counts references.
    turns, moves, slots, of_point = sums.turns, sums.moves, sums.slots, sums.of_point
    four_start, poses, camera = sums.four_start, state.frames, layout.camera
    cells, points, grads, border = (
        out.cells,
        out.points,
        out.points_grad,
        out.points_border,
    )
    point_start, cell_start = layout.point_start, layout.cell_start
    cell_frame, column = layout.cell_frame, sums.column
    for p in range(first_point, last_point):
        of_point[:] = 0.0
        total = NOTHING
        for c in range(point_start[p], point_start[p + 1]):
            start, end = cell_start[c] - first, cell_start[c + 1] - first
            frame, f = rotation(poses, cell_frame[c]), row_of[cell_frame[c]]
            x, y, z = in_rig[start, 0], in_rig[start, 1], in_rig[start, 2]
            cell = sum_rows(rows, start, end)
            given = add_cell(x, y, z, frame, c, f, cell, turns, moves, cells)
            total = plus(total, given)
            for j in range(start, end):
                at = four_start[camera[first + j]]
                count = four_start[camera[first + j] + 1] - at
                _add_couplings(fours, j, count, x, y, z, frame, f, at, slots, of_point)
        write_point(p, total, points, grads)
        border[p] = 0.0
        for s in range(len(column)):
            for t in range(4):
                if column[s, t] != HELD:
                    for a in range(3):
                        border[p, a, column[s, t]] += of_point[a, s, t]

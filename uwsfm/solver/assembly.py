"""From rows of Jacobians to normal equations, cell by cell."""

from typing import NamedTuple

import numpy as np

from uwsfm._jit import inner_fused, lane
from uwsfm.geometry.rigid3 import Array
from uwsfm.scene import IndexArray
from uwsfm.solver.chunks import COUPLING, GRAD, width
from uwsfm.solver.layout import Layout


class Sums(NamedTuple):
    """What points share, summed over some of them, which R frames see; W columns for
    each of C cameras, B of them different."""

    seen: IndexArray
    """(R,) the frames, rising."""
    row: IndexArray
    """(F,) where they are in ``seen``."""
    frames: Array
    """U (R, 6, 6)"""
    frames_grad: Array
    """(R, 6)"""
    frames_border: Array
    """(R, B, 6): transposed, so that what is added together lies together."""
    blocks: Array
    """(C, W, W + 1) of each camera against the residual, then itself."""
    of_point: Array
    """(B, 3) scratch: one point against the cameras."""


def new_sums(layout: Layout, seen: IndexArray) -> Sums:
    """Sums over points that some frames (R,), rising, see."""
    num_cameras, num_border = len(layout.free_start) - 1, layout.num_camera_cols
    w, count = width(layout), len(seen)
    row = np.full(len(layout.frame_col), -1, dtype=np.int64)
    row[seen] = np.arange(count)
    return Sums(
        seen=seen,
        row=row,
        frames=np.zeros((count, 6, 6)),
        frames_grad=np.zeros((count, 6)),
        frames_border=np.zeros((count, num_border, 6)),
        blocks=np.zeros((num_cameras, w, w + 1)),
        of_point=np.zeros((num_border, 3)),
    )


def clear(sums: Sums) -> None:
    """Zero, for other points."""
    for block in (sums.frames, sums.frames_grad, sums.frames_border, sums.blocks):
        block[...] = 0.0


@lane
def _torque(x, y, z, a, b, c):
    """q x m."""
    return y * c - z * b, z * a - x * c, x * b - y * a


@inner_fused
def _add_couplings(rows, j, num_free, x, y, z, frame, f, cols, of_frame, of_point):
    """What observation j couples to columns of its camera: its frame and its point."""
    r11, r12, r13, r21, r22, r23, r31, r32, r33 = frame
    for s in range(num_free):
        at, col = COUPLING + 3 * s, cols[s]
        c0, c1, c2 = rows[j, at], rows[j, at + 1], rows[j, at + 2]
        t0, t1, t2 = _torque(x, y, z, c0, c1, c2)
        of_frame[f, col, 0] += t0
        of_frame[f, col, 1] += t1
        of_frame[f, col, 2] += t2
        of_frame[f, col, 3] += c0
        of_frame[f, col, 4] += c1
        of_frame[f, col, 5] += c2
        of_point[col, 0] += r11 * c0 + r21 * c1 + r31 * c2
        of_point[col, 1] += r12 * c0 + r22 * c1 + r32 * c2
        of_point[col, 2] += r13 * c0 + r23 * c1 + r33 * c2


@inner_fused
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


@inner_fused
def _add_pose_row(a, x, y, z, m0, m1, m2, f, frames):
    """Row a of M^T H, times M."""
    q0, q1, q2 = _torque(x, y, z, m0, m1, m2)
    frames[f, a, 0] += q0
    frames[f, a, 1] += q1
    frames[f, a, 2] += q2
    frames[f, a, 3] += m0
    frames[f, a, 4] += m1
    frames[f, a, 5] += m2


@lane
def times_rotation(m0, m1, m2, frame):
    """Row of H R."""
    r11, r12, r13, r21, r22, r23, r31, r32, r33 = frame
    return (
        m0 * r11 + m1 * r21 + m2 * r31,
        m0 * r12 + m1 * r22 + m2 * r32,
        m0 * r13 + m1 * r23 + m2 * r33,
    )


@inner_fused
def add_to_point(p, frame, a, b, d, g0, g1, g2, grad, v):
    """R^T H R and R^T g of a cell, to those of its point; H R by rows."""
    r11, r12, r13, r21, r22, r23, r31, r32, r33 = frame
    grad[p, 0] += r11 * g0 + r21 * g1 + r31 * g2
    grad[p, 1] += r12 * g0 + r22 * g1 + r32 * g2
    grad[p, 2] += r13 * g0 + r23 * g1 + r33 * g2
    for k in range(3):
        v[p, 0, k] += r11 * a[k] + r21 * b[k] + r31 * d[k]
        v[p, 1, k] += r12 * a[k] + r22 * b[k] + r32 * d[k]
        v[p, 2, k] += r13 * a[k] + r23 * b[k] + r33 * d[k]


@inner_fused
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


@inner_fused
def add_cell(
    x, y, z, frame, p, c, f, sums_of_cell, frames, frames_grad, cells, grad, v
):
    """Expand a cell's sums to its frame, its point and their coupling (H R, and q).

    Args:
        x, y, z: the point in the rig.
        frame: from `rotation`.
        p, c, f: point, cell, and row of the frame in the sums.
        sums_of_cell: H (lower triangle) and g by the point in the rig, 9 scalars.
        frames, frames_grad: of `Sums`, added to.
        cells, grad, v: of `NormalEquations`; the cell is written.
    """
    h00, h10, h11, h20, h21, h22, g0, g1, g2 = sums_of_cell
    t00, t10, t20 = _torque(x, y, z, h00, h10, h20)
    t01, t11, t21 = _torque(x, y, z, h10, h11, h21)
    t02, t12, t22 = _torque(x, y, z, h20, h21, h22)
    # Literals would compile the function once for each of them.
    row0, row1, row2 = np.int64(0), np.int64(1), np.int64(2)
    row3, row4, row5 = np.int64(3), np.int64(4), np.int64(5)
    _add_pose_row(row0, x, y, z, t00, t01, t02, f, frames)
    _add_pose_row(row1, x, y, z, t10, t11, t12, f, frames)
    _add_pose_row(row2, x, y, z, t20, t21, t22, f, frames)
    _add_pose_row(row3, x, y, z, h00, h10, h20, f, frames)
    _add_pose_row(row4, x, y, z, h10, h11, h21, f, frames)
    _add_pose_row(row5, x, y, z, h20, h21, h22, f, frames)
    a = times_rotation(h00, h10, h20, frame)
    b = times_rotation(h10, h11, h21, frame)
    d = times_rotation(h20, h21, h22, frame)
    cells[c, 3, 0], cells[c, 3, 1], cells[c, 3, 2] = x, y, z
    q0, q1, q2 = _torque(x, y, z, g0, g1, g2)
    frames_grad[f, 0] += q0
    frames_grad[f, 1] += q1
    frames_grad[f, 2] += q2
    frames_grad[f, 3] += g0
    frames_grad[f, 4] += g1
    frames_grad[f, 5] += g2
    for k in range(3):
        cells[c, 0, k], cells[c, 1, k], cells[c, 2, k] = a[k], b[k], d[k]
    add_to_point(p, frame, a, b, d, g0, g1, g2, grad, v)


@inner_fused
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


@inner_fused
def assemble(layout, state, first_point, last_point, first, chunk, sums, out):
    """Write the blocks of an evaluated chunk's points, and add its rows to the sums."""
    rows, in_rig, row_of = chunk.rows, chunk.in_rig, sums.row
    # Named once, out of the loops: each look into a tuple of arrays counts references.
    frames, frames_grad, of_frame = sums.frames, sums.frames_grad, sums.frames_border
    of_point, poses, camera = sums.of_point, state.frames, layout.camera
    cells, grads, v, border = out.cells, out.points_grad, out.points, out.points_border
    point_start, cell_start = layout.point_start, layout.cell_start
    cell_frame, free_start = layout.cell_frame, layout.free_start
    free_col, num_border = layout.free_col, len(of_point)
    for p in range(first_point, last_point):
        for a in range(3):
            for k in range(num_border):
                of_point[k, a] = 0.0
            grads[p, a], v[p, a, 0], v[p, a, 1], v[p, a, 2] = 0.0, 0.0, 0.0, 0.0
        for c in range(point_start[p], point_start[p + 1]):
            start, end = cell_start[c] - first, cell_start[c + 1] - first
            frame, f = rotation(poses, cell_frame[c]), row_of[cell_frame[c]]
            x, y, z = in_rig[start, 0], in_rig[start, 1], in_rig[start, 2]
            total = sum_rows(rows, start, end)
            add_cell(
                x, y, z, frame, p, c, f, total, frames, frames_grad, cells, grads, v
            )
            for j in range(start, end):
                at = free_start[camera[first + j]]
                num_free = free_start[camera[first + j] + 1] - at
                cols = free_col[at:]
                _add_couplings(
                    rows, j, num_free, x, y, z, frame, f, cols, of_frame, of_point
                )
        for a in range(3):
            for k in range(num_border):
                border[p, a, k] = of_point[k, a]
            for k in range(num_border, border.shape[2]):
                border[p, a, k] = 0.0

"""Normal equations of the bundle adjustment, and the elimination of the points.

Per cell (one point in one frame) only H = sum J^T J (3x3) by the point in the rig, its
gradient and its coupling to the border are summed over the cameras. With q the point in
the rig, the pose enters by M = [-[q]x, I] and the point by the frame's rotation R:

    U += M^T H M,   W = M^T H R,   V += R^T H R

The reduced system is dense: all frames, then the border (rig, ports, lenses).
"""

from typing import NamedTuple

import numpy as np

from uwsfm._jit import kernel
from uwsfm.geometry.rigid3 import Array
from uwsfm.models.projection import JAC_SIZE
from uwsfm.residuals.border import BORDER_SIZE
from uwsfm.residuals.reprojection import point_in_rig, residual
from uwsfm.solver.cells import (
    add_point_3d,
    add_reprojection,
    add_virtual_camera,
    cell_cost,
    scatter_blocks,
)
from uwsfm.solver.error_models import POINT_3D, REPROJECTION
from uwsfm.solver.layout import Layout

MIN_DIAGONAL = 1e-6


class NormalEquations(NamedTuple):
    """Blocks of J^T W J and of the gradient J^T W r (K cells, B border columns)."""

    points: Array
    """V (P, 3, 3)"""
    points_grad: Array
    """(P, 3)"""
    points_border: Array
    """E (P, 3, B)"""
    cells: Array
    """W (K, 6, 3): frame against point."""
    frames: Array
    """U (F, 6, 6)"""
    frames_grad: Array
    """(F, 6)"""
    frames_border: Array
    """(F, 6, B)"""
    border: Array
    """(B, B)"""
    border_grad: Array
    """(B,)"""


def empty_normal_equations(layout: Layout) -> NormalEquations:
    """Zeroed blocks of the sizes of a layout."""
    num_points, num_frames = len(layout.point_start) - 1, len(layout.frame_col)
    num_border = layout.num_border_cols
    return NormalEquations(
        points=np.zeros((num_points, 3, 3)),
        points_grad=np.zeros((num_points, 3)),
        points_border=np.zeros((num_points, 3, num_border)),
        cells=np.zeros((len(layout.cell_frame), 6, 3)),
        frames=np.zeros((num_frames, 6, 6)),
        frames_grad=np.zeros((num_frames, 6)),
        frames_border=np.zeros((num_frames, 6, num_border)),
        border=np.zeros((num_border, num_border)),
        border_grad=np.zeros(num_border),
    )


@kernel
def _pose_times(x, y, z, mat, col):
    """M^T times a column of a (3, .) matrix: torque q x m, then m."""
    a, b, c = mat[0, col], mat[1, col], mat[2, col]
    return y * c - z * b, z * a - x * c, x * b - y * a, a, b, c


@kernel
def _expand_cell(x, y, z, frame, p, c, f, work, out):
    """Expand a cell's sums to its frame, its point and their couplings."""
    hess, grad, couple = work.hess, work.grad, work.couple
    pose_hess = np.empty((6, 3))  # M^T H
    for b in range(3):
        m0, m1, m2, m3, m4, m5 = _pose_times(x, y, z, hess, b)
        pose_hess[0, b], pose_hess[1, b], pose_hess[2, b] = m0, m1, m2
        pose_hess[3, b], pose_hess[4, b], pose_hess[5, b] = m3, m4, m5
    for a in range(6):
        h0, h1, h2 = pose_hess[a, 0], pose_hess[a, 1], pose_hess[a, 2]
        out.frames[f, a, 0] += y * h2 - z * h1
        out.frames[f, a, 1] += z * h0 - x * h2
        out.frames[f, a, 2] += x * h1 - y * h0
        out.frames[f, a, 3] += h0
        out.frames[f, a, 4] += h1
        out.frames[f, a, 5] += h2
        for b in range(3):
            out.cells[c, a, b] = h0 * frame[b] + h1 * frame[4 + b] + h2 * frame[8 + b]
    g = out.frames_grad[f]
    g[0] += y * grad[2] - z * grad[1]
    g[1] += z * grad[0] - x * grad[2]
    g[2] += x * grad[1] - y * grad[0]
    for a in range(3):
        g[3 + a] += grad[a]
        out.points_grad[p, a] += (
            frame[a] * grad[0] + frame[4 + a] * grad[1] + frame[8 + a] * grad[2]
        )
        for b in range(3):
            # R^T H R = R^T (lower half of M^T H R)
            out.points[p, a, b] += (
                frame[a] * out.cells[c, 3, b]
                + frame[4 + a] * out.cells[c, 4, b]
                + frame[8 + a] * out.cells[c, 5, b]
            )
    for k in range(couple.shape[1]):
        m0, m1, m2, m3, m4, m5 = _pose_times(x, y, z, couple, k)
        column = out.frames_border[f]
        column[0, k] += m0
        column[1, k] += m1
        column[2, k] += m2
        column[3, k] += m3
        column[4, k] += m4
        column[5, k] += m5
        for a in range(3):
            out.points_border[p, a, k] += (
                frame[a] * m3 + frame[4 + a] * m4 + frame[8 + a] * m5
            )


class Work(NamedTuple):
    """Scratch of `linearize`: sums of a cell, of a camera, Jacobians of a row."""

    hess: Array
    """(3, 3), lower triangle."""
    grad: Array
    couple: Array
    blocks: Array
    """(C, BORDER_SIZE, BORDER_SIZE), lower triangles of what is free."""
    block_grads: Array
    free: Array
    j_port: Array
    j_rig: Array
    j_border: Array
    j_cell: Array


@kernel
def _work(num_border, num_cameras, largest_cell):
    return Work(
        np.empty((3, 3)),
        np.empty(3),
        np.empty((3, num_border)),
        np.zeros((num_cameras, BORDER_SIZE, BORDER_SIZE)),
        np.zeros((num_cameras, BORDER_SIZE)),
        np.empty((2, BORDER_SIZE)),
        np.empty((2, JAC_SIZE)),
        np.zeros((4, 3)),  # a virtual camera's error has three rows and one of zeros
        np.zeros((4, BORDER_SIZE)),
        np.zeros((largest_cell, 3, BORDER_SIZE)),
    )


@kernel
def linearize(layout, state, error, loss, scale, out):
    """Fill zeroed `NormalEquations` at a state, with weights rho'(s)."""
    # A camera may have matched two features of an image to one point.
    largest_cell = np.diff(layout.cell_start).max()
    work = _work(len(out.border_grad), len(state.cams), largest_cell)
    for p in range(len(layout.point_start) - 1):
        for c in range(layout.point_start[p], layout.point_start[p + 1]):
            f = layout.cell_frame[c]
            x, y, z = point_in_rig(state.frames[f], state.points[p])
            work.hess[:], work.grad[:], work.couple[:] = 0.0, 0.0, 0.0
            if error.code == REPROJECTION:
                add_reprojection(layout, state, c, x, y, z, loss, scale, work)
            elif error.code == POINT_3D:
                add_point_3d(layout, state, error, c, x, y, z, loss, scale, work, out)
            else:
                add_virtual_camera(layout, state, error, c, x, y, z, loss, scale, work)
            work.hess[0, 1], work.hess[0, 2] = work.hess[1, 0], work.hess[2, 0]
            work.hess[1, 2] = work.hess[2, 1]
            _expand_cell(x, y, z, state.frames[f], p, c, f, work, out)
    scatter_blocks(layout, work, out)


@kernel
def total_cost(layout, state, error, loss, scale):
    """(Robust cost 0.5 sum rho(|e|^2) in pixels squared, number of valid errors)."""
    cost, valid = 0.0, 0
    for p in range(len(layout.point_start) - 1):
        for c in range(layout.point_start[p], layout.point_start[p + 1]):
            x, y, z = point_in_rig(state.frames[layout.cell_frame[c]], state.points[p])
            part, count = cell_cost(layout, state, error, c, x, y, z, loss, scale)
            cost += part
            valid += count
    return cost, valid


@kernel
def squared_errors(layout, state, squares):
    """Squared reprojection errors (N,) in sorted order, px^2; NaN where invalid."""
    for p in range(len(layout.point_start) - 1):
        for c in range(layout.point_start[p], layout.point_start[p + 1]):
            x, y, z = point_in_rig(state.frames[layout.cell_frame[c]], state.points[p])
            for i in range(layout.cell_start[c], layout.cell_start[c + 1]):
                k = layout.camera[i]
                _, rx, ry = residual(
                    x,
                    y,
                    z,
                    layout.xy[i],
                    state.cams[k],
                    state.lenses[k],
                    state.ports[k],
                )
                squares[i] = rx * rx + ry * ry

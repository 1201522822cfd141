"""Normal equations of the bundle adjustment, and the elimination of the points.

Per cell (one point in one frame) only H = sum J^T J (3x3) by the point in the rig, its
gradient and its coupling to the border are summed over the cameras. With q the point in
the rig, the pose enters by M = [-[q]x, I] and the point by the frame's rotation R:

    U += M^T H M,   W = M^T H R,   V += R^T H R

The reduced system is dense: all frames, then the border (rig, ports, index).
"""

import math
from typing import NamedTuple

import numpy as np

from uwsfm._jit import kernel
from uwsfm.geometry.rigid3 import Array
from uwsfm.models.status import VALID
from uwsfm.residuals.reprojection import (
    BORDER_SIZE,
    point_in_rig,
    residual,
    residual_with_jac,
)
from uwsfm.solver.layout import HELD, Layout
from uwsfm.solver.losses import INVALID_PX, rho

MIN_DIAGONAL = 1e-6


class KernelState(NamedTuple):
    """The values of all parameters, as rows that kernels read."""

    frames: Array
    """(F, 12) rig_from_world as [R | t]."""
    cams: Array
    """(C, 12) cam_from_rig as [R | t]."""
    arms: Array
    """(C, 9) derivative of the translation by direction (2) and length (1)."""
    lenses: Array
    """(C, LENS_SIZE)"""
    ports: Array
    """(C, PORT_SIZE)"""
    points: Array
    """(P, 3)"""


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
def total_cost(layout, state, loss, scale, squares):
    """Robust cost 0.5 sum rho(|r|^2), and how many observations are invalid.

    Args:
        layout, state: the problem.
        loss, scale: see `losses.rho`.
        squares: (N,) written: squared residuals in sorted order, NaN if invalid.

    Returns:
        (cost, number of invalid observations).
    """
    cost, invalid = 0.0, 0
    price, _ = rho(INVALID_PX * INVALID_PX, loss, scale)
    for p in range(len(layout.point_start) - 1):
        point = state.points[p]
        for c in range(layout.point_start[p], layout.point_start[p + 1]):
            x, y, z = point_in_rig(state.frames[layout.cell_frame[c]], point)
            for i in range(layout.cell_start[c], layout.cell_start[c + 1]):
                cam = layout.camera[i]
                status, rx, ry = residual(
                    x,
                    y,
                    z,
                    layout.xy[i],
                    state.cams[cam],
                    state.lenses[cam],
                    state.ports[cam],
                )
                if status == VALID:
                    squares[i] = rx * rx + ry * ry
                    value, _ = rho(squares[i], loss, scale)
                    cost += 0.5 * value
                else:
                    squares[i] = math.nan
                    invalid += 1
                    cost += 0.5 * price
    return cost, invalid


@kernel
def linearized_residual(layout, state, i, x, y, z, j_port, j_rig, j_border):
    """`residual_with_jac` of sorted observation i, at a point (x, y, z) in the rig."""
    camera = layout.camera[i]
    return residual_with_jac(
        x,
        y,
        z,
        layout.xy[i],
        state.cams[camera],
        state.arms[camera],
        state.lenses[camera],
        state.ports[camera],
        j_port,
        j_rig,
        j_border,
    )


@kernel
def _add_observation(j_rig, j_border, cols, rx, ry, weight, hess, grad, couple, out):
    """Add one weighted observation to its cell's sums and to the border blocks."""
    for a in range(3):
        ja0, ja1 = weight * j_rig[0, a], weight * j_rig[1, a]
        grad[a] += ja0 * rx + ja1 * ry
        for b in range(3):
            hess[a, b] += ja0 * j_rig[0, b] + ja1 * j_rig[1, b]
        for k in range(BORDER_SIZE):
            if cols[k] != HELD:
                couple[a, cols[k]] += ja0 * j_border[0, k] + ja1 * j_border[1, k]
    for k in range(BORDER_SIZE):
        if cols[k] != HELD:
            jk0, jk1 = weight * j_border[0, k], weight * j_border[1, k]
            out.border_grad[cols[k]] += jk0 * rx + jk1 * ry
            for m in range(BORDER_SIZE):
                if cols[m] != HELD:
                    out.border[cols[k], cols[m]] += (
                        jk0 * j_border[0, m] + jk1 * j_border[1, m]
                    )


@kernel
def _pose_times(x, y, z, mat, col):
    """M^T times a column of a (3, .) matrix: torque q x m, then m."""
    a, b, c = mat[0, col], mat[1, col], mat[2, col]
    return y * c - z * b, z * a - x * c, x * b - y * a, a, b, c


@kernel
def _expand_cell(x, y, z, frame, p, c, f, hess, grad, couple, out):
    """Expand a cell's sums to its frame, its point and their couplings."""
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


@kernel
def linearize(layout, state, loss, scale, out):
    """Fill zeroed `NormalEquations` at a state, with weights rho'(s)."""
    hess, grad = np.empty((3, 3)), np.empty(3)
    couple = np.empty((3, len(out.border_grad)))
    j_port, j_rig = np.empty((2, 9)), np.empty((2, 3))
    j_border = np.empty((2, BORDER_SIZE))
    for p in range(len(layout.point_start) - 1):
        point = state.points[p]
        for c in range(layout.point_start[p], layout.point_start[p + 1]):
            f = layout.cell_frame[c]
            x, y, z = point_in_rig(state.frames[f], point)
            hess[:], grad[:], couple[:] = 0.0, 0.0, 0.0
            for i in range(layout.cell_start[c], layout.cell_start[c + 1]):
                k = layout.camera[i]
                status, rx, ry = linearized_residual(
                    layout, state, i, x, y, z, j_port, j_rig, j_border
                )
                if status == VALID:
                    _, weight = rho(rx * rx + ry * ry, loss, scale)
                    cols = layout.border_col[k]
                    _add_observation(
                        j_rig, j_border, cols, rx, ry, weight, hess, grad, couple, out
                    )
            _expand_cell(x, y, z, state.frames[f], p, c, f, hess, grad, couple, out)

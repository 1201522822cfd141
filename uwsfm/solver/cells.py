"""Sums over a cell, one point in one frame: its cost, and its normal equations.

One function per error. Each adds J^T W J by the point in the rig (``hess``, ``grad``),
its coupling to the border (``couple``), and the border's own blocks.
"""

import numpy as np

from uwsfm._base.jit import inner
from uwsfm.models.status import VALID
from uwsfm.residuals import point_3d, reprojection, virtual_camera
from uwsfm.solver.error_models import (
    POINT_3D,
    VIRTUAL_CAMERA_TANGENTIAL,
)
from uwsfm.solver.losses import INVALID_PX, rho


@inner
def cell_cost(layout, state, error, c, x, y, z, loss, scale):
    """(cost, number of valid errors) of a cell whose point is at (x, y, z) in the rig.

    The cost is 0.5 sum rho(|e|^2), in pixels squared.
    """
    first, last = layout.cell_start[c], layout.cell_start[c + 1]
    price, _ = rho(INVALID_PX * INVALID_PX, loss, scale)
    if error.code == POINT_3D:
        status, ex, ey, ez = point_3d.residual(
            x, y, z, error.dirs, layout.camera, first, last, state.cams, state.ports
        )
        if status != VALID:
            return 0.5 * price, 0
        square = error.unit * error.unit * (ex * ex + ey * ey + ez * ez)
        value, _ = rho(square, loss, scale)
        return 0.5 * value, 1
    cost, valid = 0.0, 0
    sheet = error.code == VIRTUAL_CAMERA_TANGENTIAL
    for i in range(first, last):
        k = layout.camera[i]
        status, ex, ey, ez = virtual_camera.residual(
            x, y, z, error.dirs[i], state.cams[k], state.ports[k], sheet
        )
        square = error.unit * error.unit * (ex * ex + ey * ey + ez * ez)
        value = price
        if status == VALID:
            value, _ = rho(square, loss, scale)
            valid += 1
        cost += 0.5 * value
    return cost, valid


@inner
def linearized_residual(layout, state, i, x, y, z, j_port, j_rig, j_border):
    """Reprojection error of sorted observation i, at a point (x, y, z) in the rig."""
    k = layout.camera[i]
    return reprojection.residual_with_jac(
        x,
        y,
        z,
        layout.xy[i],
        state.cams[k],
        state.arms[k],
        state.lenses[k],
        state.ports[k],
        layout.free_lens,
        j_port,
        j_rig,
        j_border,
    )


@inner
def _add_rows(layout, camera, row, rx, ry, weight, work):
    """Add two weighted rows of one camera to its cell's sums and to its own block."""
    start = layout.free_start[camera]
    num_free = layout.free_start[camera + 1] - start
    block, grad = work.blocks[camera], work.block_grads[camera]
    free = work.free
    for s in range(num_free):
        k = layout.free_slot[start + s]
        b0, b1 = work.j_border[row, k], work.j_border[row + 1, k]
        free[0, s], free[1, s] = weight * b0, weight * b1
        grad[s] += weight * (b0 * rx + b1 * ry)
        for t in range(s + 1):
            block[s, t] += b0 * free[0, t] + b1 * free[1, t]
    for a in range(3):
        a0, a1 = work.j_rig[row, a], work.j_rig[row + 1, a]
        work.grad[a] += weight * (a0 * rx + a1 * ry)
        for b in range(a + 1):
            work.hess[a, b] += weight * (
                a0 * work.j_rig[row, b] + a1 * work.j_rig[row + 1, b]
            )
        for s in range(num_free):
            work.couple[a, layout.free_col[start + s]] += (
                a0 * free[0, s] + a1 * free[1, s]
            )


@inner
def scatter_blocks(layout, work, out):
    """Add the cameras' own blocks to the border, where they may share columns."""
    for camera in range(len(work.blocks)):
        start = layout.free_start[camera]
        for s in range(layout.free_start[camera + 1] - start):
            col = layout.free_col[start + s]
            out.border_grad[col] += work.block_grads[camera, s]
            for t in range(s + 1):
                other = layout.free_col[start + t]
                out.border[col, other] += work.blocks[camera, s, t]
                if t < s:
                    out.border[other, col] += work.blocks[camera, s, t]


@inner
def add_virtual_camera(layout, state, error, c, x, y, z, loss, scale, work):
    """Virtual-camera errors of a cell: three rows each, and one of zeros."""
    unit2 = error.unit * error.unit
    sheet = error.code == VIRTUAL_CAMERA_TANGENTIAL
    for i in range(layout.cell_start[c], layout.cell_start[c + 1]):
        k = layout.camera[i]
        status, ex, ey, ez = virtual_camera.residual_with_jac(
            x,
            y,
            z,
            error.dirs[i],
            state.cams[k],
            state.arms[k],
            state.ports[k],
            sheet,
            work.j_rig,
            work.j_border,
        )
        if status != VALID:
            continue
        _, weight = rho(unit2 * (ex * ex + ey * ey + ez * ez), loss, scale)
        _add_rows(layout, k, 0, ex, ey, weight * unit2, work)
        _add_rows(layout, k, 2, ez, 0.0, weight * unit2, work)


@inner
def add_point_3d(layout, state, error, c, x, y, z, loss, scale, work, out):
    """The 3-D point error of a cell: J by the point in the rig is -I."""
    first, last = layout.cell_start[c], layout.cell_start[c + 1]
    status, ex, ey, ez = point_3d.residual_with_jac(
        x,
        y,
        z,
        error.dirs,
        layout.camera,
        first,
        last,
        state.cams,
        state.arms,
        state.ports,
        work.j_cell,
    )
    if status != VALID:
        return
    unit2 = error.unit * error.unit
    _, weight = rho(unit2 * (ex * ex + ey * ey + ez * ez), loss, scale)
    weight *= unit2
    residual = (ex, ey, ez)
    rows = np.zeros_like(work.couple)
    for i in range(first, last):
        k = layout.camera[i]
        for s in range(layout.free_start[k], layout.free_start[k + 1]):
            slot = layout.free_slot[s]
            for a in range(3):
                rows[a, layout.border_col[k, slot]] += work.j_cell[i - first, a, slot]
    for a in range(3):
        work.hess[a, a] += weight
        work.grad[a] -= weight * residual[a]
        for m in range(rows.shape[1]):
            wj = weight * rows[a, m]
            work.couple[a, m] -= wj
            out.border_grad[m] += wj * residual[a]
            for n in range(rows.shape[1]):
                out.border[m, n] += wj * rows[a, n]

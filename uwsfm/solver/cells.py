"""Sums over a cell, one point in one frame: its cost, and its normal equations.

One function per error. Each adds J^T W J by the point in the rig (``hess``, ``grad``),
its coupling to the border (``couple``), and the border's own blocks.
"""

import numpy as np

from uwsfm._jit import kernel
from uwsfm.models.status import VALID
from uwsfm.residuals import point_3d, reprojection, virtual_camera
from uwsfm.solver.error_models import (
    POINT_3D,
    REPROJECTION,
    VIRTUAL_CAMERA_TANGENTIAL,
)
from uwsfm.solver.losses import INVALID_PX, rho


@kernel
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
    for i in range(first, last):
        k = layout.camera[i]
        cam, lens, port = state.cams[k], state.lenses[k], state.ports[k]
        if error.code == REPROJECTION:
            status, ex, ey = reprojection.residual(
                x, y, z, layout.xy[i], cam, lens, port
            )
            square = ex * ex + ey * ey
        else:
            sheet = error.code == VIRTUAL_CAMERA_TANGENTIAL
            status, ex, ey, ez = virtual_camera.residual(
                x, y, z, error.dirs[i], cam, port, sheet
            )
            square = error.unit * error.unit * (ex * ex + ey * ey + ez * ez)
        value = price
        if status == VALID:
            value, _ = rho(square, loss, scale)
            valid += 1
        cost += 0.5 * value
    return cost, valid


@kernel
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


@kernel
def _add_rows(layout, camera, j_rig, j_border, rx, ry, weight, hess, grad, couple, out):
    """Add two weighted rows of one camera to its cell's sums and to the border."""
    start, stop = layout.free_start[camera], layout.free_start[camera + 1]
    cols = layout.border_col[camera]
    for a in range(3):
        ja0, ja1 = weight * j_rig[0, a], weight * j_rig[1, a]
        grad[a] += ja0 * rx + ja1 * ry
        for b in range(3):
            hess[a, b] += ja0 * j_rig[0, b] + ja1 * j_rig[1, b]
        for s in range(start, stop):
            k = layout.free_slot[s]
            couple[a, cols[k]] += ja0 * j_border[0, k] + ja1 * j_border[1, k]
    for s in range(start, stop):
        k = layout.free_slot[s]
        jk0, jk1 = weight * j_border[0, k], weight * j_border[1, k]
        out.border_grad[cols[k]] += jk0 * rx + jk1 * ry
        for t in range(start, stop):
            m = layout.free_slot[t]
            out.border[cols[k], cols[m]] += jk0 * j_border[0, m] + jk1 * j_border[1, m]


@kernel
def add_reprojection(layout, state, c, x, y, z, loss, scale, work, out):
    """Reprojection errors of a cell."""
    for i in range(layout.cell_start[c], layout.cell_start[c + 1]):
        status, rx, ry = linearized_residual(
            layout, state, i, x, y, z, work.j_port, work.j_rig, work.j_border
        )
        if status == VALID:
            _, weight = rho(rx * rx + ry * ry, loss, scale)
            _add_rows(
                layout,
                layout.camera[i],
                work.j_rig,
                work.j_border,
                rx,
                ry,
                weight,
                work.hess,
                work.grad,
                work.couple,
                out,
            )


@kernel
def add_virtual_camera(layout, state, error, c, x, y, z, loss, scale, work, out):
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
        for row, first, second in ((0, ex, ey), (2, ez, 0.0)):
            _add_rows(
                layout,
                k,
                work.j_rig[row:],
                work.j_border[row:],
                first,
                second,
                weight * unit2,
                work.hess,
                work.grad,
                work.couple,
                out,
            )


@kernel
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

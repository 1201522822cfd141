"""The package's scalar kernels, one point after the other: what lanes are against."""

import numpy as np

from uwsfm._base.jit import kernel
from uwsfm.models.projection import JAC_SIZE, project, project_with_jac, unproject
from uwsfm.models.status import VALID
from uwsfm.residuals.border import BORDER_SIZE
from uwsfm.residuals.reprojection import point_in_rig, residual, residual_with_jac


@kernel
def unproject_loop(xy, lens, port, rays, status):
    for i in range(len(xy)):
        code, ox, oy, oz, wx, wy, wz = unproject(xy[i, 0], xy[i, 1], lens, port)
        status[i] = code
        rays[i, 0], rays[i, 1], rays[i, 2] = ox, oy, oz
        rays[i, 3], rays[i, 4], rays[i, 5] = wx, wy, wz


@kernel
def project_loop(points, lens, port, xy, status):
    for i in range(len(points)):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        status[i], xy[i, 0], xy[i, 1] = project(x, y, z, lens, port)


@kernel
def project_with_jac_loop(points, lens, port, xy, jac, status):
    for i in range(len(points)):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        status[i], xy[i, 0], xy[i, 1] = project_with_jac(x, y, z, lens, port, jac[i])


@kernel
def cost_loop(layout, state):
    """0.5 sum |residual|^2 of a layout, px^2."""
    cost = 0.0
    for p in range(len(layout.point_start) - 1):
        for c in range(layout.point_start[p], layout.point_start[p + 1]):
            x, y, z = point_in_rig(state.frames[layout.cell_frame[c]], state.points[p])
            for i in range(layout.cell_start[c], layout.cell_start[c + 1]):
                k = layout.camera[i]
                status, rx, ry = residual(
                    x,
                    y,
                    z,
                    layout.xy[i],
                    state.cams[k],
                    state.lenses[k],
                    state.ports[k],
                )
                if status == VALID:
                    cost += 0.5 * (rx * rx + ry * ry)
    return cost


@kernel
def jacobian_loop(layout, state):
    """Residuals and Jacobians of a layout, without the sums of normal equations."""
    j_port = np.empty((2, JAC_SIZE))
    j_rig, j_border = np.empty((2, 3)), np.empty((2, BORDER_SIZE))
    total = 0.0
    for p in range(len(layout.point_start) - 1):
        for c in range(layout.point_start[p], layout.point_start[p + 1]):
            x, y, z = point_in_rig(state.frames[layout.cell_frame[c]], state.points[p])
            for i in range(layout.cell_start[c], layout.cell_start[c + 1]):
                k = layout.camera[i]
                cam, lens, port = state.cams[k], state.lenses[k], state.ports[k]
                arm, free_lens = state.arms[k], False
                status, rx, ry = residual_with_jac(
                    *(x, y, z, layout.xy[i], cam, arm, lens, port),
                    *(free_lens, j_port, j_rig, j_border),
                )
                if status == VALID:
                    total += rx * j_rig[0, 0] + ry * j_border[1, 8]
    return total

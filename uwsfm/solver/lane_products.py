"""Products of weighted Jacobians over lanes: what a cell and a camera sum up.

Beside the buffer of `uwsfm.models.lanes`, a second one of the same lanes holds the
weight, then J^T W J and J^T W r by the point in the rig, then its coupling to the
camera's free parameters: the rows of x to all of them, in fours, then those of y and z.
"""

import math
from typing import Final

from numba.extending import register_jitable

from uwsfm._base.jit import inner_fused, lane
from uwsfm.models.lanes import BLOCK, JAC_U, JAC_V, STRIDE
from uwsfm.residuals.reprojection_lanes import RESIDUAL, RIG
from uwsfm.solver.losses import CAUCHY

WEIGHT: Final = 0
CELL: Final = 1
"""H: 00, 10, 11, 20, 21, 22, then g: 0, 1, 2."""
COUPLE: Final = 10
RES_U, RES_V = JAC_U + RESIDUAL, JAC_V + RESIDUAL


@register_jitable
def num_fours(num_columns: int) -> int:
    """That so many columns fill, the last one perhaps not."""
    return -(-num_columns // 4)


@inner_fused
def weigh(count, loss, scale, buffer, products):
    """Weights rho'(s) of the first lanes, 0 of the others and of NaN residuals."""
    inv_c2 = 1.0 / (scale * scale) if loss == CAUCHY else 0.0
    for i in range(BLOCK):
        u, v = buffer[RES_U * STRIDE + i], buffer[RES_V * STRIDE + i]
        square = u * u + v * v
        good = square < math.inf
        products[WEIGHT * STRIDE + i] = 1.0 / (1.0 + square * inv_c2) if good else 0.0
        buffer[RES_U * STRIDE + i] = u if good else 0.0
        buffer[RES_V * STRIDE + i] = v if good else 0.0
    for i in range(count, BLOCK):
        products[WEIGHT * STRIDE + i] = 0.0


@inner_fused
def multiply_cells(buffer, products):
    """Rows of CELL."""
    u, v = (JAC_U + RIG) * STRIDE, (JAC_V + RIG) * STRIDE
    for i in range(BLOCK):
        w = products[WEIGHT * STRIDE + i]
        ru, rv = buffer[RES_U * STRIDE + i], buffer[RES_V * STRIDE + i]
        u0, u1, u2 = buffer[u + i], buffer[u + STRIDE + i], buffer[u + 2 * STRIDE + i]
        v0, v1, v2 = buffer[v + i], buffer[v + STRIDE + i], buffer[v + 2 * STRIDE + i]
        a0, a1, a2, b0, b1, b2 = w * u0, w * u1, w * u2, w * v0, w * v1, w * v2
        products[CELL * STRIDE + i] = a0 * u0 + b0 * v0
        products[(CELL + 1) * STRIDE + i] = a1 * u0 + b1 * v0
        products[(CELL + 2) * STRIDE + i] = a1 * u1 + b1 * v1
        products[(CELL + 3) * STRIDE + i] = a2 * u0 + b2 * v0
        products[(CELL + 4) * STRIDE + i] = a2 * u1 + b2 * v1
        products[(CELL + 5) * STRIDE + i] = a2 * u2 + b2 * v2
        products[(CELL + 6) * STRIDE + i] = a0 * ru + b0 * rv
        products[(CELL + 7) * STRIDE + i] = a1 * ru + b1 * rv
        products[(CELL + 8) * STRIDE + i] = a2 * ru + b2 * rv


# Rows of a number known at run time only are sliced: with the number in the index,
# numba's check for negative ones would keep a loop from becoming SIMD.


@lane
def _dots(one, c0, c1, c2, c3, buffer, products):
    """Products of a weighted column of the Jacobian with four others, summed."""
    weight = products[WEIGHT * STRIDE :]
    u, v = buffer[(JAC_U + one) * STRIDE :], buffer[(JAC_V + one) * STRIDE :]
    u0, v0 = buffer[(JAC_U + c0) * STRIDE :], buffer[(JAC_V + c0) * STRIDE :]
    u1, v1 = buffer[(JAC_U + c1) * STRIDE :], buffer[(JAC_V + c1) * STRIDE :]
    u2, v2 = buffer[(JAC_U + c2) * STRIDE :], buffer[(JAC_V + c2) * STRIDE :]
    u3, v3 = buffer[(JAC_U + c3) * STRIDE :], buffer[(JAC_V + c3) * STRIDE :]
    s0, s1, s2, s3 = 0.0, 0.0, 0.0, 0.0
    for i in range(BLOCK):
        a, b = weight[i] * u[i], weight[i] * v[i]
        s0 += a * u0[i] + b * v0[i]
        s1 += a * u1[i] + b * v1[i]
        s2 += a * u2[i] + b * v2[i]
        s3 += a * u3[i] + b * v3[i]
    return s0, s1, s2, s3


@lane
def _couple(column, row, fours, buffer, products):
    """Three rows, ``fours`` apart: products of a weighted column with the point's."""
    u, v = buffer[(JAC_U + column) * STRIDE :], buffer[(JAC_V + column) * STRIDE :]
    rig_u, rig_v = (JAC_U + RIG) * STRIDE, (JAC_V + RIG) * STRIDE
    weight, out = products[WEIGHT * STRIDE :], products[row * STRIDE :]
    second, third = out[fours * STRIDE :], out[2 * fours * STRIDE :]
    for i in range(BLOCK):
        a, b = weight[i] * u[i], weight[i] * v[i]
        c0 = a * buffer[rig_u + i] + b * buffer[rig_v + i]
        c1 = a * buffer[rig_u + STRIDE + i] + b * buffer[rig_v + STRIDE + i]
        c2 = a * buffer[rig_u + 2 * STRIDE + i] + b * buffer[rig_v + 2 * STRIDE + i]
        out[i] = c0
        second[i] = c1
        third[i] = c2


@inner_fused
def multiply_camera(columns, num_free, sums, buffer, products):
    """Rows of COUPLE, and the sums over lanes of a camera against itself.

    Args:
        columns: (W + 1,) RESIDUAL, then those of its free parameters.
        num_free: how many these are.
        sums: (W, W + 1) lower triangle, added to.
    """
    last, fours = num_free, 4 * num_fours(num_free)
    for s in range(num_free):
        one = columns[s + 1]
        for t in range(0, s + 2, 4):  # four at a time hide the cost of adding lanes up
            t1, t2, t3 = min(t + 1, last), min(t + 2, last), min(t + 3, last)
            dots = _dots(
                one, columns[t], columns[t1], columns[t2], columns[t3], buffer, products
            )
            for k in range(min(4, s + 2 - t)):
                sums[s, t + k] += dots[k]
        _couple(one, COUPLE + s, fours, buffer, products)
    for s in range(num_free, fours):
        for k in range(3):
            row = (COUPLE + k * fours + s) * STRIDE
            products[row : row + BLOCK] = 0.0

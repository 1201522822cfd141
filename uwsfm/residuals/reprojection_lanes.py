"""Reprojection errors over lanes: see `uwsfm.residuals.reprojection` for the scalars.

A block starts with points in the rig, in the rows X, Y, Z.
"""

from typing import Final

import numpy as np

from uwsfm._base.jit import inner, lane
from uwsfm.models.lanes import (
    BLOCK,
    JAC_U,
    JAC_V,
    STRIDE,
    VX,
    VY,
    VZ,
    X,
    Y,
    Z,
)
from uwsfm.models.lens import jac_by_params
from uwsfm.models.projection import jac_lanes, project_lanes
from uwsfm.models.status import VALID
from uwsfm.residuals.border import BORDER_SIZE, FIRST_LENS
from uwsfm.residuals.reprojection import residual_with_jac

# Columns of the Jacobian, from JAC_U and JAC_V: what the port's come before.
RIG: Final = 10
TURN: Final = 13
TRANSLATION: Final = 16

LENS: Final = 19
RESIDUAL: Final = 31

COLUMN_OF_SLOT: Final = np.empty(BORDER_SIZE, dtype=np.int64)
"""Where the derivatives by the border's parameters are."""
COLUMN_OF_SLOT[:FIRST_LENS] = [13, 14, 15, 16, 17, 18, 3, 4, 5, 8, 6, 7, 9]
COLUMN_OF_SLOT[FIRST_LENS:] = LENS + np.arange(BORDER_SIZE - FIRST_LENS)


@inner
def project_from_rig(cam, lens, port, buffer):
    """Project points X, Y, Z in the rig, which become those in the camera."""
    r11, r12, r13, tx = cam[0], cam[1], cam[2], cam[3]
    r21, r22, r23, ty = cam[4], cam[5], cam[6], cam[7]
    r31, r32, r33, tz = cam[8], cam[9], cam[10], cam[11]
    for i in range(BLOCK):
        x, y, z = buffer[X * STRIDE + i], buffer[Y * STRIDE + i], buffer[Z * STRIDE + i]
        buffer[X * STRIDE + i] = r11 * x + r12 * y + r13 * z + tx
        buffer[Y * STRIDE + i] = r21 * x + r22 * y + r23 * z + ty
        buffer[Z * STRIDE + i] = r31 * x + r32 * y + r33 * z + tz
    project_lanes(lens, port, buffer)


@inner
def jac_from_rig(cam, arm, port, buffer):
    """All columns of the Jacobian, after `project_from_rig`."""
    jac_lanes(port, buffer)
    _rig_columns(cam, arm, JAC_U, buffer)
    _rig_columns(cam, arm, JAC_V, buffer)


@lane
def _rig_columns(cam, arm, row, buffer):
    """Columns by the point in the rig and by cam_from_rig from those by the point."""
    r11, r12, r13, tx = cam[0], cam[1], cam[2], cam[3]
    r21, r22, r23, ty = cam[4], cam[5], cam[6], cam[7]
    r31, r32, r33, tz = cam[8], cam[9], cam[10], cam[11]
    a11, a12, a13 = arm[0], arm[1], arm[2]
    a21, a22, a23 = arm[3], arm[4], arm[5]
    a31, a32, a33 = arm[6], arm[7], arm[8]
    rig, turn = (row + RIG) * STRIDE, (row + TURN) * STRIDE
    arms = (row + TRANSLATION) * STRIDE
    for i in range(BLOCK):
        lx, ly = buffer[row * STRIDE + i], buffer[(row + 1) * STRIDE + i]
        lz = buffer[(row + 2) * STRIDE + i]
        ax, ay = buffer[X * STRIDE + i] - tx, buffer[Y * STRIDE + i] - ty
        az = buffer[Z * STRIDE + i] - tz
        buffer[rig + i] = lx * r11 + ly * r21 + lz * r31
        buffer[rig + STRIDE + i] = lx * r12 + ly * r22 + lz * r32
        buffer[rig + 2 * STRIDE + i] = lx * r13 + ly * r23 + lz * r33
        # l . (w x a) = w . (a x l) for a turn w of the rotated point a
        buffer[turn + i] = ay * lz - az * ly
        buffer[turn + STRIDE + i] = az * lx - ax * lz
        buffer[turn + 2 * STRIDE + i] = ax * ly - ay * lx
        buffer[arms + i] = lx * a11 + ly * a12 + lz * a13
        buffer[arms + STRIDE + i] = lx * a21 + ly * a22 + lz * a23
        buffer[arms + 2 * STRIDE + i] = lx * a31 + ly * a32 + lz * a33


@inner
def lens_columns(lens, j_lens, buffer):
    """Columns by the lens parameters: the rays in air are known.

    Args:
        j_lens: (2, 12) scratch.
    """
    for i in range(BLOCK):
        inv_z = 1.0 / buffer[VZ * STRIDE + i]
        u, v = buffer[VX * STRIDE + i] * inv_z, buffer[VY * STRIDE + i] * inv_z
        jac_by_params(u, v, lens, j_lens)
        for k in range(len(j_lens[0])):
            buffer[(JAC_U + LENS + k) * STRIDE + i] = j_lens[0, k]
            buffer[(JAC_V + LENS + k) * STRIDE + i] = j_lens[1, k]


@inner
def redo_lane(i, x, y, z, xy, cam, arm, lens, port, free_lens, scratch, buffer):
    """Residual and Jacobian of one lane by the scalar kernels, all but the point's.

    Args:
        x, y, z: the point in the rig.
        scratch: (j_port, j_rig, j_border) of `residual_with_jac`.

    Returns:
        (status, rx, ry)
    """
    j_port, j_rig, j_border = scratch
    status, rx, ry = residual_with_jac(
        x, y, z, xy, cam, arm, lens, port, free_lens, j_port, j_rig, j_border
    )
    for row, j in ((JAC_U, 0), (JAC_V, 1)):
        for a in range(3):
            value = j_rig[j, a] if status == VALID else 0.0
            buffer[(row + RIG + a) * STRIDE + i] = value
        for slot in range(BORDER_SIZE):
            value = j_border[j, slot] if status == VALID else 0.0
            buffer[(row + COLUMN_OF_SLOT[slot]) * STRIDE + i] = value
    return status, rx, ry

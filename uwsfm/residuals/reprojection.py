"""Reprojection error in true pixels, and its Jacobian in the rig's frame."""

import math

from uwsfm._base.jit import inner
from uwsfm.models.projection import lens_jac_of_point, project, project_with_jac
from uwsfm.models.status import VALID
from uwsfm.residuals.border import FIRST_LENS, RADIUS


@inner
def point_in_rig(frame, point):
    """Point (3) of a world point in the rig; ``frame`` is a row of [R | t]."""
    x, y, z = point[0], point[1], point[2]
    return (
        frame[0] * x + frame[1] * y + frame[2] * z + frame[3],
        frame[4] * x + frame[5] * y + frame[6] * z + frame[7],
        frame[8] * x + frame[9] * y + frame[10] * z + frame[11],
    )


@inner
def residual(x, y, z, xy, cam, lens, port):
    """(status, rx, ry): projection of a point in the rig, minus the observation."""
    px, py, pz = point_in_rig(cam, (x, y, z))
    status, u, v = project(px, py, pz, lens, port)
    return status, u - xy[0], v - xy[1]


@inner
def residual_with_jac(
    x, y, z, xy, cam, arm, lens, port, free_lens, j_port, j_rig, j_border
):
    """Residual, with Jacobians by the point in the rig and by the camera.

    Args:
        x, y, z: the point in the rig's frame.
        xy: (2,) the observation.
        cam: (12,) cam_from_rig as a row of [R | t].
        arm: (9,) how its translation moves with direction (2) and length (1): three
            columns, one after the other.
        lens, port: rows of the models.
        free_lens: whether the lens columns are wanted: they cost a second refraction.
        j_port: (2, JAC_SIZE) scratch.
        j_rig: (2, 3), written.
        j_border: (2, BORDER_SIZE), written.

    Returns:
        (status, rx, ry); Jacobians are undefined unless the status is VALID.
    """
    ax = cam[0] * x + cam[1] * y + cam[2] * z
    ay = cam[4] * x + cam[5] * y + cam[6] * z
    az = cam[8] * x + cam[9] * y + cam[10] * z
    px, py, pz = ax + cam[3], ay + cam[7], az + cam[11]
    status, u, v = project_with_jac(px, py, pz, lens, port, j_port)
    if status != VALID:
        return status, math.nan, math.nan
    if free_lens:
        lens_jac_of_point(px, py, pz, lens, port, j_border[:, FIRST_LENS:])
    for i in range(2):
        lx, ly, lz = j_port[i, 0], j_port[i, 1], j_port[i, 2]
        for k in range(3):
            j_rig[i, k] = lx * cam[k] + ly * cam[4 + k] + lz * cam[8 + k]
            j_border[i, 3 + k] = (
                lx * arm[3 * k] + ly * arm[3 * k + 1] + lz * arm[3 * k + 2]
            )
        # l . (w x a) = w . (a x l) for a turn w of the rotated point a
        j_border[i, 0] = ay * lz - az * ly
        j_border[i, 1] = az * lx - ax * lz
        j_border[i, 2] = ax * ly - ay * lx
        j_border[i, 6] = j_port[i, 3]
        j_border[i, 7] = j_port[i, 4]
        j_border[i, 8] = j_port[i, 5]
        j_border[i, 9] = j_port[i, 8]
        j_border[i, 10] = j_port[i, 6]
        j_border[i, 11] = j_port[i, 7]
        j_border[i, RADIUS] = j_port[i, 9]
    return status, u - xy[0], v - xy[1]

"""The refractive camera: water rays from pixels, pixels from points, Jacobians.

Names in Refractive COLMAP: `CamFromImgRefrac` is `unproject`, `ImgFromCamRefrac` is
`project`. Scalar kernels work on one port row and one lens row; the batch kernels
below them only loop. All points and rays are in the camera frame, in metres. What
kinds of ports do differently is behind `uwsfm.models.ports.dispatch`.
"""

import math

import numpy as np

from uwsfm._base.jit import inner, kernel
from uwsfm.models.lanes import (
    BLOCK,
    JAC_U,
    JAC_V,
    OK,
    PX,
    PY,
    SIZE,
    STRIDE,
    VX,
    X,
    load_rows,
)
from uwsfm.models.lens import dir_from_img, img_from_dir, jac_by_params
from uwsfm.models.lens_lanes import dir_lanes, img_lanes
from uwsfm.models.ports.dispatch import (
    port_air_lanes,
    port_air_ray,
    port_jac,
    port_jac_lanes,
    port_ray_lanes,
    port_water_ray,
)
from uwsfm.models.status import (
    BEHIND_CAMERA,
    NOT_FINITE,
    OUTSIDE_LENS,
    VALID,
)

JAC_SIZE = 10
"""Columns of the Jacobian: point (3); normal (2, tangent) and distance of a plane, or
centre (3) of a dome; thickness, n_glass, n_water; radius of a dome."""


@inner
def water_ray_from_dir(dx, dy, dz, port):
    """Refract a unit direction in air through a port.

    Returns:
        (status, origin on the outer surface (3), unit direction in water (3)).
    """
    if not abs(dx) + abs(dy) + abs(dz) < math.inf:
        nan = math.nan
        return OUTSIDE_LENS, nan, nan, nan, nan, nan, nan
    return port_water_ray(dx, dy, dz, port)


@inner
def unproject(px, py, lens, port):
    """Water ray of a pixel: (status, origin (3), unit direction (3))."""
    nan = math.nan
    if not abs(px) + abs(py) < math.inf:
        return NOT_FINITE, nan, nan, nan, nan, nan, nan
    dx, dy, dz = dir_from_img(px, py, lens)
    return water_ray_from_dir(dx, dy, dz, port)


@inner
def air_ray(x, y, z, port):
    """Ray in air of a point: (status, root of the port's equation, v (3), not unit)."""
    if not abs(x) + abs(y) + abs(z) < math.inf:
        nan = math.nan
        return NOT_FINITE, nan, nan, nan, nan
    return port_air_ray(x, y, z, port)


@inner
def project(x, y, z, lens, port):
    """Pixel of a point: (status, px, py)."""
    status, _, vx, vy, vz = air_ray(x, y, z, port)
    if status != VALID:
        return status, math.nan, math.nan
    if not vz > 0.0:
        return BEHIND_CAMERA, math.nan, math.nan
    px, py, _, _, _, _, _, _ = img_from_dir(vx, vy, vz, lens)
    if not abs(px) + abs(py) < math.inf:
        return OUTSIDE_LENS, math.nan, math.nan
    return VALID, px, py


@inner
def project_with_jac(x, y, z, lens, port, jac):
    """Pixel of a point and its closed-form Jacobian.

    Args:
        x, y, z: the point.
        lens, port: rows.
        jac: (2, JAC_SIZE), written; untouched if the status is not VALID.

    Returns:
        (status, px, py).
    """
    status, root, vx, vy, vz = air_ray(x, y, z, port)
    if status != VALID:
        return status, math.nan, math.nan
    if not vz > 0.0:
        return BEHIND_CAMERA, math.nan, math.nan
    px, py, a1, a2, a3, b1, b2, b3 = img_from_dir(vx, vy, vz, lens)
    if not abs(px) + abs(py) < math.inf:
        return OUTSIDE_LENS, math.nan, math.nan
    rows = (a1, a2, a3, b1, b2, b3)
    port_jac(x, y, z, root, port, rows, jac)
    return VALID, px, py


@inner
def lens_jac_of_point(x, y, z, lens, port, jac):
    """d(pixel) / d(lens parameters) of a point that projects: jac (2, 12), written."""
    _, _, vx, vy, vz = air_ray(x, y, z, port)
    jac_by_params(vx / vz, vy / vz, lens, jac)


@inner
def project_lanes(lens, port, buffer):
    """PX, PY and d(pixel) / dv of points X, Y, Z; lanes that are not OK are undone."""
    port_air_lanes(port, buffer)
    img_lanes(lens, buffer)


@inner
def jac_lanes(port, buffer):
    """JAC_SIZE columns of the Jacobian, after `project_lanes`."""
    port_jac_lanes(port, buffer)


@inner
def _take_rays(first, count, buffer, rays, status):
    for i in range(count):
        for k in range(3):
            rays[first + i, k] = buffer[(X + k) * STRIDE + i]
            rays[first + i, 3 + k] = buffer[(VX + k) * STRIDE + i]
        status[first + i] = VALID


@kernel
def unproject_batch(xy, lens, port, rays, status):
    """`unproject` of many: xy (N, 2) -> rays (N, 6), status (N,)."""
    buffer = np.empty(SIZE)
    for first in range(0, len(xy), BLOCK):
        count = min(BLOCK, len(xy) - first)
        load_rows(xy, first, count, PX, 2, buffer)
        dir_lanes(lens, buffer)
        port_ray_lanes(port, buffer)
        _take_rays(first, count, buffer, rays, status)
        for i in range(count):
            if buffer[OK * STRIDE + i] == 1.0:
                continue
            j = first + i
            code, ox, oy, oz, wx, wy, wz = unproject(xy[j, 0], xy[j, 1], lens, port)
            status[j] = code
            rays[j, 0], rays[j, 1], rays[j, 2] = ox, oy, oz
            rays[j, 3], rays[j, 4], rays[j, 5] = wx, wy, wz


@kernel
def refract_batch(dirs, port, rays, status):
    """`water_ray_from_dir` of many: unit dirs (N, 3) -> rays (N, 6), status (N,)."""
    for i in range(len(dirs)):
        code, ox, oy, oz, wx, wy, wz = water_ray_from_dir(
            dirs[i, 0], dirs[i, 1], dirs[i, 2], port
        )
        status[i] = code
        rays[i, 0], rays[i, 1], rays[i, 2] = ox, oy, oz
        rays[i, 3], rays[i, 4], rays[i, 5] = wx, wy, wz


@kernel
def project_batch(points, lens, port, xy, status):
    """`project` of many: points (N, 3) -> xy (N, 2), status (N,)."""
    buffer = np.empty(SIZE)
    for first in range(0, len(points), BLOCK):
        count = min(BLOCK, len(points) - first)
        load_rows(points, first, count, X, 3, buffer)
        project_lanes(lens, port, buffer)
        for i in range(count):
            j = first + i
            code, px, py = VALID, buffer[PX * STRIDE + i], buffer[PY * STRIDE + i]
            if buffer[OK * STRIDE + i] != 1.0:
                code, px, py = project(
                    points[j, 0], points[j, 1], points[j, 2], lens, port
                )
            status[j] = code
            xy[j, 0], xy[j, 1] = px, py


@kernel
def project_with_jac_batch(points, lens, port, xy, jac, status):
    """`project_with_jac` of many: jac (N, 2, JAC_SIZE), NaN where invalid."""
    buffer = np.empty(SIZE)
    for first in range(0, len(points), BLOCK):
        count = min(BLOCK, len(points) - first)
        load_rows(points, first, count, X, 3, buffer)
        project_lanes(lens, port, buffer)
        jac_lanes(port, buffer)
        for i in range(count):
            j = first + i
            code, px, py = VALID, buffer[PX * STRIDE + i], buffer[PY * STRIDE + i]
            for k in range(JAC_SIZE):
                jac[j, 0, k] = buffer[(JAC_U + k) * STRIDE + i]
                jac[j, 1, k] = buffer[(JAC_V + k) * STRIDE + i]
            if buffer[OK * STRIDE + i] != 1.0:
                jac[j] = math.nan
                code, px, py = project_with_jac(
                    points[j, 0], points[j, 1], points[j, 2], lens, port, jac[j]
                )
            status[j] = code
            xy[j, 0], xy[j, 1] = px, py

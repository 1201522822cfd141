"""The flat-port camera: water rays from pixels, pixels from points, Jacobians.

Names in Refractive COLMAP: `CamFromImgRefrac` is `unproject`, `ImgFromCamRefrac` is
`project`. Scalar kernels work on one port row and one lens row; the batch kernels
below them only loop. All points and rays are in the camera frame, in metres.
"""

import math

from uwsfm._jit import kernel
from uwsfm.geometry.refraction import refract, slope, solve_flat_port
from uwsfm.geometry.unit_vector import tangents
from uwsfm.models.lens import dir_from_img, img_from_dir, jac_by_params
from uwsfm.models.status import (
    BEHIND_CAMERA,
    IN_AIR_GAP,
    IN_GLASS,
    MISSES_PORT,
    NOT_FINITE,
    OUTSIDE_LENS,
    TOTAL_REFLECTION,
    VALID,
)

JAC_SIZE = 9
"""Columns of the Jacobian: point (3), normal (2, tangent), dist, thick, n_g, n_w."""


@kernel
def water_ray_from_dir(dx, dy, dz, port):
    """Refract a unit direction in air through the port (paper eq. 1-4).

    Returns:
        (status, origin on the outer surface (3), unit direction in water (3)).
    """
    nan = math.nan
    nx, ny, nz = port[0], port[1], port[2]
    n_air, n_glass, n_water = port[5], port[6], port[7]
    if not abs(dx) + abs(dy) + abs(dz) < math.inf:
        return OUTSIDE_LENS, nan, nan, nan, nan, nan, nan
    cos_air = nx * dx + ny * dy + nz * dz
    if not cos_air > 0.0:
        return MISSES_PORT, nan, nan, nan, nan, nan, nan
    gx, gy, gz = refract(dx, dy, dz, nx, ny, nz, n_air / n_glass)
    wx, wy, wz = refract(gx, gy, gz, nx, ny, nz, n_glass / n_water)
    if not abs(wx) < math.inf:
        return TOTAL_REFLECTION, nan, nan, nan, nan, nan, nan
    a = port[3] / cos_air
    b = port[4] / (nx * gx + ny * gy + nz * gz)
    return VALID, a * dx + b * gx, a * dy + b * gy, a * dz + b * gz, wx, wy, wz


@kernel
def unproject(px, py, lens, port):
    """Water ray of a pixel: (status, origin (3), unit direction (3))."""
    nan = math.nan
    if not abs(px) + abs(py) < math.inf:
        return NOT_FINITE, nan, nan, nan, nan, nan, nan
    dx, dy, dz = dir_from_img(px, py, lens)
    return water_ray_from_dir(dx, dy, dz, port)


@kernel
def _air_ray(x, y, z, port):
    """Ray in air v = n + q r of a point: (status, q, <n, X>, rx, ry, rz, r2)."""
    nan = math.nan
    if not abs(x) + abs(y) + abs(z) < math.inf:
        return NOT_FINITE, nan, nan, nan, nan, nan, nan
    nx, ny, nz = port[0], port[1], port[2]
    depth = nx * x + ny * y + nz * z
    if not depth > 0.0:
        return BEHIND_CAMERA, nan, nan, nan, nan, nan, nan
    height = depth - port[3] - port[4]
    if not height > 0.0:
        status = IN_AIR_GAP if depth < port[3] else IN_GLASS
        return status, nan, nan, nan, nan, nan, nan
    rx, ry, rz = x - depth * nx, y - depth * ny, z - depth * nz
    r2 = rx * rx + ry * ry + rz * rz
    q = solve_flat_port(
        height, r2, port[3], port[4], port[6] / port[5], port[7] / port[5]
    )
    if not q < math.inf:
        return TOTAL_REFLECTION, nan, nan, nan, nan, nan, nan
    return VALID, q, depth, rx, ry, rz, r2


@kernel
def project(x, y, z, lens, port):
    """Pixel of a point: (status, px, py)."""
    status, q, _, rx, ry, rz, _ = _air_ray(x, y, z, port)
    if status != VALID:
        return status, math.nan, math.nan
    vz = port[2] + q * rz
    if not vz > 0.0:
        return BEHIND_CAMERA, math.nan, math.nan
    px, py, _, _, _, _, _, _ = img_from_dir(
        port[0] + q * rx, port[1] + q * ry, vz, lens
    )
    if not abs(px) + abs(py) < math.inf:
        return OUTSIDE_LENS, math.nan, math.nan
    return VALID, px, py


@kernel
def project_with_jac(x, y, z, lens, port, jac):
    """Pixel of a point and its Jacobian, by the implicit function theorem.

    With v = n + q r, F(q) = 0, and L = d(pixel) / dv (2x3):
        A = q^3 [t (g^2-1) s_g^3 + h (w^2-1) s_w^3] / F',  B = -q s_w / F'
        d/dX = (L r)(A r + B n)^T + q (L - (L n) n^T)
        d/dn = [(1 - q z) L + ((B - z A) L r - q L n) r^T] T
        d/dd = -L r q (1 - s_w) / F',   d/dt = -L r q (s_g - s_w) / F'
        d/dn_i = L r q l_i n_i (1 + u) s_i^3 / F',  l_i the layer's thickness

    Args:
        x, y, z: the point.
        lens, port: rows.
        jac: (2, JAC_SIZE), written; untouched if the status is not VALID.

    Returns:
        (status, px, py).
    """
    status, q, depth, rx, ry, rz, r2 = _air_ray(x, y, z, port)
    if status != VALID:
        return status, math.nan, math.nan
    nx, ny, nz = port[0], port[1], port[2]
    vz = nz + q * rz
    if not vz > 0.0:
        return BEHIND_CAMERA, math.nan, math.nan
    px, py, a1, a2, a3, b1, b2, b3 = img_from_dir(nx + q * rx, ny + q * ry, vz, lens)
    if not abs(px) + abs(py) < math.inf:
        return OUTSIDE_LENS, math.nan, math.nan
    dist, thick, n_air = port[3], port[4], port[5]
    g, w = port[6] / n_air, port[7] / n_air
    height = depth - dist - thick
    u = q * q * r2
    s_g, s_w = slope(g, u), slope(w, u)
    g3, w3 = thick * s_g**3, height * s_w**3
    inv_f1 = 1.0 / (dist + g * g * g3 + w * w * w3)
    a = q**3 * ((g * g - 1.0) * g3 + (w * w - 1.0) * w3) * inv_f1
    b = -q * s_w * inv_f1
    t11, t12, t13, t21, t22, t23 = tangents(nx, ny, nz)
    rt1 = rx * t11 + ry * t12 + rz * t13
    rt2 = rx * t21 + ry * t22 + rz * t23
    stretch = 1.0 - q * depth
    tilt = b - depth * a
    for i in range(2):
        lx, ly, lz = (a1, a2, a3) if i == 0 else (b1, b2, b3)
        l_r = lx * rx + ly * ry + lz * rz
        l_n = lx * nx + ly * ny + lz * nz
        jac[i, 0] = l_r * (a * rx + b * nx) + q * (lx - l_n * nx)
        jac[i, 1] = l_r * (a * ry + b * ny) + q * (ly - l_n * ny)
        jac[i, 2] = l_r * (a * rz + b * nz) + q * (lz - l_n * nz)
        pull = tilt * l_r - q * l_n
        jac[i, 3] = stretch * (lx * t11 + ly * t12 + lz * t13) + pull * rt1
        jac[i, 4] = stretch * (lx * t21 + ly * t22 + lz * t23) + pull * rt2
        scale = l_r * q * inv_f1
        jac[i, 5] = -scale * (1.0 - s_w)
        jac[i, 6] = -scale * (s_g - s_w)
        jac[i, 7] = scale * g * (1.0 + u) * g3 / n_air
        jac[i, 8] = scale * w * (1.0 + u) * w3 / n_air
    return VALID, px, py


@kernel
def lens_jac_of_point(x, y, z, lens, port, jac):
    """d(pixel) / d(lens parameters) of a point that projects: jac (2, 12), written."""
    _, q, _, rx, ry, rz, _ = _air_ray(x, y, z, port)
    inv_z = 1.0 / (port[2] + q * rz)
    jac_by_params((port[0] + q * rx) * inv_z, (port[1] + q * ry) * inv_z, lens, jac)


@kernel
def unproject_batch(xy, lens, port, rays, status):
    """Loop of `unproject`: xy (N, 2) -> rays (N, 6), status (N,)."""
    for i in range(len(xy)):
        code, ox, oy, oz, wx, wy, wz = unproject(xy[i, 0], xy[i, 1], lens, port)
        status[i] = code
        rays[i, 0], rays[i, 1], rays[i, 2] = ox, oy, oz
        rays[i, 3], rays[i, 4], rays[i, 5] = wx, wy, wz


@kernel
def refract_batch(dirs, port, rays, status):
    """Loop of `water_ray_from_dir`: unit dirs (N, 3) -> rays (N, 6), status (N,)."""
    for i in range(len(dirs)):
        code, ox, oy, oz, wx, wy, wz = water_ray_from_dir(
            dirs[i, 0], dirs[i, 1], dirs[i, 2], port
        )
        status[i] = code
        rays[i, 0], rays[i, 1], rays[i, 2] = ox, oy, oz
        rays[i, 3], rays[i, 4], rays[i, 5] = wx, wy, wz


@kernel
def project_batch(points, lens, port, xy, status):
    """Loop of `project`: points (N, 3) -> xy (N, 2), status (N,)."""
    for i in range(len(points)):
        code, px, py = project(points[i, 0], points[i, 1], points[i, 2], lens, port)
        status[i] = code
        xy[i, 0], xy[i, 1] = px, py


@kernel
def project_with_jac_batch(points, lens, port, xy, jac, status):
    """Loop of `project_with_jac`: jac (N, 2, JAC_SIZE), NaN where invalid."""
    for i in range(len(points)):
        code, px, py = project_with_jac(
            points[i, 0], points[i, 1], points[i, 2], lens, port, jac[i]
        )
        status[i] = code
        xy[i, 0], xy[i, 1] = px, py
        if code != VALID:
            jac[i] = math.nan

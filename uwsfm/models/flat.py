"""Kernels of the flat port: water rays from air rays, air rays from points, Jacobians.

A port is one row, see `uwsfm.models.port`. All points and rays are in the camera frame,
in metres. Failure is a status and NaN.
"""

import math

from uwsfm._jit import kernel
from uwsfm.geometry.refraction import refract, slope, solve_flat_port
from uwsfm.geometry.unit_vector import tangents
from uwsfm.models.status import (
    BEHIND_CAMERA,
    IN_AIR_GAP,
    IN_GLASS,
    MISSES_PORT,
    TOTAL_REFLECTION,
    VALID,
)


@kernel
def flat_water_ray(dx, dy, dz, port):
    """Refract a finite unit direction in air through the port (paper eq. 1-4).

    Returns:
        (status, origin on the outer surface (3), unit direction in water (3)).
    """
    nan = math.nan
    nx, ny, nz = port[0], port[1], port[2]
    n_air, n_glass, n_water = port[5], port[6], port[7]
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
def flat_air_ray(x, y, z, port):
    """Ray in air v = n + q r of a finite point: (status, q, v (3)), v not unit."""
    nan = math.nan
    nx, ny, nz = port[0], port[1], port[2]
    depth = nx * x + ny * y + nz * z
    if not depth > 0.0:
        return BEHIND_CAMERA, nan, nan, nan, nan
    height = depth - port[3] - port[4]
    if not height > 0.0:
        status = IN_AIR_GAP if depth < port[3] else IN_GLASS
        return status, nan, nan, nan, nan
    rx, ry, rz = x - depth * nx, y - depth * ny, z - depth * nz
    r2 = rx * rx + ry * ry + rz * rz
    q = solve_flat_port(
        height, r2, port[3], port[4], port[6] / port[5], port[7] / port[5]
    )
    if not q < math.inf:
        return TOTAL_REFLECTION, nan, nan, nan, nan
    return VALID, q, nx + q * rx, ny + q * ry, nz + q * rz


@kernel
def flat_jac(x, y, z, q, port, lens_rows, jac):
    """Jacobian of the pixel of a point, by the implicit function theorem.

    With v = n + q r, F(q) = 0, and L = d(pixel) / dv (2x3):
        A = q^3 [t (g^2-1) s_g^3 + h (w^2-1) s_w^3] / F',  B = -q s_w / F'
        d/dX = (L r)(A r + B n)^T + q (L - (L n) n^T)
        d/dn = [(1 - q z) L + ((B - z A) L r - q L n) r^T] T
        d/dd = -L r q (1 - s_w) / F',   d/dt = -L r q (s_g - s_w) / F'
        d/dn_i = L r q l_i n_i (1 + u) s_i^3 / F',  l_i the layer's thickness

    Args:
        x, y, z: the point.
        q: as found by `flat_air_ray`.
        port: row.
        lens_rows: the six numbers of L, row by row.
        jac: (2, JAC_SIZE), written.
    """
    nx, ny, nz = port[0], port[1], port[2]
    dist, thick, n_air = port[3], port[4], port[5]
    depth = nx * x + ny * y + nz * z
    rx, ry, rz = x - depth * nx, y - depth * ny, z - depth * nz
    r2 = rx * rx + ry * ry + rz * rz
    g, w = port[6] / n_air, port[7] / n_air
    height = depth - dist - thick
    u = q * q * r2
    s_g, s_w = slope(g, u), slope(w, u)
    g3, w3 = thick * s_g**3, height * s_w**3
    inv_f1 = 1.0 / (dist + g * g * g3 + w * w * w3)
    a = q**3 * ((g * g - 1.0) * g3 + (w * w - 1.0) * w3) * inv_f1
    b = -q * s_w * inv_f1
    tilt, stretch = b - depth * a, 1.0 - q * depth
    t11, t12, t13, t21, t22, t23 = tangents(nx, ny, nz)
    rt1 = rx * t11 + ry * t12 + rz * t13
    rt2 = rx * t21 + ry * t22 + rz * t23
    for i in range(2):
        lx, ly, lz = lens_rows[3 * i], lens_rows[3 * i + 1], lens_rows[3 * i + 2]
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
        jac[i, 9] = 0.0  # no radius

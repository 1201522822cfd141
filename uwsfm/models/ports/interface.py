"""Kernels of the interface: water rays from air rays, air rays from points, Jacobians.

A port is one row, see `uwsfm.models.ports.row`. All points and rays are in the camera
frame, in metres. With the normal n, the distance d and the index w of the water over
that of the air, and z = <n, X>, r = X - z n, h = z - d of a point X, its ray in air is
v = n + q r with

    F(q) = q (d + h s) - 1 = 0,   s = (w^2 + (w^2 - 1) u)^(-1/2),   u = q^2 |r|^2

There are no kernels over lanes: the scalar ones do every point.
"""

import math

from uwsfm._base.jit import inner
from uwsfm.geometry.refraction import refract, slope, solve_flat_port
from uwsfm.geometry.unit_vector import tangents
from uwsfm.models.ports.kernels import PortKernels
from uwsfm.models.ports.row import DISTANCE, N_AIR, N_WATER, NX, NY, NZ
from uwsfm.models.status import (
    BEHIND_CAMERA,
    IN_AIR_GAP,
    MISSES_PORT,
    TOTAL_REFLECTION,
    VALID,
)


@inner
def interface_water_ray(dx, dy, dz, port):
    """Refract a finite unit direction in air at the plane (Snell).

    Returns:
        (status, origin on the plane (3), unit direction in water (3)).
    """
    nan = math.nan
    nx, ny, nz = port[NX], port[NY], port[NZ]
    along = nx * dx + ny * dy + nz * dz
    if not along > 0.0:
        return MISSES_PORT, nan, nan, nan, nan, nan, nan
    wx, wy, wz = refract(dx, dy, dz, nx, ny, nz, port[N_AIR] / port[N_WATER])
    if not abs(wx) < math.inf:
        return TOTAL_REFLECTION, nan, nan, nan, nan, nan, nan
    a = port[DISTANCE] / along
    return VALID, a * dx, a * dy, a * dz, wx, wy, wz


@inner
def interface_air_ray(x, y, z, port):
    """Ray in air v = n + q r of a finite point: (status, q, v (3)), v not unit."""
    nan = math.nan
    nx, ny, nz = port[NX], port[NY], port[NZ]
    depth = nx * x + ny * y + nz * z
    if not depth > 0.0:
        return BEHIND_CAMERA, nan, nan, nan, nan
    height = depth - port[DISTANCE]
    if not height > 0.0:
        return IN_AIR_GAP, nan, nan, nan, nan
    rx, ry, rz = x - depth * nx, y - depth * ny, z - depth * nz
    r2 = rx * rx + ry * ry + rz * rz
    w = port[N_WATER] / port[N_AIR]
    # No glass: a thickness of zero, whose index does not matter.
    q = solve_flat_port(height, r2, port[DISTANCE], 0.0, w, w)
    if not q < math.inf:
        return TOTAL_REFLECTION, nan, nan, nan, nan
    return VALID, q, nx + q * rx, ny + q * ry, nz + q * rz


@inner
def interface_jac(x, y, z, q, port, lens_rows, jac):
    """Jacobian of the pixel of a point, by the implicit function theorem.

    With L = d(pixel) / dv (2x3), F' = d + w^2 h s^3 and T a tangent basis at n:
        A = q^3 (w^2 - 1) h s^3 / F',  B = -q s / F'
        d/dX = (L r)(A r + B n)^T + q (L - (L n) n^T)
        d/dn = [(1 - q z) L + ((B - z A) L r - q L n) r^T] T
        d/dd = -L r q (1 - s) / F',    d/dn_w = L r q h w (1 + u) s^3 / F'

    Args:
        x, y, z: the point.
        q: as found by `interface_air_ray`.
        port: row.
        lens_rows: the six numbers of L, row by row.
        jac: (2, JAC_SIZE), written; the columns of glass and radius are zero.
    """
    nx, ny, nz, w = port[NX], port[NY], port[NZ], port[N_WATER] / port[N_AIR]
    depth = nx * x + ny * y + nz * z
    rx, ry, rz = x - depth * nx, y - depth * ny, z - depth * nz
    u = q * q * (rx * rx + ry * ry + rz * rz)
    s = slope(w, u)
    bent = (depth - port[DISTANCE]) * s * s * s
    scale = 1.0 / (port[DISTANCE] + w * w * bent)
    a, b = q * q * q * (w * w - 1.0) * bent * scale, -q * s * scale
    t11, t12, t13, t21, t22, t23 = tangents(nx, ny, nz)
    for i in range(2):
        lx, ly, lz = lens_rows[3 * i], lens_rows[3 * i + 1], lens_rows[3 * i + 2]
        l_r, l_n = lx * rx + ly * ry + lz * rz, lx * nx + ly * ny + lz * nz
        by_r, by_n = l_r * a, l_r * b - q * l_n
        pull, stretch = (b - depth * a) * l_r - q * l_n, 1.0 - q * depth
        jac[i, 0] = by_r * rx + by_n * nx + q * lx
        jac[i, 1] = by_r * ry + by_n * ny + q * ly
        jac[i, 2] = by_r * rz + by_n * nz + q * lz
        jac[i, 3] = stretch * (lx * t11 + ly * t12 + lz * t13) + pull * (
            rx * t11 + ry * t12 + rz * t13
        )
        jac[i, 4] = stretch * (lx * t21 + ly * t22 + lz * t23) + pull * (
            rx * t21 + ry * t22 + rz * t23
        )
        jac[i, 5] = -l_r * q * scale * (1.0 - s)
        jac[i, 6], jac[i, 7] = 0.0, 0.0  # no glass
        jac[i, 8] = l_r * q * scale * (1.0 + u) * w * bent / port[N_AIR]
        jac[i, 9] = 0.0  # no radius


KERNELS = PortKernels(interface_water_ray, interface_air_ray, interface_jac)

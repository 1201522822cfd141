"""Kernels of the flat port: water rays from air rays, air rays from points, Jacobians.

A port is one row, see `uwsfm.models.ports.row`. All points and rays are in the camera
frame, in metres. Failure is a status and NaN.
"""

import math

from uwsfm._base.jit import inner, lane
from uwsfm.geometry.refraction import refract, slope, solve_flat_port
from uwsfm.geometry.unit_vector import tangents
from uwsfm.models.ports.row import (
    DISTANCE,
    N_AIR,
    N_GLASS,
    N_WATER,
    NX,
    NY,
    NZ,
    THICKNESS,
)
from uwsfm.models.status import (
    BEHIND_CAMERA,
    IN_AIR_GAP,
    IN_GLASS,
    MISSES_PORT,
    TOTAL_REFLECTION,
    VALID,
)


@lane
def bent_by_flat(dx, dy, dz, nx, ny, nz, dist, thick, mu_g, mu_w):
    """Origin on the outer surface (3) and direction in water (3) of a ray in air.

    Paper eq. 1-4. NaN on total reflection; the ray is taken to meet the port.

    Args:
        dx, dy, dz: unit direction in air.
        nx, ny, nz, dist, thick: the port.
        mu_g, mu_w: index of air over that of glass, of glass over that of water.
    """
    gx, gy, gz = refract(dx, dy, dz, nx, ny, nz, mu_g)
    wx, wy, wz = refract(gx, gy, gz, nx, ny, nz, mu_w)
    a = dist / (nx * dx + ny * dy + nz * dz)
    b = thick / (nx * gx + ny * gy + nz * gz)
    return a * dx + b * gx, a * dy + b * gy, a * dz + b * gz, wx, wy, wz


@inner
def flat_water_ray(dx, dy, dz, port):
    """Refract a finite unit direction in air through the port (paper eq. 1-4).

    Returns:
        (status, origin on the outer surface (3), unit direction in water (3)).
    """
    nan = math.nan
    nx, ny, nz, mu_g, mu_w = (
        port[NX],
        port[NY],
        port[NZ],
        port[N_AIR] / port[N_GLASS],
        port[N_GLASS] / port[N_WATER],
    )
    if not nx * dx + ny * dy + nz * dz > 0.0:
        return MISSES_PORT, nan, nan, nan, nan, nan, nan
    ox, oy, oz, wx, wy, wz = bent_by_flat(
        dx, dy, dz, nx, ny, nz, port[DISTANCE], port[THICKNESS], mu_g, mu_w
    )
    if not abs(wx) < math.inf:
        return TOTAL_REFLECTION, nan, nan, nan, nan, nan, nan
    return VALID, ox, oy, oz, wx, wy, wz


@inner
def flat_air_ray(x, y, z, port):
    """Ray in air v = n + q r of a finite point: (status, q, v (3)), v not unit."""
    nan = math.nan
    nx, ny, nz = port[NX], port[NY], port[NZ]
    depth = nx * x + ny * y + nz * z
    if not depth > 0.0:
        return BEHIND_CAMERA, nan, nan, nan, nan
    height = depth - port[DISTANCE] - port[THICKNESS]
    if not height > 0.0:
        status = IN_AIR_GAP if depth < port[DISTANCE] else IN_GLASS
        return status, nan, nan, nan, nan
    rx, ry, rz = x - depth * nx, y - depth * ny, z - depth * nz
    r2 = rx * rx + ry * ry + rz * rz
    q = solve_flat_port(
        height,
        r2,
        port[DISTANCE],
        port[THICKNESS],
        port[N_GLASS] / port[N_AIR],
        port[N_WATER] / port[N_AIR],
    )
    if not q < math.inf:
        return TOTAL_REFLECTION, nan, nan, nan, nan
    return VALID, q, nx + q * rx, ny + q * ry, nz + q * rz


@lane
def flat_gradient(q, r2, depth, dist, thick, g, w, n_air):
    """What `flat_jac_row` needs of a root, by the implicit function theorem.

    (A, B, B - z A, 1 - q z, and the factors of L r for d, t, n_glass, n_water).
    """
    u = q * q * r2
    s_g, s_w = slope(g, u), slope(w, u)
    g3 = thick * s_g * s_g * s_g
    w3 = (depth - dist - thick) * s_w * s_w * s_w
    scale = 1.0 / (dist + g * g * g3 + w * w * w3)
    a = q * q * q * ((g * g - 1.0) * g3 + (w * w - 1.0) * w3) * scale
    b = -q * s_w * scale
    bend = q * scale * (1.0 + u) / n_air
    return (
        a,
        b,
        b - depth * a,
        1.0 - q * depth,
        -q * scale * (1.0 - s_w),
        -q * scale * (s_g - s_w),
        bend * g * g3,
        bend * w * w3,
    )


@lane
def flat_jac_row(lx, ly, lz, rx, ry, rz, q, normal, basis, gradient):
    """One row of the Jacobian of `flat_jac`, without the column of the radius."""
    nx, ny, nz = normal
    t11, t12, t13, t21, t22, t23 = basis
    a, b, tilt, stretch, by_dist, by_thick, by_glass, by_water = gradient
    l_r = lx * rx + ly * ry + lz * rz
    l_n = lx * nx + ly * ny + lz * nz
    pull = tilt * l_r - q * l_n
    along_r, along_n = l_r * a, l_r * b - q * l_n
    return (
        along_r * rx + along_n * nx + q * lx,
        along_r * ry + along_n * ny + q * ly,
        along_r * rz + along_n * nz + q * lz,
        stretch * (lx * t11 + ly * t12 + lz * t13)
        + pull * (rx * t11 + ry * t12 + rz * t13),
        stretch * (lx * t21 + ly * t22 + lz * t23)
        + pull * (rx * t21 + ry * t22 + rz * t23),
        l_r * by_dist,
        l_r * by_thick,
        l_r * by_glass,
        l_r * by_water,
    )


@inner
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
    nx, ny, nz = port[NX], port[NY], port[NZ]
    n_air = port[N_AIR]
    depth = nx * x + ny * y + nz * z
    rx, ry, rz = x - depth * nx, y - depth * ny, z - depth * nz
    r2 = rx * rx + ry * ry + rz * rz
    gradient = flat_gradient(
        q,
        r2,
        depth,
        port[DISTANCE],
        port[THICKNESS],
        port[N_GLASS] / n_air,
        port[N_WATER] / n_air,
        n_air,
    )
    basis = tangents(nx, ny, nz)
    for i in range(2):
        lx, ly, lz = lens_rows[3 * i], lens_rows[3 * i + 1], lens_rows[3 * i + 2]
        row = flat_jac_row(lx, ly, lz, rx, ry, rz, q, (nx, ny, nz), basis, gradient)
        for k in range(9):
            jac[i, k] = row[k]
        jac[i, 9] = 0.0  # no radius

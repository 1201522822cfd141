"""Kernels of the dome port: water rays from air rays, air rays from points, Jacobians.

A port is one row, see `uwsfm.models.ports.row`. All points and rays are in the camera
frame, in metres. Failure is a status and NaN. The sphere is taken as whole: where a
real dome ends, its mount is in the image.
"""

import math

from uwsfm._base.jit import inner, lane
from uwsfm.geometry.dome import dome_port_gradient, solve_dome_port
from uwsfm.geometry.refraction import refract
from uwsfm.models.ports.row import (
    CX,
    CY,
    CZ,
    N_AIR,
    N_GLASS,
    N_WATER,
    RADIUS,
    THICKNESS,
)
from uwsfm.models.status import (
    IN_AIR_GAP,
    IN_GLASS,
    MISSES_PORT,
    TOTAL_REFLECTION,
    VALID,
)


@lane
def _range_inside(px, py, pz, dx, dy, dz, radius2):
    """Range from a point inside a sphere around the origin to its surface."""
    along = px * dx + py * dy + pz * dz
    gap = radius2 - (px * px + py * py + pz * pz)
    # Of the two forms of the positive root, the one that does not cancel.
    root = math.sqrt(along * along + gap)
    return gap / (root + along) if along > 0.0 else root - along


@lane
def bent_by_dome(dx, dy, dz, cx, cy, cz, radius, outer, mu_g, mu_w):
    """Origin on the outer surface (3) and direction in water (3) of a ray in air.

    NaN on total reflection; the camera is taken to be inside the dome. Arguments as
    in `flat.bent_by_flat`.
    """
    # Positions are relative to the dome's centre.
    s = _range_inside(-cx, -cy, -cz, dx, dy, dz, radius * radius)
    px, py, pz = s * dx - cx, s * dy - cy, s * dz - cz
    inv = 1.0 / radius
    gx, gy, gz = refract(dx, dy, dz, px * inv, py * inv, pz * inv, mu_g)
    s = _range_inside(px, py, pz, gx, gy, gz, outer * outer)
    px, py, pz = px + s * gx, py + s * gy, pz + s * gz
    inv = 1.0 / outer
    wx, wy, wz = refract(gx, gy, gz, px * inv, py * inv, pz * inv, mu_w)
    return px + cx, py + cy, pz + cz, wx, wy, wz


@inner
def dome_water_ray(dx, dy, dz, port):
    """Refract a finite unit direction in air through the dome.

    Returns:
        (status, origin on the outer surface (3), unit direction in water (3)).
    """
    nan = math.nan
    cx, cy, cz, radius = port[CX], port[CY], port[CZ], port[RADIUS]
    if not cx * cx + cy * cy + cz * cz < radius * radius:
        return MISSES_PORT, nan, nan, nan, nan, nan, nan
    mu_g, mu_w = port[N_AIR] / port[N_GLASS], port[N_GLASS] / port[N_WATER]
    ox, oy, oz, wx, wy, wz = bent_by_dome(
        dx, dy, dz, cx, cy, cz, radius, radius + port[THICKNESS], mu_g, mu_w
    )
    if not abs(wx) < math.inf:
        return TOTAL_REFLECTION, nan, nan, nan, nan, nan, nan
    return VALID, ox, oy, oz, wx, wy, wz


@lane
def invariants(x, y, z, cx, cy, cz):
    """<X, X>, <X, c>, <c, c> and |c x X|^2."""
    sx, sy, sz = cy * z - cz * y, cz * x - cx * z, cx * y - cy * x
    return (
        x * x + y * y + z * z,
        x * cx + y * cy + z * cz,
        cx * cx + cy * cy + cz * cz,
        sx * sx + sy * sy + sz * sz,
    )


@inner
def dome_air_ray(x, y, z, port):
    """Ray in air v = X - kappa c, not unit, of a point: (status, kappa, v (3))."""
    nan = math.nan
    cx, cy, cz, radius = port[CX], port[CY], port[CZ], port[RADIUS]
    outer = radius + port[THICKNESS]
    a, b, c, q = invariants(x, y, z, cx, cy, cz)
    rho2 = a - 2.0 * b + c
    if not rho2 > outer * outer:
        status = IN_AIR_GAP if rho2 < radius * radius else IN_GLASS
        return status, nan, nan, nan, nan
    if not c < radius * radius:
        return MISSES_PORT, nan, nan, nan, nan
    kappa = solve_dome_port(
        a,
        b,
        c,
        q,
        radius,
        port[THICKNESS],
        port[N_AIR] / port[N_GLASS],
        port[N_AIR] / port[N_WATER],
    )
    if not abs(kappa) < math.inf:
        return TOTAL_REFLECTION, nan, nan, nan, nan
    return VALID, kappa, x - kappa * cx, y - kappa * cy, z - kappa * cz


@lane
def dome_jac_row(lx, ly, lz, x, y, z, kappa, center, gradient):
    """One row of the Jacobian of `dome_jac`, by mu instead of by the indices."""
    cx, cy, cz = center
    k_a, k_b, k_c, k_radius, k_thick, k_glass, k_water = gradient
    l_c = lx * cx + ly * cy + lz * cz
    by_x, by_c, by_c2 = 2.0 * k_a * l_c, k_b * l_c, 2.0 * k_c * l_c
    return (
        lx - by_x * x - by_c * cx,
        ly - by_x * y - by_c * cy,
        lz - by_x * z - by_c * cz,
        -kappa * lx - by_c * x - by_c2 * cx,
        -kappa * ly - by_c * y - by_c2 * cy,
        -kappa * lz - by_c * z - by_c2 * cz,
        -l_c * k_thick,
        -l_c * k_glass,
        -l_c * k_water,
        -l_c * k_radius,
    )


@inner
def dome_jac(x, y, z, kappa, port, lens_rows, jac):
    """Jacobian of the pixel of a point, by the implicit function theorem.

    With v = X - kappa c, kappa a function of a = <X, X>, b = <X, c>, c2 = <c, c> and of
    the dome, and L = d(pixel) / dv (2x3):
        d/dX = L - (L c) (2 kappa_a X + kappa_b c)^T
        d/dc = -kappa L - (L c) (kappa_b X + 2 kappa_c c)^T
        d/dR = -(L c) kappa_R, and so on

    Args:
        x, y, z: the point.
        kappa: as found by `dome_air_ray`.
        port: row.
        lens_rows: the six numbers of L, row by row.
        jac: (2, JAC_SIZE), written.
    """
    cx, cy, cz, radius, thick = (
        port[CX],
        port[CY],
        port[CZ],
        port[RADIUS],
        port[THICKNESS],
    )
    n_air, n_glass, n_water = port[N_AIR], port[N_GLASS], port[N_WATER]
    mu_g, mu_w = n_air / n_glass, n_air / n_water
    a, b, c, q = invariants(x, y, z, cx, cy, cz)
    gradient = dome_port_gradient(kappa, a, b, c, q, radius, thick, mu_g, mu_w)
    for i in range(2):
        lx, ly, lz = lens_rows[3 * i], lens_rows[3 * i + 1], lens_rows[3 * i + 2]
        row = dome_jac_row(lx, ly, lz, x, y, z, kappa, (cx, cy, cz), gradient)
        for k in range(10):
            jac[i, k] = row[k]
        jac[i, 7] *= -mu_g / n_glass
        jac[i, 8] *= -mu_w / n_water

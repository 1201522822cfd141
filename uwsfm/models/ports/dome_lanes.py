"""The dome over lanes: see `uwsfm.models.ports.dome` for the equations."""

import math

from uwsfm._base.jit import inner, lane
from uwsfm.geometry.dome import dome_port_gradient, dome_port_newton, dome_port_start
from uwsfm.models.lanes import (
    BLOCK,
    JAC_U,
    JAC_V,
    LENS_U,
    LENS_V,
    OK,
    ROOT,
    STRIDE,
    VX,
    VY,
    VZ,
    X,
    Y,
    Z,
    store_ray,
)
from uwsfm.models.ports.dome import (
    bent_by_dome,
    dome_air_ray,
    dome_jac,
    dome_jac_row,
    dome_water_ray,
    invariants,
)
from uwsfm.models.ports.kernels import PortKernels
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

# Newton steps are quadratic: after one of 1e-9 of the ray the next is below rounding.
LAST_STEP2 = 1e-18


@inner
def dome_air_lanes(port, buffer):
    """Rays in air of the points: ROOT, VX, VY, VZ and OK from X, Y, Z."""
    cx, cy, cz, radius = port[CX], port[CY], port[CZ], port[RADIUS]
    outer = radius + port[THICKNESS]
    mu_g, mu_w = port[N_AIR] / port[N_GLASS], port[N_AIR] / port[N_WATER]
    inside = radius * radius - (cx * cx + cy * cy + cz * cz)
    for i in range(BLOCK):
        x, y, z = buffer[X * STRIDE + i], buffer[Y * STRIDE + i], buffer[Z * STRIDE + i]
        a, b, c, q = invariants(x, y, z, cx, cy, cz)
        rho2 = a - 2.0 * b + c
        rho = math.sqrt(rho2)
        kappa = dome_port_start(rho, radius, outer, mu_g, mu_w)
        _, step, _ = dome_port_newton(kappa, a, b, c, q, rho, radius, outer, mu_g, mu_w)
        kappa -= step
        _, step, _ = dome_port_newton(kappa, a, b, c, q, rho, radius, outer, mu_g, mu_w)
        kappa -= step
        _, step, m2 = dome_port_newton(
            kappa, a, b, c, q, rho, radius, outer, mu_g, mu_w
        )
        kappa -= step
        last = LAST_STEP2 * m2 - step * step * c
        good = min(rho2 - outer * outer, inside)
        buffer[ROOT * STRIDE + i] = kappa
        buffer[VX * STRIDE + i] = x - kappa * cx
        buffer[VY * STRIDE + i] = y - kappa * cy
        buffer[VZ * STRIDE + i] = z - kappa * cz
        buffer[OK * STRIDE + i] = (1.0 if good > 0.0 else 0.0) * (
            1.0 if last >= 0.0 else 0.0
        )


@lane
def _write(buffer, row, i, values, by_glass, by_water):
    for k in range(7):
        buffer[(row + k) * STRIDE + i] = values[k]
    buffer[(row + 7) * STRIDE + i] = by_glass * values[7]
    buffer[(row + 8) * STRIDE + i] = by_water * values[8]
    buffer[(row + 9) * STRIDE + i] = values[9]


@inner
def dome_jac_lanes(port, buffer):
    """Jacobians of the pixels by point and port from ROOT and d(pixel) / dv."""
    cx, cy, cz, radius, thick = (
        port[CX],
        port[CY],
        port[CZ],
        port[RADIUS],
        port[THICKNESS],
    )
    mu_g, mu_w = port[N_AIR] / port[N_GLASS], port[N_AIR] / port[N_WATER]
    by_glass, by_water = -mu_g / port[N_GLASS], -mu_w / port[N_WATER]
    for i in range(BLOCK):
        x, y, z = buffer[X * STRIDE + i], buffer[Y * STRIDE + i], buffer[Z * STRIDE + i]
        kappa = buffer[ROOT * STRIDE + i]
        a, b, c, q = invariants(x, y, z, cx, cy, cz)
        gradient = dome_port_gradient(kappa, a, b, c, q, radius, thick, mu_g, mu_w)
        lx, ly = buffer[LENS_U * STRIDE + i], buffer[(LENS_U + 1) * STRIDE + i]
        lz = buffer[(LENS_U + 2) * STRIDE + i]
        row_u = dome_jac_row(lx, ly, lz, x, y, z, kappa, (cx, cy, cz), gradient)
        lx, ly = buffer[LENS_V * STRIDE + i], buffer[(LENS_V + 1) * STRIDE + i]
        lz = buffer[(LENS_V + 2) * STRIDE + i]
        row_v = dome_jac_row(lx, ly, lz, x, y, z, kappa, (cx, cy, cz), gradient)
        _write(buffer, JAC_U, i, row_u, by_glass, by_water)
        _write(buffer, JAC_V, i, row_v, by_glass, by_water)


@inner
def dome_ray_lanes(port, buffer):
    """Water rays of the directions in air VX, VY, VZ, see `lanes.store_ray`."""
    cx, cy, cz, radius = port[CX], port[CY], port[CZ], port[RADIUS]
    mu_g, mu_w, outer = (
        port[N_AIR] / port[N_GLASS],
        port[N_GLASS] / port[N_WATER],
        radius + port[THICKNESS],
    )
    meets = radius * radius - (cx * cx + cy * cy + cz * cz)
    for i in range(BLOCK):
        dx, dy = buffer[VX * STRIDE + i], buffer[VY * STRIDE + i]
        dz = buffer[VZ * STRIDE + i]
        ray = bent_by_dome(dx, dy, dz, cx, cy, cz, radius, outer, mu_g, mu_w)
        store_ray(i, ray, meets, buffer)


KERNELS = PortKernels(
    dome_water_ray,
    dome_air_ray,
    dome_jac,
    dome_air_lanes,
    dome_jac_lanes,
    dome_ray_lanes,
)

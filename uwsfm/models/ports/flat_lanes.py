"""The flat port over lanes: see `uwsfm.models.ports.flat` for the equations."""

from uwsfm._base.jit import inner, lane
from uwsfm.geometry.refraction import flat_port_start, flat_port_step
from uwsfm.geometry.unit_vector import tangents
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
from uwsfm.models.ports.flat import (
    bent_by_flat,
    flat_air_ray,
    flat_gradient,
    flat_jac,
    flat_jac_row,
    flat_water_ray,
)
from uwsfm.models.ports.kernels import PortKernels
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

# Halley steps are cubic: F of 1e-6 before the last one is below rounding after it.
LAST_STEP_FROM = 1e-6


@inner
def flat_air_lanes(port, buffer):
    """Rays in air of the points: ROOT, VX, VY, VZ and OK from X, Y, Z."""
    nx, ny, nz, dist, thick = (
        port[NX],
        port[NY],
        port[NZ],
        port[DISTANCE],
        port[THICKNESS],
    )
    g, w = port[N_GLASS] / port[N_AIR], port[N_WATER] / port[N_AIR]
    g2, w2, inv_g, inv_w = g * g, w * w, 1.0 / g, 1.0 / w
    # Other orders of the indices need brackets: all lanes go to the scalar kernel.
    tolerance = LAST_STEP_FROM if g >= 1.0 and w >= 1.0 else -1.0
    for i in range(BLOCK):
        x, y, z = buffer[X * STRIDE + i], buffer[Y * STRIDE + i], buffer[Z * STRIDE + i]
        depth = nx * x + ny * y + nz * z
        height = depth - dist - thick
        rx, ry, rz = x - depth * nx, y - depth * ny, z - depth * nz
        r2 = rx * rx + ry * ry + rz * rz
        paraxial = dist + thick * inv_g + height * inv_w
        low = 1.0 / paraxial
        q = flat_port_start(low, r2, w2)
        q, _ = flat_port_step(q, low, height, r2, dist, thick, g2, w2)
        q, f = flat_port_step(q, low, height, r2, dist, thick, g2, w2)
        good = min(min(depth, height), min(paraxial, tolerance - abs(f)))
        buffer[ROOT * STRIDE + i] = q
        buffer[VX * STRIDE + i] = nx + q * rx
        buffer[VY * STRIDE + i] = ny + q * ry
        buffer[VZ * STRIDE + i] = nz + q * rz
        buffer[OK * STRIDE + i] = 1.0 if good > 0.0 else 0.0


@lane
def _write(buffer, row, i, values):
    for k in range(9):
        buffer[(row + k) * STRIDE + i] = values[k]


@inner
def flat_jac_lanes(port, buffer):
    """Jacobians of the pixels by point and port from ROOT and d(pixel) / dv."""
    nx, ny, nz, dist, thick, n_air = (
        port[NX],
        port[NY],
        port[NZ],
        port[DISTANCE],
        port[THICKNESS],
        port[N_AIR],
    )
    g, w = port[N_GLASS] / n_air, port[N_WATER] / n_air
    normal, basis = (nx, ny, nz), tangents(nx, ny, nz)
    for i in range(BLOCK):
        x, y, z = buffer[X * STRIDE + i], buffer[Y * STRIDE + i], buffer[Z * STRIDE + i]
        q = buffer[ROOT * STRIDE + i]
        depth = nx * x + ny * y + nz * z
        rx, ry, rz = x - depth * nx, y - depth * ny, z - depth * nz
        r2 = rx * rx + ry * ry + rz * rz
        gradient = flat_gradient(q, r2, depth, dist, thick, g, w, n_air)
        lx, ly = buffer[LENS_U * STRIDE + i], buffer[(LENS_U + 1) * STRIDE + i]
        lz = buffer[(LENS_U + 2) * STRIDE + i]
        row_u = flat_jac_row(lx, ly, lz, rx, ry, rz, q, normal, basis, gradient)
        lx, ly = buffer[LENS_V * STRIDE + i], buffer[(LENS_V + 1) * STRIDE + i]
        lz = buffer[(LENS_V + 2) * STRIDE + i]
        row_v = flat_jac_row(lx, ly, lz, rx, ry, rz, q, normal, basis, gradient)
        _write(buffer, JAC_U, i, row_u)
        _write(buffer, JAC_V, i, row_v)
        buffer[(JAC_U + 9) * STRIDE + i] = 0.0  # no radius
        buffer[(JAC_V + 9) * STRIDE + i] = 0.0


@inner
def flat_ray_lanes(port, buffer):
    """Water rays of the directions in air VX, VY, VZ, see `lanes.store_ray`."""
    nx, ny, nz, dist, thick = (
        port[NX],
        port[NY],
        port[NZ],
        port[DISTANCE],
        port[THICKNESS],
    )
    mu_g, mu_w = port[N_AIR] / port[N_GLASS], port[N_GLASS] / port[N_WATER]
    for i in range(BLOCK):
        dx, dy = buffer[VX * STRIDE + i], buffer[VY * STRIDE + i]
        dz = buffer[VZ * STRIDE + i]
        meets = nx * dx + ny * dy + nz * dz
        ray = bent_by_flat(dx, dy, dz, nx, ny, nz, dist, thick, mu_g, mu_w)
        store_ray(i, ray, meets, buffer)


KERNELS = PortKernels(
    flat_water_ray,
    flat_air_ray,
    flat_jac,
    flat_air_lanes,
    flat_jac_lanes,
    flat_ray_lanes,
)

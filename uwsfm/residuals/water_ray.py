"""The water ray of a fixed direction in air, in the form that residuals differentiate.

With v the unit direction in air, a = <n, v>, u = 1/a^2 - 1 (the squared tangent in
air), indices relative to air and s_i from `slope`, the ray of paper eq. 1-4 is

    w = v / a - n,  k = d + t s_g:   origin (d + t) n + k w,   direction n + s_w w

The direction is not unit: its length makes a range along it a depth behind the port.
All of it is smooth in the port, also where the distance passes through zero.
"""

import math

from uwsfm._base.jit import inner
from uwsfm.geometry.refraction import slope
from uwsfm.models.ports.row import N_AIR, N_GLASS, N_WATER, NX, NY, NZ
from uwsfm.models.status import MISSES_PORT, OUTSIDE_LENS, TOTAL_REFLECTION, VALID


@inner
def water_ray(v, port):
    """(status, a, s_g, s_w, w (3)) of a unit direction in air and a port row.

    A direction of NaN is a pixel that the lens cannot unproject.
    """
    nan = math.nan
    vx, vy, vz = v[0], v[1], v[2]
    nx, ny, nz = port[NX], port[NY], port[NZ]
    if not abs(vx) + abs(vy) + abs(vz) < math.inf:
        return OUTSIDE_LENS, nan, nan, nan, (nan, nan, nan)
    a = nx * vx + ny * vy + nz * vz
    if not a > 0.0:
        return MISSES_PORT, nan, nan, nan, (nan, nan, nan)
    inv_a = 1.0 / a
    u = inv_a * inv_a - 1.0
    n_glass, n_water = port[N_GLASS] / port[N_AIR], port[N_WATER] / port[N_AIR]
    low = min(n_glass, n_water) ** 2
    if not low + (low - 1.0) * u > 0.0:
        return TOTAL_REFLECTION, nan, nan, nan, (nan, nan, nan)
    w = (vx * inv_a - nx, vy * inv_a - ny, vz * inv_a - nz)
    return VALID, a, slope(n_glass, u), slope(n_water, u), w


@inner
def slope_by_u(index, s):
    """ds/du of s = `slope` (index, u)."""
    return -0.5 * (index * index - 1.0) * s * s * s


@inner
def slope_by_index(index, s, a):
    """ds/dindex of s = `slope` (index, u), with 1 + u = 1/a^2."""
    return -index * s * s * s / (a * a)

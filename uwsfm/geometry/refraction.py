"""Refraction at parallel planes: Snell's law and the flat-port equation.

Scalar kernels; failure is NaN. Equations: Sedlazeck & Koch (BMVC 2011) eq. 1-4 in
vector form; the projection equation after Agrawal et al. (CVPR 2012), who showed that
all rays through a flat port meet the axis along its normal.
"""

import math

from uwsfm._base.jit import inner, lane

MAX_STEPS = 60


@lane
def refract(dx, dy, dz, nx, ny, nz, ratio):
    """Refract a unit direction at a plane, by Snell's law in vector form.

    Args:
        dx, dy, dz: unit direction with <n, d> > 0.
        nx, ny, nz: unit normal pointing into the second medium.
        ratio: index of the first medium over that of the second.

    Returns:
        The unit direction in the second medium; NaN on total internal reflection.
    """
    c = nx * dx + ny * dy + nz * dz
    k = 1.0 - ratio * ratio * (1.0 - c * c)
    s = math.sqrt(k if k > 0.0 else math.nan) - ratio * c
    return ratio * dx + s * nx, ratio * dy + s * ny, ratio * dz + s * nz


@lane
def slope(index, u):
    """s = (n^2 + (n^2 - 1) u)^(-1/2): tan(theta in the layer) / tan(theta in air)."""
    square = index * index
    return 1.0 / math.sqrt(square + (square - 1.0) * u)


@lane
def flat_port_start(low, r2, water2):
    """A better start than the paraxial root ``low`` of the flat-port equation."""
    s = 1.0 - (1.0 - 1.0 / water2) * r2 * low * low
    return low / math.sqrt(s) if s > 0.02 else low


@lane
def flat_port_step(q, low, height, r2, dist, thick, glass2, water2):
    """One Halley step on the flat-port equation: (q, F before the step).

    Args:
        q: where F is evaluated.
        low: the paraxial root, below which the root is not.
        height, r2, dist, thick: as in `solve_flat_port`.
        glass2, water2: squared indices relative to air, >= 1.
    """
    u = q * q * r2
    s_g = 1.0 / math.sqrt(glass2 + (glass2 - 1.0) * u)
    s_w = 1.0 / math.sqrt(water2 + (water2 - 1.0) * u)
    f = q * (dist + thick * s_g + height * s_w) - 1.0
    sg2, sw2 = s_g * s_g, s_w * s_w
    by_glass, by_water = thick * glass2 * sg2 * s_g, height * water2 * sw2 * s_w
    f1 = dist + by_glass + by_water
    f2 = by_glass * (glass2 - 1.0) * sg2 + by_water * (water2 - 1.0) * sw2
    # Uncapped Halley diverges near grazing incidence: cap F F'' at 0.7 F'^2.
    curvature = min(-3.0 * q * r2 * f2 * f, 0.7 * f1 * f1)
    return max(q - 2.0 * f * f1 / (2.0 * f1 * f1 - curvature), low), f


@inner
def solve_flat_port(height, r2, dist, thick, n_glass, n_water):
    """Solve the flat-port equation for q = tan(theta in air) / |r|.

        F(q) = q (d + t s_g + h s_w) - 1 = 0,   s_i from `slope` at u = q^2 r2

    F is smooth on the axis. For indices >= air it is increasing and concave, so the
    paraxial root is a lower bound; Halley steps from a slightly better start take 1-3
    iterations at usual angles. Other orders of the indices have a critical angle where
    F goes to infinity, and are solved between brackets.

    Args:
        height: depth h of the point behind the outer surface, > 0.
        r2: squared distance of the point from the axis.
        dist: camera to inner surface, along the normal.
        thick: glass thickness.
        n_glass, n_water: indices relative to air.

    Returns:
        q; NaN if no ray joins the point and the camera.
    """
    if n_water < 1.0 or n_glass < 1.0:
        return _solve_bracketed(height, r2, dist, thick, n_glass, n_water)
    paraxial = dist + thick / n_glass + height / n_water
    if not paraxial > 0.0:
        return math.nan
    q_low = 1.0 / paraxial
    g2, w2 = n_glass * n_glass, n_water * n_water
    q = flat_port_start(q_low, r2, w2)
    for _ in range(MAX_STEPS):
        q, f = flat_port_step(q, q_low, height, r2, dist, thick, g2, w2)
        if abs(f) < 1e-10:  # cubic: the step just taken is exact to rounding
            return q
    return math.nan


@inner
def _solve_bracketed(height, r2, dist, thick, n_glass, n_water):
    """The same root for any order of the indices, by Newton between brackets."""
    index = min(n_glass, n_water)
    u_max = index * index / (1.0 - index * index)
    paraxial = dist + thick / n_glass + height / n_water
    if not paraxial > 0.0:
        return math.nan
    if r2 == 0.0:
        return 1.0 / paraxial
    low = 0.0
    high = math.sqrt(u_max / r2)
    no_glass = thick == 0.0 and n_glass < n_water
    # Then no layer lets F grow without bound: it stays finite at the critical angle.
    if no_glass and not high * (dist + height * slope(n_water, u_max)) > 1.0:
        return math.nan
    q = min(1.0 / paraxial, 0.5 * high)
    for _ in range(4 * MAX_STEPS):
        u = q * q * r2
        s_g, s_w = slope(n_glass, u), slope(n_water, u)
        f = q * (dist + thick * s_g + height * s_w) - 1.0
        f1 = dist + thick * n_glass * n_glass * s_g**3
        f1 += height * n_water * n_water * s_w**3
        if f > 0.0:
            high = q
        else:
            low = q
        step = q - f / f1
        inside = low < step < high
        q_next = step if inside else 0.5 * (low + high)
        if abs(q_next - q) <= 2e-16 * q:
            return q_next
        q = q_next
    return q

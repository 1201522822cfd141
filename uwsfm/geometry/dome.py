"""Refraction at concentric spheres: the dome-port equation.

Every ray through a dome stays in the plane of the camera O, the dome's centre c and the
point X, and keeps n p, with p its distance from the centre (Bouguer). The ray in air of
a point is v = X - kappa c: for a concentric dome v = X, whatever kappa. With
rho = |X - c|, R the inner and R_o the outer radius, mu_i = n_air / n_i, and
p = |c x X| / |v|, the directions of v, of the radius and of the water ray at X close a
triangle of angles:

    F = asin(k_1 p) + ... + asin(k_6 p) = 0,     k = ((kappa - 1) / rho, mu_w / rho,
        1 / R, -mu_g / R, mu_g / R_o, -mu_w / R_o)

All terms share the factor p, so sin(F) / p is smooth where X lies on the axis O - c. It
needs no angle: it is the imaginary part of the product of the six unit numbers
sqrt(1 - k_i^2 p^2) + i k_i p, with p divided out. Scalar kernels; failure is NaN.
"""

import math

from uwsfm._base.jit import inner, lane

MAX_STEPS = 60
# Below this share of R^2 the squared p takes the series: the quotient loses digits.
SMALL_P2 = 1e-3


@lane
def dome_slopes(kappa, rho, radius, outer, mu_glass, mu_water):
    """k_1, ..., k_6 of the dome-port equation, 1 / metres."""
    return (
        (kappa - 1.0) / rho,
        mu_water / rho,
        1.0 / radius,
        -mu_glass / radius,
        mu_glass / outer,
        -mu_water / outer,
    )


@lane
def _cosines(k, p2, first):
    """Cosines of the six angles; that of the first, which may be obtuse, is given."""
    return (
        first,
        math.sqrt(1.0 - k[1] * k[1] * p2),
        math.sqrt(1.0 - k[2] * k[2] * p2),
        math.sqrt(1.0 - k[3] * k[3] * p2),
        math.sqrt(1.0 - k[4] * k[4] * p2),
        math.sqrt(1.0 - k[5] * k[5] * p2),
    )


@lane
def _cos_first(kappa, a, b, c, m2, rho):
    """Cosine of the angle between v = X - kappa c and the radius X - c."""
    return (a - b - kappa * (b - c)) / (rho * math.sqrt(m2))


@lane
def dome_port_start(rho, radius, outer, mu_glass, mu_water):
    """The paraxial kappa, exact on the axis and for a concentric dome."""
    bend = (1.0 - mu_glass) / radius + (mu_glass - mu_water) / outer
    return 1.0 - mu_water - rho * bend


@lane
def _turned(real, imag, k, cos, p2):
    """A complex number with p divided out of its imaginary part, turned by an angle."""
    return real * cos - p2 * imag * k, real * k + imag * cos


@lane
def dome_port_newton(kappa, a, b, c, q, rho, radius, outer, mu_glass, mu_water):
    """sin(F) / p at a kappa, the Newton step that it asks for, and |v|^2."""
    m2 = a - 2.0 * kappa * b + kappa * kappa * c
    inv_m2 = 1.0 / m2
    p2 = q * inv_m2
    k1, k2, k3, k4, k5, k6 = dome_slopes(kappa, rho, radius, outer, mu_glass, mu_water)
    c1, c2, c3, c4, c5, c6 = _cosines(
        (k1, k2, k3, k4, k5, k6), p2, _cos_first(kappa, a, b, c, m2, rho)
    )
    real, imag = _turned(c1, k1, k2, c2, p2)
    real, imag = _turned(real, imag, k3, c3, p2)
    real, imag = _turned(real, imag, k4, c4, p2)
    real, imag = _turned(real, imag, k5, c5, p2)
    real, imag = _turned(real, imag, k6, c6, p2)
    weight = k1 / c1 + k2 / c2 + k3 / c3 + k4 / c4 + k5 / c5 + k6 / c6
    shrink = (b - kappa * c) * inv_m2  # d log(p) / d kappa
    slope = real * (1.0 / (rho * c1) + shrink * weight) - imag * shrink
    return imag, imag / slope, m2


@inner
def solve_dome_port(a, b, c, q, radius, thick, mu_glass, mu_water):
    """Solve the dome-port equation for kappa.

    Newton from the paraxial solution, which is exact on the axis and for a concentric
    dome; F rises with kappa, so its sign brackets the root.

    Args:
        a, b, c: <X, X>, <X, c> and <c, c>, with c < radius^2.
        q: |c x X|^2.
        radius, thick: inner radius and thickness of the dome; X lies outside of it.
        mu_glass, mu_water: index of air over those of glass and water, <= 1.

    Returns:
        kappa; NaN if no ray joins the point and the camera.
    """
    rho, outer = math.sqrt(a - 2.0 * b + c), radius + thick
    kappa = dome_port_start(rho, radius, outer, mu_glass, mu_water)
    low, high = -math.inf, math.inf
    for _ in range(MAX_STEPS):
        imag, step, m2 = dome_port_newton(
            kappa, a, b, c, q, rho, radius, outer, mu_glass, mu_water
        )
        if imag > 0.0:
            high = kappa
        else:
            low = kappa
        following = kappa - step
        if not low <= following <= high:
            if low == -math.inf:
                following = kappa - 2.0 * abs(step) - 1.0
            elif high == math.inf:
                following = kappa + 2.0 * abs(step) + 1.0
            else:
                following = 0.5 * (low + high)
        moved = following - kappa
        kappa = following
        # Quadratic: the step after this one is below rounding.
        if moved * moved * c <= 1e-18 * m2:
            return kappa
    return math.nan


@lane
def _cubic(k, p2):
    """(k / cos - asin(k p) / p) / p^2, whose second terms sum to zero at a root."""
    z = k * k * p2
    series = 0.3 + z * (15.0 / 56.0 + z * (35.0 / 144.0 + z * 315.0 / 1408.0))
    return k * k * k * (1.0 / 3.0 + z * series)


@lane
def dome_port_gradient(kappa, a, b, c, q, radius, thick, mu_glass, mu_water):
    """d kappa / d(a, b, c, radius, thick, mu_glass, mu_water) at a root.

    Where F = 0, d(F / p) = sum dk_i / cos_i + 0.5 T d(p^2) with
    T = sum (k_i / cos_i) / p^2, which is finite: near p = 0 the sum of k_i vanishes.
    p^2 = q / |v|^2 depends on a, b, c through q = a c - b^2 as well.
    """
    rho, outer = math.sqrt(a - 2.0 * b + c), radius + thick
    m2 = a - 2.0 * kappa * b + kappa * kappa * c
    p2 = q / m2
    k1, k2, k3, k4, k5, k6 = dome_slopes(kappa, rho, radius, outer, mu_glass, mu_water)
    c1, c2, c3, c4, c5, c6 = _cosines(
        (k1, k2, k3, k4, k5, k6), p2, _cos_first(kappa, a, b, c, m2, rho)
    )
    series = _cubic(k1, p2) + _cubic(k2, p2) + _cubic(k3, p2)
    series += _cubic(k4, p2) + _cubic(k5, p2) + _cubic(k6, p2)
    quotient = k1 / c1 + k2 / c2 + k3 / c3 + k4 / c4 + k5 / c5 + k6 / c6
    total = quotient / p2 if p2 > SMALL_P2 * radius * radius else series
    half = 0.5 * total / m2
    by_rho2 = -0.5 * (k1 / c1 + k2 / c2) / (rho * rho)
    by_a = by_rho2 + half * (c - p2)
    by_b = -2.0 * by_rho2 + half * (2.0 * p2 * kappa - 2.0 * b)
    by_c = by_rho2 + half * (a - p2 * kappa * kappa)
    inner2, outer2 = radius * radius, outer * outer
    by_thick = (mu_water / c6 - mu_glass / c5) / outer2
    by_radius = (mu_glass / c4 - 1.0 / c3) / inner2 + by_thick
    by_glass = 1.0 / (outer * c5) - 1.0 / (radius * c4)
    by_water = 1.0 / (rho * c2) - 1.0 / (outer * c6)
    by_kappa = 1.0 / (rho * c1) - 2.0 * half * p2 * (kappa * c - b)
    scale = -1.0 / by_kappa
    return (
        scale * by_a,
        scale * by_b,
        scale * by_c,
        scale * by_radius,
        scale * by_thick,
        scale * by_glass,
        scale * by_water,
    )

"""Snell's law at a plane, and the flat-port equation."""

import numpy as np
import pytest
from naive import air_tangent

from uwsfm.geometry.refraction import refract, slope, solve_flat_port


def unit_rows(rng, count):
    rows = rng.normal(size=(count, 3))
    return rows / np.linalg.norm(rows, axis=1, keepdims=True)


def python_of(kernel):
    """The uncompiled function, also where NUMBA_DISABLE_JIT is set."""
    return getattr(kernel, "py_func", kernel)


def test_refraction_keeps_n_sin_theta_and_the_plane_of_incidence(rng):
    for normal, ray in zip(unit_rows(rng, 300), unit_rows(rng, 300), strict=True):
        ray = ray if ray @ normal > 0 else -ray
        first, second = rng.uniform(1.0, 2.0, 2)
        out = np.array(refract(*ray, *normal, first / second))
        sine = np.linalg.norm(np.cross(normal, ray))
        if first * sine >= second:
            assert np.isnan(out).all()
            continue
        # 1e-14: a few roundings of numbers near one.
        assert abs(np.linalg.norm(out) - 1.0) < 1e-14
        sine_out = np.linalg.norm(np.cross(normal, out))
        assert abs(second * sine_out - first * sine) < 1e-14
        assert abs(np.cross(normal, ray) @ out) < 1e-14
        assert out @ normal > 0.0
        plain = python_of(refract)(*ray, *normal, first / second)
        # Compiled sums are fused and regrouped: a few roundings of numbers near one.
        assert plain == pytest.approx(tuple(out), abs=1e-14)


def test_ray_along_the_normal_goes_straight_on_and_equal_indices_bend_nothing():
    normal = np.array([0.6, 0.0, 0.8])
    np.testing.assert_allclose(refract(*normal, *normal, 1.5), normal, atol=1e-16)
    ray = np.array([0.0, 0.6, 0.8])
    np.testing.assert_allclose(refract(*ray, *normal, 1.0), ray, atol=1e-15)


INDICES = {
    "water": (1.5, 1.333),
    "glass below the water": (1.2, 1.4),
    "air outside, water inside": (1.5 / 1.333, 1 / 1.333),
    "glass below both": (1.0 / 1.4, 1.3 / 1.4),
    "no refraction": (1.0, 1.0),
}


@pytest.mark.parametrize("indices", INDICES.values(), ids=INDICES.keys())
def test_flat_port_equation_agrees_with_bisection_on_the_angle(rng, indices):
    for _ in range(200):
        dist, thick = 10.0 ** rng.uniform([-4, -4], [-0.7, -1])
        height = 10.0 ** rng.uniform(-3, 1.5)
        radius = height * np.tan(np.radians(rng.uniform(0.0, 50.0)))
        q = solve_flat_port(height, radius**2, dist, thick, *indices)
        expected = air_tangent(height, radius, dist, thick, *indices)
        # The bisection resolves angles to 1e-15: tan of a ray near the critical angle,
        # or near grazing, has 1e-15 (1 + tan^2) / tan of relative error from that.
        room = 1e-12 * (1.0 + expected**2)
        assert abs(q * radius - expected) <= room + 1e-11 * expected
        assert python_of(solve_flat_port)(
            height, radius**2, dist, thick, *indices
        ) == pytest.approx(q, rel=1e-14)


def test_point_on_the_axis_has_the_paraxial_solution():
    for glass, water in INDICES.values():
        q = solve_flat_port(2.0, 0.0, 0.02, 0.01, glass, water)
        assert q == pytest.approx(1.0 / (0.02 + 0.01 / glass + 2.0 / water), rel=1e-15)


def test_camera_on_the_glass_sees_nothing_beyond_the_critical_cone():
    """With d = t = 0 the solution is q = n / sqrt(h^2 - (n^2 - 1) r^2)."""
    critical = 1.0 / np.sqrt(1.333**2 - 1.0)  # r / h of the grazing ray
    for inside in (0.5, 0.99, 1 - 1e-4, 1 - 1e-6):
        r2 = (inside * critical) ** 2
        q = solve_flat_port(1.0, r2, 0.0, 0.0, 1.5, 1.333)
        # h^2 - (n^2 - 1) r^2 cancels down to 2e-6: 1e-16 / 2e-6.
        expected = 1.333 / np.sqrt(1.0 - (1.333**2 - 1.0) * r2)
        assert q == pytest.approx(expected, rel=1e-9)
    for beyond in (1 + 1e-9, 1.01, 10.0):
        r2 = (beyond * critical) ** 2
        assert np.isnan(solve_flat_port(1.0, r2, 0.0, 0.0, 1.5, 1.333))
        # Any distance at all, and a ray grazes its way there.
        assert solve_flat_port(1.0, r2, 1e-9, 0.0, 1.5, 1.333) > 100.0


def test_thin_glass_of_a_lower_index_than_air_cuts_the_cone():
    """Zero thickness leaves no room to travel sideways at the critical angle."""
    dist, height, glass, water = 0.02, 1.0, 0.7, 0.8
    edge = 0.7 / np.sqrt(1.0 - 0.7**2)  # tan of the critical angle in air
    radius = edge * (dist + height * slope(water, edge**2))
    inside = solve_flat_port(height, (0.999 * radius) ** 2, dist, 0.0, glass, water)
    assert 0.99 * edge < inside * 0.999 * radius < edge
    beyond = solve_flat_port(height, (1.001 * radius) ** 2, dist, 0.0, glass, water)
    assert np.isnan(beyond)


def test_negative_distances_are_smooth_for_the_optimiser_and_then_end():
    solutions = [solve_flat_port(1.0, 0.09, d, 0.01, 1.5, 1.333) for d in (-1e-9, 1e-9)]
    assert solutions[0] == pytest.approx(solutions[1], rel=1e-8)
    for glass, water in INDICES.values():  # the camera in front of everything
        assert np.isnan(solve_flat_port(0.01, 0.01, -0.05, 0.0, glass, water))
